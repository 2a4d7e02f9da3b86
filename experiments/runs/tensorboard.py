"""The numbers of a run as TensorBoard events."""

import contextlib
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from experiments.runs.errors import disk_error
from experiments.runs.metrics import Row, plain
from experiments.runs.rows import tensorboard_tag


class TensorBoardLog:
    """The numbers of a run as TensorBoard events. Without `tensorboardX` it does nothing; see `available`.

    Fields are grouped as `experiments.runs.rows` says. With several seeds each curve's name ends in its seed.

    Args:
        directory: where the event files lie.
        num_seeds: how many seeds the rows are of.
        after_step: of the checkpoint that the run is resumed from: events after it are hidden. None for a new run.
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
            for row in map(plain, rows):
                suffix = f"/seed_{row['seed']}" if self._many else ""
                numbers = {n: v for n, v in row.items() if n not in ("step", "seed") and isinstance(v, int | float)}
                values = [{"tag": tensorboard_tag(name) + suffix, "simple_value": v} for name, v in numbers.items()]
                self._write(step=row["step"], summary={"value": values})
            self._file.flush()

    def close(self) -> None:
        """Closes the event file."""
        if self._file is not None:
            with contextlib.suppress(OSError):  # Of a full disk, which `append` has reported.
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
            raise disk_error("write TensorBoard events", self._directory, error, "continue with --resume") from error
