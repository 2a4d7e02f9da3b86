"""Commands one after the other in a given time: each has its share, and leaves what it does not use to those after it.

A command that crashes, hangs or is too slow costs its own results and no others.
"""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

GRACE = 5.0
"""Seconds that a command has to end in after it is asked to; part of its limit."""
KEPT_LINES = 15
"""Of what a command printed, kept where it did not end well."""


class Ended(NamedTuple):
    """How a command ended."""

    status: str
    """`done`, `failed` (another exit status than 0) or `out of time`."""
    seconds: float
    code: int | None
    """Its exit status, negative for a signal; None where it could not be started."""
    tail: str
    """The last lines that it printed."""


def limit(remaining: float, shares: Sequence[float]) -> float:
    """Seconds for the first of several commands: its share of what remains.

    Args:
        remaining: seconds for all of them.
        shares: of each, in any unit; the first is the next command's.

    Example:
        The second of three, whose first has used up 10 of its 20 seconds:

        >>> limit(100.0, [20, 40, 40]), limit(90.0, [40, 40])
        (20.0, 45.0)
    """
    return max(0.0, remaining) * shares[0] / sum(shares)


def carry_out(command: Sequence[str], seconds: float, log: Path, folder: Path | None = None) -> Ended:
    """Run a command with all that it starts, for so many seconds at most.

    Args:
        command: the words.
        seconds: after which it has ended; it is asked to by SIGTERM a little before.
        log: file that gets what it prints.
        folder: to run it in; by default this process's own.
    """
    began = time.monotonic()
    with log.open("wb") as file:
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=folder,
                start_new_session=True,
            )
        except OSError as error:
            return Ended("failed", 0.0, None, str(error))
        try:
            code, status = process.wait(max(0.0, seconds - GRACE)), "done"
        except subprocess.TimeoutExpired:
            code, status = _end(process), "out of time"
        except BaseException:
            _end(process)
            raise
    if status == "done" and code != 0:
        status = "failed"
    lines = log.read_text(errors="replace").splitlines()
    return Ended(status, round(time.monotonic() - began, 1), code, "\n".join(lines[-KEPT_LINES:]))


def _end(process: "subprocess.Popen[bytes]") -> int:
    """End a command and what it started: first asked, then killed."""
    for signal_number, seconds in ((signal.SIGTERM, GRACE), (signal.SIGKILL, None)):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal_number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(seconds)
    raise AssertionError("SIGKILL is waited for without a limit")
