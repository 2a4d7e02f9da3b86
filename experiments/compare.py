"""`python -m experiments.compare [NAME=]RUN ... --out=DIR`: methods side by side, over the seeds of all their runs.

Runs of one method with different settings are told apart by a name of your own in front: `"hot=runs/a"`.
"""

import argparse
import dataclasses
import json
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from envs.base import Coverage
from experiments import plot
from experiments.config import RunConfig
from experiments.errors import RunError, disk_error
from experiments.log import duration, read_metrics
from experiments.loop import make_environment, read_config
from experiments.report import series

POINTS = 100
"""Points of a comparison, evenly spaced: runs of different rounds meet there."""


class Outcome(NamedTuple):
    """One seed of one run."""

    seed: int
    cells: int
    """Coverage cells seen at the end."""
    reached: tuple[int, ...]
    """The step (end of its round) at which each further cell was seen: the first entry is the first cell's."""
    minutes: float
    """Wall time of the run that the seed was part of."""


class Group(NamedTuple):
    """All seeds of one method."""

    label: str
    outcomes: list[Outcome]
    steps: np.ndarray
    """`[T]`"""
    coverage: np.ndarray
    """`[S, T]`, 0 to 1."""


class Interval(NamedTuple):
    """A mean and the 95 % confidence interval around it."""

    mean: float
    half_width: float | None
    """Student's t with one degree of freedom less than there are seeds. None: of one seed there is none."""


def interval(values: np.ndarray) -> Interval:
    """Mean of `values [S]` and its 95 % interval by Student's t: wide where seeds are few, as it should be."""
    count = len(values)
    if count < 2:
        return Interval(float(np.mean(values)), None)
    error = np.std(values, ddof=1) / np.sqrt(count)
    return Interval(float(np.mean(values)), float(stats.t.ppf(0.975, count - 1) * error))


def split_name(argument: str) -> tuple[str | None, Path]:
    """`NAME=RUN` as name and path; without a name, or where the whole is a path that exists, there is none."""
    name, equals, path = argument.partition("=")
    if not equals or not name or Path(argument).exists():
        return None, Path(argument)
    return name, Path(path)


def load(run: Path, until: int | None = None) -> tuple[RunConfig, list[dict[str, Any]]]:
    """The configuration and the rows of a finished run, or of its first `until` steps as if it had ended there.

    Raises:
        RunError: `run` holds no run, or one that has not come that far.
    """
    config = read_config(run)
    rows = read_metrics(run / "metrics.jsonl")
    last = max((row["step"] for row in rows), default=0)
    if last < (until or config.steps):
        raise RunError(f"{run} stands at step {last} of {until or config.steps}. Finish it with --resume first.")
    if until is None:
        return config, rows
    return dataclasses.replace(config, steps=until), [row for row in rows if row["step"] <= until]


def outcomes(config: RunConfig, rows: Sequence[dict[str, Any]]) -> list[Outcome]:
    """What became of each seed of a run."""
    found = []
    for seed in range(config.seed, config.seed + config.num_seeds):
        own = [row for row in rows if row["seed"] == seed]
        cells = own[-1]["cells"]
        reached = tuple(next(row["step"] for row in own if row["cells"] >= count) for count in range(1, cells + 1))
        found.append(Outcome(seed, cells, reached, own[-1]["wall_time"] / 60))
    return found


