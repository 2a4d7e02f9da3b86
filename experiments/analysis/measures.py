"""What figures measure: a field of rows over steps, and one number of it for each seed."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.analysis.load import held, series
from experiments.analysis.statistics import grid_of


class Measure(NamedTuple):
    """A measure of runs."""

    name: str
    """Of the curve, with its unit: an axis's label."""
    fields: tuple[str, ...]
    """Of rows; the first that the runs have."""
    score: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """`(steps [T], values [S, T]) -> [S]`, one number of each seed's curve."""
    score_name: str
    """With its unit."""
    unit: str = ""
    """Of a difference between two scores, as words after a number."""
    higher_is_better: bool = True
    over: str = "environment steps"
    is_open: bool = False
    """Whether a curve that never comes to 1 has no score, and counts as the last step."""
    can_change: bool = False
    """Whether it is asked how its level changes."""
    needs_walk: bool = False
    needs_returns: bool = False
    """Whether runs must have been evaluated, where they are to be."""


def curves(rows: Sequence[dict[str, Any]], measure: Measure) -> tuple[np.ndarray, np.ndarray] | None:
    """A measure over steps: `(steps [T], values [S, T])`; None where the rows have no such field.

    Args:
        rows: of runs that differ in their seed alone.
        measure: what is measured.
    """
    for field in measure.fields:
        steps, values = series(rows, field)
        there = np.isfinite(values).any(axis=0)
        if there.any():
            values = values[:, there]
            return steps[there], held(values) if field == "coverage" else values
    return None


def mean_height(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean of curves over steps, `[S]`, as `experiments.compare` has it: the area under them, over its width."""
    grid = grid_of(int(steps[0]), int(steps[-1]))
    return values[:, np.searchsorted(steps, grid, side="right") - 1].mean(axis=1)


def whole_at(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The step, end of its round, at which all had been seen; where it never was, the last step."""
    seen = values >= 1.0 - 1e-6
    return np.where(seen.any(axis=1), steps[seen.argmax(axis=1)], steps[-1]).astype(float)


def staying(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean over the second half of the steps, as a multiple of the mean over the first half, `[S]`."""
    late = 2 * steps > steps[-1]
    if late.all():  # so short that the warm-up is half of it
        late = steps >= steps[-1]
    first = np.nanmean(values[:, ~late], axis=1) if (~late).any() else values[:, 0]
    return np.nanmean(values[:, late], axis=1) / np.maximum(first, 1e-12)


def rising(steps: np.ndarray, values: np.ndarray, until: np.ndarray) -> np.ndarray:
    """The same of the steps until a step of each seed's own, `until [S]`, from the first value on, `[S]`; NaN where
    there are fewer than two values by then.
    """
    found = []
    for line, last in zip(values, until, strict=True):
        there = np.isfinite(line) & (steps <= last)
        own, at = line[there], steps[there]
        late = 2 * at > at[0] + at[-1] if len(own) > 1 else np.zeros(len(own), bool)
        found.append(own[late].mean() / max(own[~late].mean(), 1e-12) if late.any() else np.nan)
    return np.array(found)


def ending(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean over the last tenth of the steps; of a seed that has no value there, its last one."""
    late = steps >= 0.9 * steps[-1]
    found = []
    for line in values:
        own = line[late & np.isfinite(line)]
        finite = line[np.isfinite(line)]
        found.append(own.mean() if len(own) else finite[-1] if len(finite) else np.nan)
    return np.array(found)


def _percent(score: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda steps, values: 100.0 * score(steps, values)


def _last(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    return values[:, -1]


POINTS_OF_COVERAGE = "points of coverage"
COVERAGE = Measure(
    "share seen", ("coverage",), _percent(mean_height), "mean height of the curve, %", POINTS_OF_COVERAGE
)
CELLS = COVERAGE._replace(score=_percent(_last), score_name="share seen at the end, %")
WHOLE = COVERAGE._replace(
    score=whole_at,
    score_name="step at which all had been seen",
    unit="steps",
    higher_is_better=False,
    is_open=True,
)
VARIANCE = Measure(
    "equation 1",
    ("variance",),
    staying,
    "mean of the second half of the steps, as a multiple of that of the first",
    can_change=True,
)
RETURN = Measure(
    "return",
    ("eval/return", "episode_return"),
    ending,
    "return, mean of the last tenth of the steps",
    "of return",
    needs_returns=True,
)
VISITS = CELLS._replace(needs_walk=True)
