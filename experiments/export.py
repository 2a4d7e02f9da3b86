"""`python -m experiments.export RUN ... [--out=rows.csv]`: the rows of runs as CSV, for spreadsheets and pandas.

A line per round and seed, finished or not; a column per field, in the order of `experiments.runs.rows`, which says what
they mean. A field that a row has none of is empty. With several runs the first column names the run.
"""

import argparse
import csv
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments import process
from experiments.runs import modules
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import replacing
from experiments.runs.rows import in_order
from experiments.runs.seeds import expand
from experiments.runs.status import Status

RUN = "run"
"""The column that names the run."""


def to_csv(runs: Sequence[Path]) -> str:
    """The rows of runs as CSV.

    Raises:
        RunError: there is no run, or its rows cannot be read.
    """
    rows: list[dict[str, Any]] = []
    runs = [run for path in runs for run in expand(path)]
    for run in runs:
        directory = RunDirectory(run)
        if directory.status() is Status.ABSENT:
            raise RunError(f"{run} holds no run (no config.json). Give the --out of a run.")
        rows += [{RUN: str(run), **row} if len(runs) > 1 else row for row in directory.rows()]
    columns = in_order((name for row in rows for name in row), (RUN,))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def main(argv: Sequence[str] | None = None) -> int:
    """Write CSV; the exit status is 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m experiments.export", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="directory of a run")
    parser.add_argument("--out", type=Path, help="the file to write (default: print)")
    modules.add_flag(parser)
    process.add_flag(parser)
    arguments = parser.parse_args(argv)
    try:
        modules.load(arguments.imports)
        text = to_csv(arguments.runs)
        if arguments.out is None:
            print(text, end="")
            return 0
        try:
            with replacing(arguments.out) as draft:
                draft.write_text(text)
        except OSError as error:
            raise disk_error("write the rows", arguments.out, error) from error
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        process.show_cause(error, debug=arguments.debug)
        return 1
    return 0


if __name__ == "__main__":
    process.carry_out(main)
