"""Files that are there whole or not at all."""

import contextlib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A draft beside `path`, which takes its place when the block ends, and is removed when the block raises.

    The draft's name keeps the ending, which libraries choose a format by, and is this process's own:
    `coverage.tmp4711.png`.

    Raises:
        OSError: the file system refuses.
    """
    path = Path(path)
    draft = path.with_name(f"{path.stem}.tmp{os.getpid()}{path.suffix}")
    try:
        yield draft
        draft.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def sweep(directory: Path) -> None:
    """Remove the drafts in a directory whose processes have ended: killed while they wrote."""
    for draft in directory.glob("*.tmp*"):
        process = re.search(r"\.tmp(\d+)", draft.name)
        if process and not _lives(int(process[1])):
            with contextlib.suppress(OSError):
                draft.unlink()


def _lives(process: int) -> bool:
    if os.name == "nt":
        return True  # There `os.kill` kills, whatever the signal.
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def write_text(path: Path, text: str) -> None:
    """Write a file, whole or not at all. Raises as `replacing`."""
    with replacing(path) as draft:
        draft.write_text(text)


MOST_JSON = 16 * 2**20
"""Bytes of a file that is read as one piece of JSON; ours have some kilobytes."""


def parse_json(text: str) -> Any:
    """JSON of anybody's.

    Raises:
        ValueError: it is not JSON, or nested so deeply that Python cannot read it.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file of anybody's.

    Raises:
        OSError: it cannot be read.
        ValueError: it is too large, not JSON, or no object.
    """
    data = parse_json(read_text(path))
    if not isinstance(data, dict):
        raise ValueError(f"it holds {type(data).__name__}, not an object")
    return data


def read_text(path: Path) -> str:
    """A text file of at most `MOST_JSON` bytes. Raises as `read_json`."""
    size = path.stat().st_size
    if size > MOST_JSON:
        raise ValueError(f"it has {size:,} bytes; at most {MOST_JSON:,} are read")
    return path.read_text()


def sync(path: Path) -> None:
    """Force a file, or the names in a directory, onto the disk: a rename may otherwise overtake the data."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
