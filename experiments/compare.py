"""`python -m experiments.compare [NAME=]RUN ... --out=DIR`: methods side by side, over the seeds of all their runs.

Runs of one method with different settings are kept apart by a name of your own in front: `"hot=runs/a"`.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments import process
from experiments.analysis import comparison
from experiments.runs import modules
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError, disk_error
from experiments.runs.seeds import expand


def split_name(argument: str) -> tuple[str | None, Path]:
    """`NAME=RUN` as name and path; without a name, or where the whole is a path that exists, there is none."""
    name, equals, path = argument.partition("=")
    if not equals or not name or Path(argument).exists():
        return None, Path(argument)
    return name, Path(path)


def main(argv: Sequence[str] | None = None) -> int:
    """Print tables, write pictures and `comparison.json`; the exit status is 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m experiments.compare", description=__doc__)
    parser.add_argument(
        "runs", nargs="+", metavar="[NAME=]RUN", help="directories of finished runs, grouped by NAME, or by method"
    )
    parser.add_argument("--out", type=Path, required=True, help="directory for the pictures and comparison.json")
    parser.add_argument("--until", type=int, help="compare the first so many steps of each run (default: all)")
    parser.add_argument(
        "--against", metavar="NAME", help="what all others are compared with, seed by seed (default: the first name)"
    )
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
        pairs = map(split_name, arguments.runs)
        names, runs = zip(*((name, run) for name, path in pairs for run in expand(path)), strict=True)
        text = comparison.write(runs, names, arguments.out, arguments.until, arguments.against)
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