def group(
    runs: Sequence[Path], until: int | None = None, names: Sequence[str | None] | None = None
) -> tuple[RunConfig, list[Group]]:
    """The runs by name, in the order in which the names come; of each the first `until` steps, or all.

    Args:
        runs: directories.
        until: steps to compare.
        names: of each run, what it counts under; None: its method.

    Returns:
        The first run's configuration, and a group for each name.

    Raises:
        RunError: runs differ in environment or number of steps, or a seed of a method comes twice.
    """
    loaded = [load(run, until) for run in runs]
    first = loaded[0][0]
    named = [name or config.method for name, (config, _) in zip(names or [None] * len(loaded), loaded, strict=True)]
    labels = list(dict.fromkeys(named))
    # A first point before the first round has nothing to show: rounds are as long as the warm-up at most.
    grid = np.unique(np.linspace(first.steps / POINTS, first.steps, POINTS).round().astype(int))
    grid = grid[grid >= max(min(row["step"] for row in rows) for _, rows in loaded)]
    groups = []
    for label in labels:
        own: list[Outcome] = []
        curves = []
        for run, name, (config, rows) in zip(runs, named, loaded, strict=True):
            if (config.env, config.steps) != (first.env, first.steps):
                raise RunError(
                    f"{run} is of {config.env} over {config.steps} steps, {runs[0]} of {first.env} over {first.steps}. "
                    "Compare runs of one environment and one length."
                )
            if name != label:
                continue
            steps, covered = series(rows, "coverage")
            at = np.searchsorted(steps, grid, side="right") - 1
            curves.append(covered[:, at])
            own += outcomes(config, rows)
        seeds = [outcome.seed for outcome in own]
        if len(set(seeds)) < len(seeds):
            raise RunError(
                f"{label}: seed {statistics.mode(seeds)} comes twice. Give each seed of a method once, "
                "or NAME=RUN to compare settings."
            )
        groups.append(Group(label, own, grid, np.concatenate(curves)))
    return first, groups


def table(groups: Sequence[Group], coverage: Coverage) -> str:
    """A Markdown table: medians, ranges in brackets, and the mean height of the coverage curves with its interval."""
    most = coverage.reachable or coverage.num_cells
    seen = f"{coverage.unit} of {coverage.size}: median (range)"
    lines = [
        f"| method | seeds | {seen} | each seed | all seen at step | coverage over the run: mean, 95 % | minutes |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in groups:
        cells = [outcome.cells for outcome in one.outcomes]
        whole = [f"{outcome.reached[-1]:,}" for outcome in one.outcomes if outcome.cells == most]
        minutes = statistics.median(outcome.minutes for outcome in one.outcomes)
        lines.append(
            f"| `{one.label}` | {len(cells)} | {statistics.median(cells):g} ({min(cells)} to {max(cells)}) "
            f"| {', '.join(map(str, cells))} | {', '.join(whole) or '-'} | {_percent(one)} | {minutes:.1f} |"
        )
    return "\n".join(lines)


def _percent(one: Group) -> str:
    mean, half_width = interval(one.coverage.mean(axis=1))
    return f"{mean:.0%}" if half_width is None else f"{mean:.0%} +- {100 * half_width:.0f}"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, write `coverage.png` and `comparison.json`; the exit status is 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m experiments.compare", description=__doc__)
    parser.add_argument(
        "runs", nargs="+", metavar="[NAME=]RUN", help="directories of finished runs, grouped by NAME, or by method"
    )
    parser.add_argument("--out", type=Path, required=True, help="directory for coverage.png and comparison.json")
    parser.add_argument("--until", type=int, help="compare the first so many steps of each run (default: all)")
    arguments = parser.parse_args(argv)
    if arguments.until is not None and arguments.until < 1:
        parser.error(f"--until={arguments.until}. Allowed: 1 or more.")
    try:
        names, runs = zip(*map(split_name, arguments.runs), strict=True)
        config, groups = group(runs, arguments.until, names)
        env = make_environment(config)
        arguments.out.mkdir(parents=True, exist_ok=True)
        curves = [plot.Curves(one.label, one.steps, one.coverage) for one in groups]
        plot.plot_coverage(
            arguments.out / "coverage.png", curves, env.coverage, episode_steps=env.spec.episode_steps, title=config.env
        )
        found = {one.label: [outcome._asdict() for outcome in one.outcomes] for one in groups}
        record = {"env": config.env, "preset": config.preset, "steps": config.steps, "methods": found}
        (arguments.out / "comparison.json").write_text(json.dumps(record, indent=2) + "\n")
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"error: {disk_error('write the comparison', arguments.out, error)}", file=sys.stderr)
        return 1
    print(table(groups, env.coverage))
    total = sum(outcome.minutes for one in groups for outcome in one.outcomes)
    print(f"\n{duration(60 * total)} of wall time in all; written to {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
