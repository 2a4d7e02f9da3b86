"""What figures measure: a field of rows over steps, and one number of it for each seed."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.analysis.load import held, series
from experiments.analysis.statistics import POINTS


class Measure(NamedTuple):
    """A measure of runs."""

    name: str
    """Of the curve, with its unit: an axis's label."""
    fields: tuple[str, ...]
    """Of rows; the first that the runs have."""
    score: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """`(steps [T], values [S, T]) -> [S]`, one number of each seed's curve."""
    score_name: str
    higher_is_better: bool = True
    over: str = "environment steps"
    needs_walk: bool = False


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
    """Mean of curves over steps, from the first step on that they have: the area under them, over its width."""
    grid = np.unique(np.linspace(steps[0], steps[-1], POINTS).round().astype(int))
    return values[:, np.searchsorted(steps, grid, side="right") - 1].mean(axis=1)


def whole_at(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The step, end of its round, at which all had been seen; where it never was, the last step."""
    seen = values >= 1.0 - 1e-6
    return np.where(seen.any(axis=1), steps[seen.argmax(axis=1)], steps[-1]).astype(float)


def staying(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean over the second half of the steps, as a multiple of the mean over the first half."""
    late = 2 * steps > steps[-1]
    if late.all():  # so short that the warm-up is half of it
        late = steps >= steps[-1]
    first = np.nanmean(values[:, ~late], axis=1) if (~late).any() else values[:, 0]
    return np.nanmean(values[:, late], axis=1) / np.maximum(first, 1e-12)


def ending(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean over the last tenth of the steps; of a seed that has no value there, its last one."""
    late = steps >= 0.9 * steps[-1]
    found = []
    for line in values:
        own = line[late & np.isfinite(line)]
        finite = line[np.isfinite(line)]
        found.append(own.mean() if len(own) else finite[-1] if len(finite) else np.nan)
    return np.array(found)


COVERAGE = Measure("share seen", ("coverage",), mean_height, "mean height of the curve")
CELLS = COVERAGE._replace(score=lambda steps, values: values[:, -1], score_name="share seen at the end")
WHOLE = COVERAGE._replace(score=whole_at, score_name="step at which all had been seen", higher_is_better=False)
VARIANCE = Measure("equation 1", ("variance",), staying, "mean of the second half over that of the first")
RETURN = Measure("return", ("eval/return", "episode_return"), ending, "return, mean of the last tenth")
VISITS = CELLS._replace(needs_walk=True)
