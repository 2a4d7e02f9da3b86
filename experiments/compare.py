"""`python -m experiments.compare [NAME=]RUN ... --out=DIR`: methods side by side, over the seeds of all their runs.

Runs of one method with different settings are kept apart by a name of your own in front: `"hot=runs/a"`.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments import process
from experiments.analysis import figures
from experiments.analysis.comparison import belief_table, calibration_table, coverage_table
from experiments.analysis.statistics import Group, group
from experiments.analysis.tables import duration
from experiments.runs import modules
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import write_text
from experiments.runs.scene import Scene


def split_name(argument: str) -> tuple[str | None, Path]:
    """`NAME=RUN` as name and path; without a name, or where the whole is a path that exists, there is none."""
    name, equals, path = argument.partition("=")
    if not equals or not name or Path(argument).exists():
        return None, Path(argument)
    return name, Path(path)


def write(runs: Sequence[Path], names: Sequence[str | None], out: Path, until: int | None = None) -> str:
    """Compare runs: pictures and `comparison.json` in `out`; gives the tables.

    Raises:
        RunError: a run cannot be read or does not go with the others, or `out` cannot be written.
        ValueError: the configuration of a run is damaged.
    """
    first, groups = group(runs, until, names)
    config, scene = first.config, first.scene
    try:
        out.mkdir(parents=True, exist_ok=True)
        _draw(groups, first.scene, config.env, out)
        found = {one.label: [outcome._asdict() for outcome in one.outcomes] for one in groups}
        record = {"env": config.env, "preset": config.preset, "steps": config.steps, "methods": found}
        write_text(out / "comparison.json", json.dumps(record, indent=2) + "\n")
    except OSError as error:
        raise disk_error("write the comparison", out, error) from error
    tables = [coverage_table(groups, scene.coverage), belief_table(groups), calibration_table(groups)]
    total = sum(outcome.minutes for one in groups for outcome in one.outcomes)
    after = f"{duration(60 * total)} of wall time in all; written to {out}"
    return "\n\n".join([*(text for text in tables if text), after])


def _draw(groups: Sequence[Group], scene: Scene, env: str, out: Path) -> None:
    curves = [figures.Curves(one.label, one.steps, one.coverage) for one in groups]
    figures.plot_coverage(out / "coverage.png", curves, scene.coverage, episode_steps=scene.episode_steps, title=env)
    known = [figures.Curves(one.label, one.steps, one.variance) for one in groups if np.isfinite(one.variance).any()]
    if known:
        figures.plot_intrinsic_reward(
            out / "variance.png",
            known,
            unit=f"equation 1 ({scene.variance_unit})",
            title=f"{env}: variance of the models on the transitions just met",
        )


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
    modules.add_flag(parser)
    process.add_flag(parser)
    arguments = parser.parse_args(argv)
    if arguments.until is not None and arguments.until < 1:
        parser.error(f"--until={arguments.until}. Allowed: 1 or more.")
    try:
        modules.load(arguments.imports)
        names, runs = zip(*map(split_name, arguments.runs), strict=True)
        text = write(runs, names, arguments.out, arguments.until)
        if arguments.keep:
            try:
                for run in runs:
                    RunDirectory(run).keep(arguments.keep)
            except OSError as error:
                raise disk_error("keep the runs", arguments.keep, error) from error
        print(text)
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        process.show_cause(error, debug=arguments.debug)
        return 1
    return 0


if __name__ == "__main__":
    process.carry_out(main)
