"""What a run tells: rows on disk, curves for TensorBoard, a progress bar, and the table that closes it.

A row is a dict of scalars for one round and one seed. `step` (environment steps so far) and `seed` are in every row;
`coverage`, `cells`, `intrinsic_reward`, `model_error`, `wall_time` [s] and `steps_per_second` are what the bar and the
table look for. `metrics.jsonl` is the truth; everything else can be made again from it.
"""

import contextlib
import gzip
import json
import math
import os
import statistics
import sys
import time
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from experiments.errors import RunError, disk_error

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


def _parse(line: bytes, path: str | os.PathLike[str], number: int) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except ValueError:
        row = None
    if not isinstance(row, dict) or "step" not in row:
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
        text = "".join(json.dumps(_plain(row), allow_nan=False) + "\n" for row in rows).encode()
        try:
            if self._file is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            while text:
                text = text[os.write(self._file, text) :]
        except OSError as error:
            raise disk_error("write the metrics", self.path, error, "go on with --resume") from error

    def sync(self) -> None:
        """Forces the rows onto the disk. Call it before a checkpoint: none may be ahead of its rows after a power cut.

        Raises:
            RunError: the disk is full or cannot be written.
        """
        try:
            if self._file is not None:
                os.fsync(self._file)
        except OSError as error:
            raise disk_error("write the metrics", self.path, error, "go on with --resume") from error

    def truncate_after(self, step: int) -> int:
        """Cuts the file back to the rows with `row["step"] <= step`, for a run that goes on from a checkpoint.

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
                draft = self.path.with_name(self.path.name + ".tmp")
                with draft.open("wb") as file:
                    file.writelines(line + b"\n" for line in kept)
                    file.flush()
                    os.fsync(file.fileno())
                draft.replace(self.path)
        except OSError as error:
            raise disk_error("cut back the metrics", self.path, error, "go on with --resume") from error
        return len(kept)

    def close(self) -> None:
        """Closes the file; a later append opens it again."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _plain(row: Row) -> dict[str, Any]:
    if not {"step", "seed"} <= row.keys():
        raise ValueError(f"a row needs step and seed; its fields are {', '.join(row)}")
    return {name: _scalar(name, value) for name, value in row.items()}


def _scalar(name: str, value: Any) -> bool | int | float | str | None:
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


