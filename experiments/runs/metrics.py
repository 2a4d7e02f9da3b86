"""The rows of a run on disk: JSON lines that are appended, read, and cut back when a run is resumed.

A row is a dict of scalars for one round and one seed; `experiments.runs.rows` says what the fields mean.
"""

import gzip
import json
import math
import os
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import parse_json, replacing

Row = Mapping[str, Any]


def read_metrics(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Reads the rows of a `metrics.jsonl` or, where there is none, of a `metrics.jsonl.gz`; a last line that is still
    being written is left out.

    Raises:
        RunError: the file cannot be read, or a line is not a row.
    """
    packed = Path(f"{os.fspath(path)}.gz")
    try:
        if packed.exists() and not Path(path).exists():
            lines = gzip.decompress(packed.read_bytes()).split(b"\n")[:-1]
        else:
            lines = Path(path).read_bytes().split(b"\n")[:-1]
    except (OSError, EOFError, zlib.error) as error:
        raise disk_error("read the metrics", path, error) from error
    return [_parse(line, path, number) for number, line in enumerate(lines, 1)]


TAIL = 2**16
"""Bytes at the end of a file of rows that hold at least one; a row has some hundred fields at most."""


def last_row(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """The last whole row of a `metrics.jsonl` that another process writes; None: there is none that can be read."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL))
            lines = file.read().split(b"\n")
        return _parse(lines[-2], path, 0) if len(lines) > 1 else None
    except (OSError, RunError):
        return None


def _parse(line: bytes, path: str | os.PathLike[str], number: int) -> dict[str, Any]:
    try:
        row = parse_json(line.decode())
    except ValueError:
        row = None
    if not isinstance(row, dict) or type(row.get("step")) is not int or type(row.get("seed", 0)) is not int:
        raise RunError(
            f"line {number} of {Path(path)} is damaged. What to do: put back a copy of the file, or start a new run "
            "with another --out."
        )
    return row


class MetricsLog:
    """The rows of a run, appended to a file of JSON lines. Each append is handed to the system before it returns.

    Args:
        path: the file; made, with its directory, by the first append.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._file: int | None = None

    def append(self, rows: Iterable[Row]) -> None:
        """Appends rows, in one write. Numbers that are not finite become null; the order of the fields is kept.

        Raises:
            ValueError: a field is not a scalar, or `step` or `seed` is missing.
            RunError: the disk is full or cannot be written.
        """
        text = "".join(json.dumps(plain(row), allow_nan=False) + "\n" for row in rows).encode()
        try:
            if self._file is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            while text:
                text = text[os.write(self._file, text) :]
        except OSError as error:
            raise disk_error("write the metrics", self.path, error, "continue with --resume") from error

    def sync(self) -> None:
        """Forces the rows onto the disk. Call it before a checkpoint: none may be ahead of its rows after a power cut.

        Raises:
            RunError: the disk is full or cannot be written.
        """
        try:
            if self._file is not None:
                os.fsync(self._file)
        except OSError as error:
            raise disk_error("write the metrics", self.path, error, "continue with --resume") from error

    def truncate_after(self, step: int) -> int:
        """Cuts the file back to the rows with `row["step"] <= step`, for a run that is resumed from a checkpoint.

        A line that was torn by a kill goes too. The file is replaced as a whole: killed half-way, it is the old one.

        Args:
            step: of the checkpoint; -1 for a run that starts over.

        Returns:
            How many rows are left.

        Raises:
            RunError: a row that is to stay is damaged, or the file cannot be read or written.
        """
        self.close()
        if not self.path.exists():
            return 0
        try:
            *lines, torn = self.path.read_bytes().split(b"\n")
            if step < 0:
                kept = []
            else:
                kept = [line for n, line in enumerate(lines, 1) if _parse(line, self.path, n)["step"] <= step]
            if torn or len(kept) < len(lines):
                with replacing(self.path) as draft, draft.open("wb") as file:
                    file.writelines(line + b"\n" for line in kept)
                    file.flush()
                    os.fsync(file.fileno())
        except OSError as error:
            raise disk_error("cut back the metrics", self.path, error, "continue with --resume") from error
        return len(kept)

    def close(self) -> None:
        """Closes the file; a later append opens it again."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def plain(row: Row) -> dict[str, Any]:
    """A row as JSON has it.

    Raises:
        ValueError: a field is not a scalar, or `step` or `seed` is missing.
    """
    if not {"step", "seed"} <= row.keys():
        raise ValueError(f"a row needs step and seed; its fields are {', '.join(row)}")
    return {name: scalar(name, value) for name, value in row.items()}


def scalar(name: str, value: Any) -> bool | int | float | str | None:
    """A field as JSON has it; float32 with the few digits that tell it apart from its neighbours."""
    if value is None or (isinstance(value, str | bool | int) and not isinstance(value, np.generic)):
        return value
    array = np.asarray(value)
    if array.ndim or array.dtype.kind in "OUSmMc":
        raise ValueError(f"{name}: a row holds scalars, got {array.dtype}{list(array.shape)}")
    if array.dtype.kind in "biu":
        return array.item()
    number = float(array) if array.dtype.itemsize >= 8 else float(str(array))
    return number if math.isfinite(number) else None
