"""One process at a time writes to a run's directory.

The system lets go of the lock when the process that holds it ends, however it ends, so a kill leaves nothing that would
have to be removed.
"""

import contextlib
import datetime
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

from experiments.runs.errors import RunError, disk_error

NAME = ".lock"
"""Of the file in the directory: who holds it, for people."""

if sys.platform == "win32":
    import msvcrt

    def _try(descriptor: int) -> None:
        # A byte that nobody writes: Windows keeps others from reading what is locked.
        os.lseek(descriptor, 1 << 30, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _try(descriptor: int) -> None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def claimed(directory: Path, *, new: bool = False) -> Iterator[None]:
    """Own a directory while the block runs; it is made if it is not there.

    Args:
        directory: of a run.
        new: whether it must not be there yet.

    Raises:
        FileExistsError: it is there, and `new` is set.
        RunError: another process owns it, which the message names; or it cannot be made or written to.
    """
    try:
        directory.mkdir(parents=True, exist_ok=not new)
    except OSError as error:
        if new and isinstance(error, FileExistsError):
            raise
        raise disk_error("start the run", directory, error, "start it again") from error
    path = directory / NAME
    descriptor = _acquire(path)
    try:
        yield
    finally:
        # Removed while it is held, so that nobody can hold a file that is no longer there unnoticed (`_acquire`).
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(descriptor)


def _acquire(path: Path) -> int:
    """A descriptor of the file, locked and signed."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise disk_error("lock the run", path.parent, error) from error
        try:
            _try(descriptor)
        except OSError as error:
            holder = _read(descriptor)
            os.close(descriptor)
            if not isinstance(error, BlockingIOError | PermissionError):
                raise disk_error("lock the run", path.parent, error) from error
            raise RunError(
                f"{path.parent} belongs to {holder or 'another process'}. What to do: wait until that has ended, or "
                "give another --out."
            ) from None
        if _is_still(path, descriptor):
            break
        # Its holder removed it between our opening and our locking it.
        os.close(descriptor)
    now = datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.lseek(descriptor, 0, os.SEEK_SET)
        os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}, since {now}".encode())
    return descriptor


def _is_still(path: Path, descriptor: int) -> bool:
    """Whether `path` is still the file that is open."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _read(descriptor: int) -> str:
    """What the holder wrote."""
    with contextlib.suppress(OSError):
        os.lseek(descriptor, 0, os.SEEK_SET)
        return os.read(descriptor, 1000).decode(errors="replace").strip()
    return ""