class TensorBoardLog:
    """The numbers of a run as TensorBoard events. Without `tensorboardX` it does nothing; see `available`.

    Fields are grouped: `time/` for clocks, `exploration/` for what was seen and how rewarding it was, and otherwise by
    the word before the first underscore (`model_error` is `model/error`). A field with a slash stays as it is. With
    several seeds each curve's name ends in its seed.

    Args:
        directory: where the event files lie.
        num_seeds: how many seeds the rows are of.
        after_step: of the checkpoint that the run goes on from: events after it are hidden. None for a new run.
    """

    def __init__(self, directory: str | os.PathLike[str], *, num_seeds: int = 1, after_step: int | None = None) -> None:
        self._directory, self._many, self._file = Path(directory), num_seeds > 1, None
        try:
            # Not its SummaryWriter: that writes in a thread, which a full disk ends, and then waits for it for ever.
            from tensorboardX import RecordWriter
            from tensorboardX.proto import event_pb2
        except ImportError:
            return
        self._proto: Any = event_pb2
        with self._reported():
            self._directory.mkdir(parents=True, exist_ok=True)
            # TensorBoard reads the files of a directory in the order of their names.
            self._file = RecordWriter(str(self._directory / f"events.out.tfevents.{time.time():017.6f}"))
            self._write(file_version="brain.Event:2")
            if after_step is not None:
                start = self._proto.SessionLog(status=self._proto.SessionLog.START)
                self._write(step=after_step + 1, session_log=start)
            self._file.flush()

    @property
    def available(self) -> bool:
        """Whether events are written."""
        return self._file is not None

    def append(self, rows: Iterable[Row]) -> None:
        """Writes one event per row with its numbers, null and non-finite ones left out, and flushes.

        Raises:
            ValueError: a field is not a scalar, or `step` or `seed` is missing.
            RunError: the disk is full or cannot be written.
        """
        if self._file is None:
            return
        with self._reported():
            for row in map(_plain, rows):
                suffix = f"/seed_{row['seed']}" if self._many else ""
                numbers = {n: v for n, v in row.items() if n not in ("step", "seed") and isinstance(v, int | float)}
                values = [{"tag": _tag(name) + suffix, "simple_value": value} for name, value in numbers.items()]
                self._write(step=row["step"], summary={"value": values})
            self._file.flush()

    def close(self) -> None:
        """Closes the event file."""
        if self._file is not None:
            with contextlib.suppress(OSError):  # Of a full disk, told by `append` before.
                self._file.close()
            self._file = None

    def _write(self, **fields: Any) -> None:
        assert self._file is not None
        self._file.write(self._proto.Event(wall_time=time.time(), **fields).SerializeToString())

    @contextlib.contextmanager
    def _reported(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise disk_error("write TensorBoard events", self._directory, error, "go on with --resume") from error


_EXPLORATION = {"coverage", "cells", "intrinsic", "imagined", "episodes", "episode", "reward", "dropped"}


def _tag(name: str) -> str:
    if "/" in name:
        return name
    group, _, rest = name.partition("_")
    if name in ("wall_time", "steps_per_second") or name.endswith("_seconds"):
        return f"time/{name}"
    return f"exploration/{name}" if group in _EXPLORATION or not rest else f"{group}/{rest}"


_BAR = "{percentage:3.0f}% |{bar}| {n:,}/{total:,}  "


class Progress:
    """One bar per run on a terminal; elsewhere, such as in a log file, a plain line for every tenth of the run.

    Args:
        total_steps: environment steps of the whole run, each seed's.
        start_step: steps already done, of a run that goes on.
        num_cells: how many cells there are; coverage is then shown as a count.
        stream: where to write, stderr by default.
        live: whether to draw a bar; by default, whether `stream` is a terminal.
    """

    def __init__(
        self,
        total_steps: int,
        *,
        start_step: int = 0,
        num_cells: int | None = None,
        stream: TextIO | None = None,
        live: bool | None = None,
    ) -> None:
        self._stream = stream or sys.stderr
        self._total, self._step, self._num_cells = total_steps, start_step, num_cells
        # Speed is that of the last rounds, since learning began: before that they are quicker, and then comes the
        # time it takes to compile.
        self._recent, self._learning = deque([(time.monotonic(), start_step)], maxlen=20), False
        self._bar = None
        if self._stream.isatty() if live is None else live:
            try:
                from tqdm import tqdm
            except ImportError:
                return
            self._bar = tqdm(
                total=total_steps, initial=start_step, file=self._stream, dynamic_ncols=True, bar_format=_BAR
            )

    def update(self, step: int, rows: Sequence[Row]) -> None:
        """Shows a round: `step` environment steps are done, `rows` are the round's (one per seed)."""
        if not self._learning and _values(rows, "intrinsic_reward"):
            self._recent.clear()
            self._learning = True
        self._recent.append((time.monotonic(), step))
        seconds, steps = (new - old for new, old in zip(self._recent[-1], self._recent[0], strict=True))
        rate = steps / seconds if seconds > 0 else 0.0
        text = _seen(rows, self._num_cells)
        if rate > 0:
            text += f"{rate:.{0 if rate >= 9.95 else 1}f} steps/s"
        if rate > 0 and step < self._total:
            left = (self._total - step) / rate
            text += f"  {duration(left) if left < 60 or left >= 3600 else f'{left / 60:.0f} min'} left"
        done, tenth = step - self._step, 10 * step // self._total > 10 * self._step // self._total
        self._step = step
        if self._bar is not None:
            # In a narrow terminal the numbers matter more than the bar.
            wide = (self._bar.format_dict["ncols"] or 100) >= 100
            self._bar.bar_format = _BAR + text if wide else (_BAR.replace("|{bar}| ", "") + text).replace("  ", " ")
            self._bar.update(done)
        elif tenth:
            count = f"{step:,}".rjust(len(f"{self._total:,}"))
            self.say(f"{100 * step / self._total:3.0f}% | {count}/{self._total:,}  {text}".rstrip())

    def say(self, text: str) -> None:
        """Prints a line, above the bar if there is one."""
        if self._bar is not None:
            self._bar.write(text, file=self._stream)
        else:
            print(text, file=self._stream, flush=True)

    def close(self) -> None:
        """Leaves the bar as it stands and ends its line."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _seen(rows: Sequence[Row], num_cells: int | None) -> str:
    """A round in a few words; of several seeds the median, for the cells the range."""
    text = ""
    if num_cells and (cells := _values(rows, "cells")):
        text += f"cells {_range(f'{min(cells):.0f}', f'{max(cells):.0f}', '-')}/{num_cells}  "
    elif coverage := _values(rows, "coverage"):
        text += f"coverage {100 * statistics.median(coverage):.0f}%  "
    for name, field in (("reward", "intrinsic_reward"), ("error", "model_error")):
        if values := _values(rows, field):
            text += f"{name} {statistics.median(values):.2g}  "
    return text


def _values(rows: Iterable[Row], field: str) -> list[float]:
    values = (_scalar(field, row.get(field)) for row in rows)
    return [float(value) for value in values if isinstance(value, int | float)]


def duration(seconds: float) -> str:
    """A time in words, such as `"45 s"`, `"13 min 52 s"` or `"2 h 05 min"`."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 1:
        return f"{rest} s"
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def summary(
    rows: Sequence[Row],
    *,
    size: str,
    unit: str = "cells",
    files: Mapping[str, str | os.PathLike[str]] | None = None,
) -> str:
    """The table that closes a run, as plain text: a line per seed, of several also the median and the range.

    Args:
        rows: all rows of the run, as `read_metrics` gives them.
        size: how many cells there are to see (`Coverage.size`).
        unit: what a cell is called, such as `"maze cells"` (`Coverage.unit`).
        files: what to point to below the table, name to path.

    Raises:
        ValueError: there are no rows.
        KeyError: a row lacks `step`, `seed`, `cells` or `wall_time`.
    """
    if not rows:
        raise ValueError("rows: a run without rows has no summary")
    head = ("seed", f"{unit} (of {size})", "last new at step", "steps", "time", "steps/s")
    write = (lambda n: f"{n:g}", lambda n: f"{n:,.0f}", lambda n: f"{n:,.0f}", duration, lambda n: f"{n:.1f}")
    seeds = sorted({row["seed"] for row in rows})
    values = [(seed, _outcome([row for row in rows if row["seed"] == seed])) for seed in seeds]
    lines = [tuple(f(v) for f, v in zip((str, *write), (seed, *own), strict=True)) for seed, own in values]
    if len(seeds) > 1:
        columns = list(zip(write, zip(*(own for _, own in values), strict=True), strict=True))
        lines.append(("median", *(f(statistics.median(column)) for f, column in columns)))
        lines.append(("range", *(_range(f(min(column)), f(max(column)), " to ") for f, column in columns)))
    text = table(head, lines).split("\n")
    if len(seeds) > 1:
        text[-2:-2] = [text[1]]
    if dropped := sum(row.get("dropped") or 0 for row in rows):
        text += ["", f"{dropped:,} steps dropped: physics that diverged, which ends an episode and is no data"]
    if files:
        width = max(map(len, files))
        text += ["", *(f"{name.ljust(width)}   {os.fspath(path)}" for name, path in files.items())]
    return "\n".join(text)


def number(value: float | None) -> str:
    """Two digits, or whole numbers from 100 on; `-` for what is not there."""
    return "-" if value is None else f"{value:.2g}" if abs(value) < 100 else f"{value:,.0f}"


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Right-aligned columns with a rule below their names, as plain text."""
    widths = [max(map(len, column)) for column in zip(head, *lines, strict=True)]
    text = ["   ".join(map(str.rjust, line, widths)) for line in (head, *lines)]
    return "\n".join((text[0], "-" * len(text[0]), *text[1:]))


def _outcome(rows: Sequence[Row]) -> tuple[float, float, float, float, float]:
    """One seed's columns of the summary: cells, step at which the last new one was seen, steps, seconds, steps/s."""
    last, most = rows[-1], max(row["cells"] for row in rows)
    found = next(row["step"] for row in rows if row["cells"] == most)
    return most, found, last["step"], last["wall_time"], last["step"] / max(last["wall_time"], 1e-9)


def _range(low: str, high: str, to: str) -> str:
    return low if low == high else f"{low}{to}{high}"
