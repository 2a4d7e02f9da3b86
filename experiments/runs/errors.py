"""The errors that end a run with one message for the person who started it, not with a stack trace."""

import errno
import os
from pathlib import Path


class RunError(Exception):
    """A run cannot start or continue. The text says what is wrong, where, and what to do about it."""


_ADVICE = {
    ("No space left on device", errno.ENOSPC): "free some space on that disk",
    ("Disk quota exceeded", errno.EDQUOT): "free some of your quota",
    ("Permission denied", errno.EACCES): "make it writable, or choose another place with --out",
    ("Operation not permitted", errno.EPERM): "make it writable, or choose another place with --out",
    ("Read-only file system", errno.EROFS): "choose a place that can be written with --out",
    ("Not a directory", errno.ENOTDIR): "a file stands where a directory is needed: move it, or choose another --out",
    ("File exists", errno.EEXIST): "a file stands where a directory is needed: move it, or choose another --out",
    ("Too many open files", errno.EMFILE): "raise the limit on open files (ulimit -n)",
}


def disk_error(doing: str, path: str | os.PathLike[str], error: BaseException, then: str = "") -> RunError:
    """Turns what the file system said into a `RunError`; raise it `from` the original.

    Args:
        doing: what could not be done, such as `"write the checkpoint of step 3000"`.
        path: where.
        error: what was raised. Libraries wrap the system's error in their own; its text is then searched.
        then: what to do once the disk is in order, such as `"continue with --resume"`.

    Returns:
        An error whose text names the path, the reason and the remedy.
    """
    text, number = str(error), getattr(error, "errno", None)
    known = [(reason, remedy) for (reason, code), remedy in _ADVICE.items() if number == code or reason in text]
    first_line = text.strip().splitlines()[0] if text.strip() else type(error).__name__
    reason, remedy = known[0] if known else (getattr(error, "strerror", None) or first_line, "check the disk")
    remedy = f"{remedy}, then {then}" if then else remedy
    return RunError(f"cannot {doing} in {Path(path)}: {reason}. What to do: {remedy}.")
