"""How the command lines behave as processes: interrupted, terminated, or with nobody left who reads what they print."""

import _thread
import argparse
import contextlib
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

from experiments.runs.errors import RunError

INTERRUPTED, TERMINATED = 130, 143
"""Exit statuses after Ctrl-C and after SIGTERM, as shells have them."""


HELD = "JAXPLORE_HELD"
"""In the environment of a process whose standard input is a pipe that another one holds open. It stops when that
closes, as it does when the other one ends, however that ends."""
PATIENCE = 60.0
"""Seconds in which a process that is held stops by itself, or is stopped where it stands."""


class Terminated(KeyboardInterrupt):
    """SIGTERM: what a batch system sends before it kills. Unwinds as Ctrl-C does."""


def status_of(stop: KeyboardInterrupt) -> int:
    """The exit status of a process that was stopped."""
    return TERMINATED if isinstance(stop, Terminated) else INTERRUPTED


def be_brief() -> None:
    """Have Python say what ends this process in one line where a person can do something about it.

    For what `main` cannot catch: Ctrl-C while modules are imported, or a second one while the first is answered, and
    packages that are missing. Everything else keeps its traceback, and with `--debug` all do.
    """
    if "--debug" in sys.argv:
        return
    usual = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, where: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print("\nStopped.", file=sys.stderr)
        elif issubclass(kind, RunError):
            print(f"error: {error}", file=sys.stderr)
        else:
            usual(kind, error, where)

    sys.excepthook = hook
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop_at_once)


def _stop_at_once(number: int, frame: FrameType | None) -> None:
    # While modules are imported. An exception would not do: packages catch it where they try what can be imported, and
    # C code reports it and raises another.
    os.write(2, b"\nStopped.\n")
    os._exit(INTERRUPTED)


def carry_out(main: Callable[[], int]) -> None:
    """Call a command's `main` as this process's only purpose, and exit with its status.

    SIGTERM stops it as Ctrl-C does; Ctrl-C itself is left to the process that holds it, if one does (`HELD`). What it
    prints when its reader has gone, such as `head` or a terminal that was closed, goes nowhere; it does not end for
    that.
    """
    sys.stdout, sys.stderr = _Patient(sys.stdout), _Patient(sys.stderr)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _terminate)
        if signal.getsignal(signal.SIGINT) is _stop_at_once:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if hasattr(signal, "SIGHUP"):
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        if os.environ.pop(HELD, None):
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            threading.Thread(target=_stop_when_let_go, daemon=True).start()
    try:
        status = main()
    except KeyboardInterrupt as stop:
        print("\nStopped.", file=sys.stderr)
        status = status_of(stop)
    sys.exit(status)


def _stop_when_let_go() -> None:
    with contextlib.suppress(OSError):
        while os.read(0, 1024):
            pass
    if os.name == "nt":
        _thread.interrupt_main(signal.SIGTERM)
    else:
        os.kill(os.getpid(), signal.SIGTERM)  # Which ends a sleep, too.
    time.sleep(PATIENCE)
    os._exit(TERMINATED)


def _terminate(number: int, frame: FrameType | None) -> None:
    # Once: what it unwinds is not to be stopped a second time.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise Terminated


def add_flag(parser: argparse.ArgumentParser) -> None:
    """Give a command line `--debug`, for `show_cause`."""
    parser.add_argument("--debug", action="store_true", help="show the traceback below the message of an error")


def show_cause(error: BaseException, *, debug: bool) -> None:
    """Below a message: the traceback of what caused it, if that was asked for."""
    if debug:
        traceback.print_exception(error, file=sys.stderr)


class _Patient:
    """A text stream whose reader may go away."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError:
            self._silence()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            self._silence()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _silence(self) -> None:
        """Let what is still to come, and what is in the buffer, go nowhere."""
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
