"""Commands as processes of this machine, so many at a time."""

import contextlib
import os
import signal
import subprocess
import sys
import sysconfig
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments import process

POLL = 0.5
"""Seconds between two looks at the processes."""
GRACE = 20.0
"""Seconds that processes have to stop by themselves; they are killed then, which a run can bear at any moment."""
FEWER = ": give fewer --processes"
"""What to do where memory was short, for a command that has that flag."""
TAIL = 2**16
"""Bytes at the end of a log in which an error is looked for."""


class Job(NamedTuple):
    """A command to carry out."""

    key: int
    words: Sequence[str]
    """The words after the Python interpreter."""
    log: Path
    """What it prints is appended to this file."""


class End(NamedTuple):
    """How a process ended."""

    status: int
    """As `subprocess` has it: negative after a signal."""
    error: str | None
    """What it said was wrong, in a line; None: nothing was."""


class Process(NamedTuple):
    """A command that is being carried out."""

    job: Job
    popen: subprocess.Popen[bytes]
    before: int
    """Bytes that the log had before."""


def run_all(
    jobs: Sequence[Job],
    at_a_time: int,
    tell: Callable[[Sequence[int], Mapping[int, End]], Any],
    variables: Mapping[str, str] | None = None,
) -> dict[int, End]:
    """Carry out commands, so many at a time, each in a process that this one holds: it stops when this one ends.

    What interrupts this stops them all before it goes on; a second Ctrl-C kills them.

    Args:
        jobs: in the order in which they start.
        at_a_time: how many processes there are at most.
        tell: called time and again with the keys of those at work, and how others have ended.
        variables: of the environment, in addition to this process's.

    Returns:
        How each has ended.
    """
    waiting, running, ended = deque(jobs), list[Process](), dict[int, End]()
    try:
        while waiting or running:
            while waiting and len(running) < at_a_time:
                job = waiting.popleft()
                try:
                    running.append(start(job, variables or {}))
                except OSError as error:
                    ended[job.key] = End(-1, f"cannot be started ({error})")
            tell([one.job.key for one in running], ended)
            time.sleep(POLL)
            for one in [one for one in running if one.popen.poll() is not None]:
                running.remove(one)
                ended[one.job.key] = end(one, FEWER)
        tell([], ended)
    finally:
        stop(running)
    return ended


def start(job: Job, variables: Mapping[str, str]) -> Process:
    """Start a command in a process that this one holds: it stops when this one ends.

    Args:
        job: the command.
        variables: of the environment, in addition to this process's.

    Raises:
        OSError: it cannot be started.
    """
    # What this process can import it can, too: beside Python's own folders, which it finds by itself.
    own = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
    path = os.pathsep.join(entry for entry in sys.path if entry and not entry.startswith(own))
    environment = {**os.environ, "PYTHONPATH": path, **variables, process.HELD: "1"}
    with job.log.open("ab") as log:
        before = log.tell()
        command = [sys.executable, *job.words]
        popen = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment)
    return Process(job, popen, before)


def stop(running: Sequence[Process]) -> None:
    """End processes: by asking, then by force."""
    if not running:
        return
    deadline = time.monotonic() + GRACE
    print(f"\nStopping {len(running)} processes", file=sys.stderr, flush=True)
    try:
        for one in running:
            one.popen.terminate()
            _let_go(one)
        for one in running:
            one.popen.wait(max(0.0, deadline - time.monotonic()))
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        for one in running:
            one.popen.kill()
        for one in running:
            one.popen.wait()


def _let_go(one: Process) -> None:
    if one.popen.stdin is not None:
        with contextlib.suppress(OSError):
            one.popen.stdin.close()


def end(one: Process, remedy: str = "") -> End:
    """How a process that has ended did; `remedy` is what to do where memory may have been short."""
    status = one.popen.returncode
    _let_go(one)
    return End(status, None if status == 0 else _reason(status, one.job.log, one.before, remedy))


def _reason(status: int, log: Path, before: int, remedy: str) -> str:
    """Why a process failed: the error that it printed; without one, the signal, or the last thing that it printed."""
    try:
        with log.open("rb") as file:
            file.seek(max(before, os.fstat(file.fileno()).st_size - TAIL))
            lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        lines = []
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    if errors:
        return errors[-1]
    if status in (process.INTERRUPTED, process.TERMINATED):
        return "it was stopped"
    if status < 0:
        name = signal.Signals(-status).name if -status in set(signal.Signals) else f"signal {-status}"
        hint = f", perhaps because memory was short{remedy}" if name == "SIGKILL" else ""
        return f"it was ended by {name}{hint}"
    return f"exit status {status}" + (f" after: {lines[-1]}" if lines else "")
