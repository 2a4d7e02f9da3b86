"""What the short commands show of how far they are: a bar on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TextIO, TypeVar

from experiments.analysis.tables import duration

T = TypeVar("T")

PATIENCE = 5.0
"""Seconds between two plain lines, at least: nobody needs to read what is done at once."""


class Progress:
    """How much of one thing is done, on stderr. A bar goes away when it is closed.

    Args:
        what: is being done, such as `"drawing"`.
        total: how much there is to do.
        stream: where to write, stderr by default.
        live: whether to draw a bar; by default, whether `stream` is a terminal.
    """

    def __init__(self, what: str, total: int, *, stream: TextIO | None = None, live: bool | None = None) -> None:
        self._stream = stream or sys.stderr
        self._what, self._total, self._done = what, total, 0
        self._start = self._said = time.monotonic()
        self._bar = None
        if self._stream.isatty() if live is None else live:
            try:
                from tqdm import tqdm
            except ImportError:
                return
            self._bar = tqdm(total=total, desc=what, file=self._stream, dynamic_ncols=True, leave=False)

    def reach(self, done: int) -> None:
        """So much is done; never less than before."""
        step, tenth = done - self._done, 10 * done // self._total > 10 * self._done // self._total
        if step <= 0:
            return
        self._done = done
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(step)
        elif tenth and done < self._total and now - self._said >= PATIENCE:
            left = (now - self._start) / done * (self._total - done)
            share = f"{100 * done / self._total:3.0f}%"
            print(f"{self._what} {share} | {done:,}/{self._total:,}  {duration(left)} left", file=self._stream)
            self._stream.flush()
            self._said = now

    def close(self) -> None:
        """Takes the bar away."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def track(what: str, items: Iterable[T], total: int) -> Iterator[T]:
    """The items, one after the other, `total` of them; `Progress` shows how many have been dealt with."""
    progress = Progress(what, total)
    try:
        for done, item in enumerate(items):
            progress.reach(done)
            yield item
        progress.reach(total)
    finally:
        progress.close()
