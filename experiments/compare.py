"""`python -m experiments.compare [NAME=]RUN ... --out=DIR`: methods side by side, over the seeds of all their runs.

Runs of one method with different settings are told apart by a name of your own in front: `"hot=runs/a"`.
"""

import argparse
import dataclasses
import gzip
import json
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from envs.base import Coverage
from experiments import plot, posterior
from experiments.config import RunConfig
from experiments.errors import RunError, disk_error
from experiments.log import duration, number, read_metrics
from experiments.loop import make_environment, read_config
from experiments.report import series
from jaxplore.methods import get_method, reward_unit

POINTS = 100
"""Points of a comparison, evenly spaced: runs of different rounds meet there."""


MEASURES = (
    *("intrinsic_reward", "intrinsic_reward_p95", "policy/imagined_reward", "policy/imagined_reward_p95"),
    *("variance", "variance_p95", "divergence", "divergence_p95", "model_error"),
)
"""Fields of a run's rows that tell of its belief, on the transitions just met and not learned from yet."""


KEPT = ("config.json", "versions.json", posterior.FILE)
"""Files that `keep` copies as they are, those that there are."""


def keep(run: Path, directory: Path) -> None:
    """Copy what a comparison reads of a run, its metrics compressed, to a directory of the run's name: some 30 kB.

    Raises:
        OSError: it cannot be read or written.
    """
    to = directory / run.resolve().name
    to.mkdir(parents=True, exist_ok=True)
    if to.resolve() == run.resolve():
        return
    for name in KEPT:
        if (run / name).exists():
            (to / name).write_bytes((run / name).read_bytes())
    if (run / "metrics.jsonl").exists():
        # Without the time of day, so that the same run gives the same bytes.
        (to / "metrics.jsonl.gz").write_bytes(gzip.compress((run / "metrics.jsonl").read_bytes(), mtime=0))
    else:
        (to / "metrics.jsonl.gz").write_bytes((run / "metrics.jsonl.gz").read_bytes())


class Outcome(NamedTuple):
    """One seed of one run."""

    seed: int
    cells: int
    """Coverage cells seen at the end."""
    reached: tuple[int, ...]
    """The step (end of its round) at which each further cell was seen: the first entry is the first cell's."""
    minutes: float
    """Wall time of its run; of seeds carried side by side, each one's share."""
    measures: dict[str, float]
    """`MEASURES`, those that there are: means over the rounds of the second half."""
    posterior: dict[str, Any] | None
    """What `experiments.posterior` found of this seed at this step, if it was asked."""


class Group(NamedTuple):
    """All seeds of one method."""

    label: str
    outcomes: list[Outcome]
    steps: np.ndarray
    """`[T]`"""
    coverage: np.ndarray
    """`[S, T]`, 0 to 1."""
    variance: np.ndarray
    """Equation 1 on the transitions just met, whatever the method's own reward, `[S, T]`; NaN without a belief."""


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


def outcomes(config: RunConfig, rows: Sequence[dict[str, Any]], run: Path) -> list[Outcome]:
    """What became of each seed of a run."""
    found, asked = [], _read_posterior(run, config.steps)
    for seed in range(config.seed, config.seed + config.num_seeds):
        own = [row for row in rows if row["seed"] == seed]
        cells = own[-1]["cells"]
        reached = tuple(next(row["step"] for row in own if row["cells"] >= count) for count in range(1, cells + 1))
        late = [row for row in own if 2 * row["step"] > config.steps]
        measures = {name: [row[name] for row in late if row.get(name) is not None] for name in MEASURES}
        means = {name: float(np.mean(values)) for name, values in measures.items() if values}
        minutes = own[-1]["wall_time"] / 60 / config.num_seeds
        found.append(Outcome(seed, cells, reached, minutes, means, asked.get(seed)))
    return found


def _read_posterior(run: Path, step: int) -> dict[int, dict[str, Any]]:
    """By seed what was found at this step; empty where nobody asked, or at another step."""
    path = run / posterior.FILE
    if not path.exists():
        return {}
    try:
        asked = json.loads(path.read_text())
        return {one["seed"]: one for one in asked["seeds"]} if asked["step"] == step else {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"cannot read {path}: {error!r}. What to do: python -m experiments.posterior {run}") from error


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
        curves, variances = [], []
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
            variances.append(series(rows, "variance")[1][:, at])
            own += outcomes(config, rows, run)
        seeds = [outcome.seed for outcome in own]
        if len(set(seeds)) < len(seeds):
            raise RunError(
                f"{label}: seed {statistics.mode(seeds)} comes twice. Give each seed of a method once, "
                "or NAME=RUN to compare settings."
            )
        groups.append(Group(label, own, grid, np.concatenate(curves), np.concatenate(variances)))
    return first, groups


