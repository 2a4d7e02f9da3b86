"""Files that are there whole or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A draft beside `path`, which takes its place when the block ends, and is removed when the block raises.

    The draft's name keeps the ending, which libraries choose a format by: `coverage.tmp.png`.

    Raises:
        OSError: the file system refuses.
    """
    path = Path(path)
    draft = path.with_name(f"{path.stem}.tmp{path.suffix}")
    try:
        yield draft
        draft.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def write_text(path: Path, text: str) -> None:
    """Write a file, whole or not at all. Raises as `replacing`."""
    with replacing(path) as draft:
        draft.write_text(text)


def sync(path: Path) -> None:
    """Force a file, or the names in a directory, onto the disk: a rename may otherwise overtake the data."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
