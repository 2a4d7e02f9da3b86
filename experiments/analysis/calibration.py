"""What a belief knows, and whether it knows that: predicted variance beside true error, as numbers."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from experiments.analysis.figures import FEW_CELLS

DATA, HELD_OUT, SEEN, UNSEEN = "its data", "new, its own policy", "elsewhere, cells seen", "elsewhere, cells not seen"
FEWEST = 20
"""Of fewer transitions than these no figure is given."""


class Judged(NamedTuple):
    """What a belief makes of some transitions, in units of normalised delta (or of probability), squared."""

    variance: np.ndarray
    """Equation 1: variance over models, summed over entries, `[N]`."""
    error: np.ndarray
    """Squared error of the models' mean, summed over entries, `[N]`."""
    stated: np.ndarray
    """Variance that Gaussian networks state, mean over models, summed over entries, `[N]`; 0 of other networks."""
    cell: np.ndarray
    """Coverage cell that the observation lies in, `[N]`, or -1."""

    def __getitem__(self, rows: Any) -> "Judged":  # pyright: ignore[reportIncompatibleMethodOverride]
        """Some of the transitions."""
        return Judged(self.variance[rows], self.error[rows], self.stated[rows], self.cell[rows])


@dataclasses.dataclass(frozen=True)
class Calibration:
    """How predicted variance orders and sizes the true error on one set of transitions."""

    num: int
    """Transitions."""
    error: float
    """Mean squared error of the models' mean."""
    variance: float
    """Mean variance over models."""
    error_per_variance: float | None
    """Their ratio: 1 where uncertainty is as large as errors are, above where the belief is too sure, below where it
    knows more than it thinks. None: there is no variance."""
    error_per_predictive: float | None
    """The same with the variance that Gaussian networks state added to the variance over models."""
    rank: float | None
    """Spearman's rank correlation of variance and squared error: 1 where the order is right. None: one is constant."""


def calibration(judged: Judged) -> Calibration | None:
    """The figures of one set of transitions; None where there are fewer than `FEWEST`."""
    num = len(judged.variance)
    if num < FEWEST:
        return None
    error, variance = float(np.mean(judged.error)), float(np.mean(judged.variance))
    predictive = variance + float(np.mean(judged.stated))
    from scipy import stats  # A second, and every command imports this file.

    constant = np.ptp(judged.variance) == 0 or np.ptp(judged.error) == 0
    return Calibration(
        num=num,
        error=error,
        variance=variance,
        error_per_variance=error / variance if variance > 0 else None,
        error_per_predictive=error / predictive if predictive > 0 else None,
        rank=None if constant else float(stats.spearmanr(judged.variance, judged.error)[0]),  # pyright: ignore[reportArgumentType]
    )


def told_apart(low: np.ndarray, high: np.ndarray) -> float | None:
    """How often a value of `high` is above one of `low`, ties half: 1 separates all, 0.5 none (the area under the
    receiver's curve). None where either has fewer than `FEWEST` values.
    """
    if min(len(low), len(high)) < FEWEST:
        return None
    from scipy import stats

    return float(stats.mannwhitneyu(high, low).statistic / (len(low) * len(high)))


def record(judged: dict[str, Judged], num_cells: int) -> dict[str, Any]:
    """What is saved of one seed."""
    figures = {name: calibration(one) for name, one in judged.items()}
    found: dict[str, Any] = {
        "sets": {name: dataclasses.asdict(one) for name, one in figures.items() if one is not None},
        "unseen_told_from_data": told_apart(judged[DATA].variance, judged[UNSEEN].variance)
        if UNSEEN in judged
        else None,
    }
    if UNSEEN in judged and num_cells <= FEW_CELLS:
        found["cells"] = []
        for cell in range(num_cells):
            inside = {name: judged[name][judged[name].cell == cell] for name in (SEEN, UNSEEN)}
            name = UNSEEN if len(inside[UNSEEN].cell) else SEEN
            values = {
                quantity: float(np.median(getattr(inside[name], quantity))) if len(inside[name].cell) else None
                for quantity in ("variance", "error")
            }
            found["cells"].append({"cell": cell, "seen": name == SEEN, **values})
    return found
