"""What several seeds print while each runs in a process of its own: a line for each on a terminal, plain lines
elsewhere.
"""

import heapq
import os
import shutil
import statistics
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TextIO

from experiments.analysis.tables import duration
from experiments.runs.config import RunConfig
from experiments.runs.console import seen
from experiments.runs.metrics import Row

RECENT = 20
"""Rounds that the pace of a seed is taken from."""


class Screen:
    """Lines on a terminal that are drawn over; elsewhere only what is said.

    Args:
        stream: where to write, stderr by default.
        live: whether lines are drawn over; by default, whether `stream` is a terminal that can do that.
    """

    def __init__(self, stream: TextIO | None = None, live: bool | None = None) -> None:
        self._stream = stream or sys.stderr
        able = self._stream.isatty() and os.name != "nt" and os.environ.get("TERM", "dumb") != "dumb"
        self.live = able if live is None else live
        self._drawn = 0

    def say(self, text: str) -> None:
        """Prints a line; where lines are drawn over, above them."""
        self.clear()
        print(text, file=self._stream, flush=True)

    def clear(self) -> None:
        """Takes away what is drawn."""
        if self._drawn:
            self._write(f"\x1b[{self._drawn}F\x1b[J")
            self._drawn = 0

    def draw(self, lines: Sequence[str]) -> None:
        """Draws lines over those drawn before; where they do not fit, the last one."""
        columns, height = shutil.get_terminal_size()
        if len(lines) > height - 1:  # The cursor cannot go back to what has scrolled away.
            lines = lines[-1:]
        back = f"\x1b[{self._drawn}F" if self._drawn else ""
        self._write(back + "".join(f"{line[: columns - 1]}\x1b[K\n" for line in lines) + "\x1b[J")
        self._drawn = len(lines)

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


class Display(Screen):
    """How far all seeds are, on stderr: on a terminal lines that are drawn over, elsewhere one for each tenth of all.

    Args:
        config: of all of them.
        at_a_time: how many run at once.
        num_cells: how many cells there are; coverage is then shown as a count.
        stream: where to write, stderr by default.
        live: whether lines are drawn over; by default, whether `stream` is a terminal that can do that.
    """

    def __init__(
        self,
        config: RunConfig,
        at_a_time: int,
        num_cells: int | None = None,
        *,
        stream: TextIO | None = None,
        live: bool | None = None,
    ) -> None:
        super().__init__(stream, live)
        self._config, self._at_a_time, self._num_cells = config, at_a_time, num_cells
        self._steps = {config.seed + i: 0 for i in range(config.num_seeds)}
        self._ended: set[int] = set()
        self._recent = {seed: deque[tuple[float, int]](maxlen=RECENT) for seed in self._steps}
        self._tenths = 0

    def begin(self, steps: Mapping[int, int], ended: Sequence[int]) -> None:
        """Where seeds are that have taken steps before, and which of them will take no more."""
        self._steps.update(steps)
        self._ended.update(ended)
        self._tenths = self._tenth()

    def update(self, rows: Mapping[int, Row | None]) -> None:
        """Shows where the seeds at work are: the last row of each; None: it has none yet."""
        for seed, row in rows.items():
            if row is not None:
                self._note(seed, row["step"])
        if self.live:
            self.draw([*(self._line(seed, row) for seed, row in rows.items()), f"{'all':<9}{self._all(rows)}"])
        elif self._tenth() > self._tenths:
            self._tenths = self._tenth()
            at = (f"seed {seed} at {row['step']:,}, {self._seen(row, 1)}" for seed, row in rows.items() if row)
            self.say("  ".join([self._all(rows), "; ".join(at)]).rstrip())

    def end(self, seed: int, row: Row | None, error: str | None) -> None:
        """Tells of a seed that works no longer: its last row, and what went wrong."""
        self._ended.add(seed)
        if row is not None:
            self._note(seed, row["step"])
        if error is not None or row is None:
            self.say(f"Seed {seed} failed after step {self._steps[seed]:,}: {error}")
        else:
            self.say(f"Seed {seed} is done: {self._seen(row, 1)} in {duration(row['wall_time'])}")

    def _note(self, seed: int, step: int) -> None:
        """A seed is at a step. Its pace is that of rounds that learn, from the end of the first one in this process on:
        those before are quicker, and that one waits for the compiler.
        """
        before, self._steps[seed] = self._steps[seed], step
        if step < before:  # Back to its checkpoint.
            self._recent[seed].clear()
        elif step > before and step > self._config.explorer.warm_up_steps:
            self._recent[seed].append((time.monotonic(), step))

    def _line(self, seed: int, row: Row | None) -> str:
        head, most = f"seed {seed:<4}", self._config.steps
        if row is None:
            return f"{head} starting"
        return (
            f"{head}{100 * row['step'] / most:3.0f}% | {row['step']:>{len(f'{most:,}')},}/{most:,}  {self._seen(row)}"
        )

    def _all(self, rows: Mapping[int, Row | None]) -> str:
        total, steps = self._total(), sum(self._steps.values())
        paces = {seed: pace for seed in rows if (pace := self._pace(seed))}
        done = sum(self._steps[seed] >= self._config.steps for seed in self._ended)
        text = f"{100 * steps / total:3.0f}% | {steps:>{len(f'{total:,}')},}/{total:,}  "
        text += f"{done} of {len(self._steps)} done"
        if paces:
            rate = sum(paces.values())
            text += f"  {rate:.{0 if rate >= 9.95 else 1}f} steps/s  {duration(self._left(rows, paces))} left"
        return text

    def _left(self, rows: Mapping[int, Row | None], paces: Mapping[int, float]) -> float:
        """Seconds until the last seed is done, those that wait each starting when a place is free."""
        usual, left = statistics.mean(paces.values()), {seed: self._config.steps - n for seed, n in self._steps.items()}
        ends = [left[seed] / paces.get(seed, usual) for seed in rows]
        heapq.heapify(ends)
        for seed in left:
            if seed not in rows and seed not in self._ended:
                start = heapq.heappop(ends) if len(ends) >= self._at_a_time else 0.0
                heapq.heappush(ends, start + left[seed] / usual)
        return max(ends)

    def _pace(self, seed: int) -> float | None:
        """Steps per second."""
        if len(self._recent[seed]) < 2:
            return None
        (then, before), (now, after) = self._recent[seed][0], self._recent[seed][-1]
        return (after - before) / (now - then) if now > then else None

    def _seen(self, row: Row, parts: int | None = None) -> str:
        """What a row says, as the display of one run has it; of that the first so many parts."""
        return "  ".join(seen([row], self._num_cells).split("  ")[:parts]).rstrip()

    def _total(self) -> int:
        return self._config.steps * self._config.num_seeds

    def _tenth(self) -> int:
        return 10 * sum(self._steps.values()) // self._total()
