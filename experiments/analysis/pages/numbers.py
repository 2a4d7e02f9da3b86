"""Curves as few, short numbers: means, spreads, ticks of an axis."""

import math
from typing import NamedTuple

import numpy as np

from experiments.analysis.pages.contents import Panel, Series

MOST_POINTS = 300
"""Points of a curve on the page; the CSV has all."""
LOG_FROM = 100.0
"""Values that spread over more than this factor get a log axis."""


class Summary(NamedTuple):
    """A series over its seeds."""

    mean: np.ndarray
    """`[T]`, of the seeds that have a value; NaN where none has."""
    spread: np.ndarray
    """`[T]`, standard deviation over these seeds (divided by n - 1); NaN where fewer than two have a value."""
    known: np.ndarray
    """`[T]`, seeds that have a value."""


class Scale(NamedTuple):
    """What an axis spans."""

    low: float
    high: float
    log: bool = False

    def at(self, values: np.ndarray) -> np.ndarray:
        """Where values lie, 0 at `low` and 1 at `high`; NaN where an axis has no place for them."""
        if not self.log:
            return (values - self.low) / (self.high - self.low)
        with np.errstate(invalid="ignore", divide="ignore"):
            logs = np.log(np.where(values > 0, values, np.nan))
        return (logs - math.log(self.low)) / (math.log(self.high) - math.log(self.low))


def short(value: float, digits: int = 3) -> str:
    """So many digits, or whole numbers from 100 on; `-` for what is not finite."""
    if not math.isfinite(value):
        return "-"
    size = abs(value)
    if size >= 1e7 or 0 < size < 1e-3:
        return f"{value:.{digits - 1}e}"
    return f"{value:,.0f}" if size >= 99.95 else f"{value:.{digits}g}"


def step_name(step: float) -> str:
    """Steps on an axis, such as `"2,000"`, `"10k"` or `"1.5M"`."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if abs(step) >= 10 * size or (unit == "M" and abs(step) >= size):
            return f"{step / size:g}{unit}"
    return f"{step:,.6g}"


def finite(values: np.ndarray) -> np.ndarray:
    """Values as floats, NaN in place of infinities."""
    values = np.asarray(values, float)
    return np.where(np.isfinite(values), values, np.nan)


def summary(values: np.ndarray) -> Summary:
    """Mean and spread over seeds, `[S, T]`."""
    values = finite(values)
    known = np.isfinite(values)
    count = known.sum(axis=0)
    mean = np.where(count > 0, np.where(known, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
    squares = np.where(known, values - mean, 0.0) ** 2
    spread = np.where(count > 1, np.sqrt(squares.sum(axis=0) / np.maximum(count - 1, 1)), np.nan)
    return Summary(mean, spread, count)


def thin(series: Series, most: int = MOST_POINTS) -> Series:
    """A series of at most so many points, evenly chosen, the first and the last among them."""
    total = len(series.steps)
    if total <= most:
        return series
    at = np.linspace(0, total - 1, most).round().astype(int)
    return series._replace(steps=np.asarray(series.steps)[at], values=np.asarray(series.values)[:, at])


def steps_scale(panel: Panel) -> Scale:
    """From 0 (or the first step, where that is negative) to the last step of all series."""
    ends = [float(step) for one in panel.series if len(one.steps) for step in (one.steps[0], one.steps[-1])]
    low, high = min([0.0, *ends]), max([0.0, *ends])
    return Scale(low, high if high > low else low + 1.0)


def values_scale(panel: Panel) -> Scale:
    """All values and the ceiling; from 0 where none is below it and the axis is not logarithmic."""
    values = np.concatenate([[], *(finite(one.values).ravel() for one in panel.series)])
    values = values[np.isfinite(values)]
    if not len(values):
        return Scale(0.0, 1.0 if panel.ceiling is None else max(panel.ceiling, 1e-9))
    low, high = float(values.min()), float(values.max())
    if panel.ceiling is None and low > 0 and np.quantile(values, 0.98) > LOG_FROM * np.quantile(values, 0.02):
        return Scale(low / 1.1, high * 1.1, log=True)
    if panel.ceiling is not None:
        high = max(high, panel.ceiling)
    low = min(0.0, low)
    if low == high:  # All values are 0.
        return Scale(0.0, 1.0)
    room = 0.04 * (high - low) or 1.0
    return Scale(low if low == 0 else low - room, high if high == 0 else high + room)


def ticks(scale: Scale, most: int) -> list[float]:
    """Round numbers on an axis, at most about so many."""
    if scale.log:
        first, last = math.floor(math.log10(scale.low)), math.ceil(math.log10(scale.high))
        every = max(1, math.ceil((last - first) / (most + 1)))
        parts = (1, 2, 5) if last - first <= 2 else (1,)
        found = [part * 10.0**power for power in range(first, last + 1, every) for part in parts]
    else:
        rough = (scale.high - scale.low) / max(most, 1)
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(part * power for part in (1, 2, 2.5, 5, 10) if part * power >= rough * (1 - 1e-9))
        found = [n * step for n in range(math.ceil(scale.low / step - 1e-9), math.floor(scale.high / step + 1e-9) + 1)]
    return [tick for tick in found if scale.low * (1 - 1e-9) <= tick <= scale.high * (1 + 1e-9) or tick == 0]
