"""What a run prints while it runs: a progress bar, or plain lines where there is no terminal."""

import statistics
import sys
import time
from collections import deque
from collections.abc import Iterable, Sequence
from typing import TextIO

from experiments.analysis.tables import duration, number, span
from experiments.runs.metrics import Row, scalar

_BAR = "{percentage:3.0f}% |{bar}| {n:,}/{total:,}  "


class Progress:
    """One bar per run on a terminal; elsewhere, such as in a log file, a plain line for every tenth of the run.

    Args:
        total_steps: environment steps of the whole run, each seed's.
        start_step: steps already done, of a run that is resumed.
        num_cells: how many cells there are; coverage is then shown as a count.
        warm_up: steps of random actions at the start; what is left after them cannot be told from them.
        stream: where to write, stderr by default.
        live: whether to draw a bar; by default, whether `stream` is a terminal.
    """

    def __init__(
        self,
        total_steps: int,
        *,
        start_step: int = 0,
        num_cells: int | None = None,
        warm_up: int = 0,
        stream: TextIO | None = None,
        live: bool | None = None,
    ) -> None:
        self._stream = stream or sys.stderr
        self._total, self._step, self._num_cells, self._warm_up = total_steps, start_step, num_cells, warm_up
        # Speed is that of the last rounds, since learning began: before that they are quicker, and then comes the
        # time it takes to compile.
        self._recent, self._learning = deque([(time.monotonic(), start_step)], maxlen=20), False
        self._bar = None
        if self._stream.isatty() if live is None else live:
            try:
                from tqdm import tqdm
            except ImportError:
                return
            self._bar = tqdm(
                total=total_steps, initial=start_step, file=self._stream, dynamic_ncols=True, bar_format=_BAR
            )

    def update(self, step: int, rows: Sequence[Row]) -> None:
        """Shows a round: `step` environment steps are done, `rows` are the round's (one per seed)."""
        if not self._learning and step > self._warm_up:
            self._recent.clear()
            self._learning = True
        self._recent.append((time.monotonic(), step))
        seconds, steps = (new - old for new, old in zip(self._recent[-1], self._recent[0], strict=True))
        rate = steps / seconds if seconds > 0 else 0.0
        text = seen(rows, self._num_cells)
        if rate > 0:
            text += f"{rate:.{0 if rate >= 9.95 else 1}f} steps/s"
        if rate > 0 and self._learning and step < self._total:
            left = (self._total - step) / rate
            text += f"  {duration(left) if left < 60 or left >= 3600 else f'{left / 60:.0f} min'} left"
        done, tenth = step - self._step, 10 * step // self._total > 10 * self._step // self._total
        self._step = step
        if self._bar is not None:
            # In a narrow terminal the numbers matter more than the bar.
            wide = (self._bar.format_dict["ncols"] or 100) >= 100
            self._bar.bar_format = _BAR + text if wide else (_BAR.replace("|{bar}| ", "") + text).replace("  ", " ")
            self._bar.update(done)
        elif tenth:
            count = f"{step:,}".rjust(len(f"{self._total:,}"))
            self.say(f"{100 * step / self._total:3.0f}% | {count}/{self._total:,}  {text}".rstrip())

    def say(self, text: str) -> None:
        """Prints a line, above the bar if there is one."""
        if self._bar is not None:
            self._bar.write(text, file=self._stream)
        else:
            print(text, file=self._stream, flush=True)

    def close(self) -> None:
        """Leaves the bar as it stands and ends its line."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


SHOWN = (
    ("reward", "intrinsic_reward"),
    ("error", "model_error"),
    ("return", "episode_return"),
    ("eval return", "eval/return"),
)
"""Fields that are shown, where rows have them."""


def seen(rows: Sequence[Row], num_cells: int | None) -> str:
    """A round in a few words; of several seeds the median, for the cells the range."""
    text = ""
    if num_cells and (cells := _values(rows, "cells")):
        text += f"cells {span(f'{min(cells):.0f}', f'{max(cells):.0f}', '-')}/{num_cells}  "
    elif coverage := _values(rows, "coverage"):
        text += f"coverage {100 * statistics.median(coverage):.0f}%  "
    for name, field in SHOWN:
        if values := _values(rows, field):
            text += f"{name} {number(statistics.median(values))}  "
    return text


def _values(rows: Iterable[Row], field: str) -> list[float]:
    values = (scalar(field, row.get(field)) for row in rows)
    return [float(value) for value in values if isinstance(value, int | float)]
