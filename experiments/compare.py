"""`python -m experiments.compare [NAME=]RUN ... --out=DIR`: methods side by side, over the seeds of all their runs.

Runs of one method with different settings are kept apart by a name of your own in front: `"hot=runs/a"`. In place of a
run, a file that `python -m benchmarks.peers.returns` wrote has another library's returns beside ours.
"""

import argparse
import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments import process
from experiments.analysis import comparison
from experiments.analysis.load import columns
from experiments.runs import modules
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import replacing, write_text
from experiments.runs.seeds import expand


def split_name(argument: str) -> tuple[str | None, Path]:
    """`NAME=RUN` as name and path; without a name, or where the whole is a path that exists, there is none."""
    name, equals, path = argument.partition("=")
    if not equals or not name or Path(argument).exists():
        return None, Path(argument)
    return name, Path(path)


def write_csv(path: Path, table: Mapping[str, np.ndarray]) -> None:
    """Write columns as CSV; what is not there is empty.

    Raises:
        RunError: the file cannot be written.
    """
    try:
        with replacing(path) as draft, draft.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table)
            for line in zip(*(column.tolist() for column in table.values()), strict=True):
                writer.writerow(["" if value != value else value for value in line])
    except OSError as error:
        raise disk_error("write the rows", path, error) from error


def main(argv: Sequence[str] | None = None) -> int:
    """Print tables, write pictures and `comparison.json`; the exit status is 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m experiments.compare", description=__doc__)
    parser.add_argument(
        "runs",
        nargs="+",
        metavar="[NAME=]RUN",
        help="directories of finished runs, grouped by NAME, or by method; and files of other libraries' returns, as "
        "benchmarks.peers.returns writes them, by NAME, or by library",
    )
    parser.add_argument("--out", type=Path, required=True, help="directory for the pictures and comparison.json")
    parser.add_argument("--until", type=int, help="compare the first so many steps of each run (default: all)")
    parser.add_argument(
        "--against", metavar="NAME", help="what all others are compared with, seed by seed (default: the first name)"
    )
    parser.add_argument(
        "--keep", type=Path, help="also copy what a comparison needs of each run to this directory; they are runs, too"
    )
    parser.add_argument("--csv", type=Path, help="also write the rows of all runs to this file, with their names")
    modules.add_flag(parser)
    process.add_flag(parser)
    arguments = parser.parse_args(argv)
    if arguments.until is not None and arguments.until < 1:
        parser.error(f"--until={arguments.until}. Allowed: 1 or more.")
    try:
        modules.load(arguments.imports)
        pairs = [split_name(word) for word in arguments.runs]
        others = [(name, path) for name, path in pairs if path.is_file()]
        ours = [(name, run) for name, path in pairs if not path.is_file() for run in expand(path)]
        if not ours:
            raise RunError(f"{others[0][1]}: is of another library. Give at least one run to hold it beside.")
        names, runs = zip(*ours, strict=True)
        text = comparison.write(runs, names, arguments.out, arguments.until, arguments.against, others)
        if arguments.csv:
            write_csv(arguments.csv, columns(runs, names, arguments.until))
        if arguments.keep:
            try:
                for run in runs:
                    RunDirectory(run).keep(arguments.keep)
                for _, path in others:
                    write_text(arguments.keep / path.name, path.read_text())
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