def table(groups: Sequence[Group], coverage: Coverage) -> str:
    """A Markdown table: medians, ranges in brackets, and the mean height of the coverage curves with its interval."""
    most = coverage.reachable or coverage.num_cells
    seen = f"{coverage.unit} of {coverage.size}: median (range)"
    head = ("method", "seeds", seen, "each seed", "all seen at step", "coverage over the run: mean, 95 %", "minutes")
    lines = []
    for one in groups:
        cells = [outcome.cells for outcome in one.outcomes]
        whole = [f"{outcome.reached[-1]:,}" for outcome in one.outcomes if outcome.cells == most]
        lines.append(
            (
                *(f"`{one.label}`", str(len(cells)), f"{statistics.median(cells):g} ({min(cells)} to {max(cells)})"),
                *(", ".join(map(str, cells)), ", ".join(whole) or "-", _percent(one)),
                f"{statistics.median(outcome.minutes for outcome in one.outcomes):.1f}",
            )
        )
    return str(_markdown(head, lines))


def belief_table(groups: Sequence[Group]) -> str | None:
    """A Markdown table of what the beliefs said in the second half of the runs, means over seeds; None without any."""
    pairs = (
        ("own reward, imagined", "policy/imagined_reward"),
        ("own reward", "intrinsic_reward"),
        ("variance", "variance"),
        ("divergence", "divergence"),
    )
    head = ("method", "model error", *(f"{title}: mean, 95th percentile" for title, _ in pairs))
    lines = []
    for one in groups:
        means = {name: _mean([outcome.measures.get(name) for outcome in one.outcomes]) for name in MEASURES}
        if means["model_error"] is not None:
            shown = (f"{number(means[name])}, {number(means[f'{name}_p95'])}" for _, name in pairs)
            lines.append((f"`{one.label}`", number(means["model_error"]), *shown))
    return _markdown(head, lines)


def calibration_table(groups: Sequence[Group]) -> str | None:
    """A Markdown table of what `experiments.posterior` found, geometric means of ratios and means of the rest over the
    seeds that were asked; None where none was.
    """
    kinds = (("data", posterior.DATA), ("new", posterior.HELD_OUT), ("unseen", posterior.UNSEEN))
    head = (
        *("method", "seeds"),
        *(f"error / variance, {short}" for short, _ in kinds),
        *(f"rank correlation, {short}" for short, _ in kinds),
        "unseen told from data",
    )
    lines = []
    for one in groups:
        asked = [outcome.posterior for outcome in one.outcomes if outcome.posterior]
        if not asked:
            continue
        sets = [[found["sets"].get(kind, {}) for found in asked] for _, kind in kinds]
        ratios = [[found.get("error_per_variance") for found in kind] for kind in sets]
        told = _mean([found["unseen_told_from_data"] for found in asked])
        lines.append(
            (
                *(f"`{one.label}`", str(len(asked))),
                *(number(_mean([value and float(np.log(value)) for value in kind], np.exp)) for kind in ratios),
                *(number(_mean([found.get("rank") for found in kind])) for kind in sets),
                "-" if told is None else f"{told:.0%}",
            )
        )
    return _markdown(head, lines)


def _markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str | None:
    rows = (head, ["---"] * len(head), *lines)
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) if lines else None


def _mean(values: Sequence[float | None], then: Callable[[float], float] = float) -> float | None:
    """Mean of the values that there are."""
    known = [value for value in values if value is not None]
    return then(float(np.mean(known))) if known else None


def _percent(one: Group) -> str:
    mean, half_width = interval(one.coverage.mean(axis=1))
    return f"{mean:.0%}" if half_width is None else f"{mean:.0%} +- {100 * half_width:.0f}"


def main(argv: Sequence[str] | None = None) -> int:
    """Print tables, write pictures and `comparison.json`; the exit status is 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m experiments.compare", description=__doc__)
    parser.add_argument(
        "runs", nargs="+", metavar="[NAME=]RUN", help="directories of finished runs, grouped by NAME, or by method"
    )
    parser.add_argument("--out", type=Path, required=True, help="directory for the pictures and comparison.json")
    parser.add_argument("--until", type=int, help="compare the first so many steps of each run (default: all)")
    parser.add_argument(
        "--keep", type=Path, help="also copy what a comparison needs of each run to this directory; they are runs, too"
    )
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
        told = [plot.Curves(one.label, one.steps, one.variance) for one in groups if np.isfinite(one.variance).any()]
        if told:
            unit = reward_unit(get_method("implicit"), config.explorer)
            plot.plot_intrinsic_reward(
                arguments.out / "variance.png",
                told,
                unit=f"equation 1 ({unit})",
                title=f"{config.env}: variance of the models on the transitions just met",
            )
        found = {one.label: [outcome._asdict() for outcome in one.outcomes] for one in groups}
        record = {"env": config.env, "preset": config.preset, "steps": config.steps, "methods": found}
        (arguments.out / "comparison.json").write_text(json.dumps(record, indent=2) + "\n")
        for run in runs if arguments.keep else ():
            keep(run, arguments.keep)
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"error: {disk_error('write the comparison', arguments.out, error)}", file=sys.stderr)
        return 1
    shown = [table(groups, env.coverage), belief_table(groups), calibration_table(groups)]
    print("\n\n".join(text for text in shown if text))
    total = sum(outcome.minutes for one in groups for outcome in one.outcomes)
    print(f"\n{duration(60 * total)} of wall time in all; written to {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
