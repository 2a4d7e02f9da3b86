"""How sure a few seeds make one of a number: means, interquartile means, differences by seed, and their intervals.

Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021, recommend
interquartile means, stratified bootstrap intervals and probabilities of improvement; the paper reports means.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

RESAMPLES = 2_000
"""Of a bootstrap."""


class Interval(NamedTuple):
    """A mean and the 95 % confidence interval around it."""

    mean: float
    half_width: float | None
    """Student's t with one degree of freedom less than there are seeds. None: of one seed there is none."""


class Bounds(NamedTuple):
    """A number and the 95 % interval around it, which need not be symmetric."""

    value: float
    low: float
    high: float


class Paired(NamedTuple):
    """One method against another on the seeds that both have."""

    seeds: tuple[int, ...]
    difference: Interval
    """Of the values seed by seed, the first method's less the second's."""
    ahead: float
    """Seeds on which the first is ahead; a tie counts half."""


def interval(values: np.ndarray) -> Interval:
    """Mean of `values [S]` and its 95 % interval by Student's t: wide where seeds are few, as it should be."""
    count = len(values)
    if count < 2:
        return Interval(float(np.mean(values)), None)
    from scipy import special  # Half a second, and a run asks for nothing of it until it has ended.

    error = np.std(values, ddof=1) / np.sqrt(count)
    return Interval(float(np.mean(values)), float(special.stdtrit(count - 1, 0.975) * error))


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of `values [S]` without the lowest and the highest quarter, counts rounded down: of 3 seeds, all."""
    dropped = len(values) // 4
    return float(np.mean(np.sort(values)[dropped : len(values) - dropped]))


def bootstrap(statistic: Callable[..., float], *samples: np.ndarray, seed: int = 0) -> Bounds:
    """A statistic of samples and its 95 % percentile bootstrap interval.

    Args:
        statistic: `(*samples) -> number`.
        *samples: values over seeds, `[S]` each; strata, each of which is resampled by itself.
        seed: of the resampling; the same seed, the same interval.

    Raises:
        ValueError: a sample is empty.
    """
    if not samples or not all(len(sample) for sample in samples):
        raise ValueError("samples: an empty one has no interval. Allowed: one value or more in each")
    rng = np.random.default_rng(seed)
    found = [statistic(*(rng.choice(sample, len(sample)) for sample in samples)) for _ in range(RESAMPLES)]
    low, high = np.percentile(found, [2.5, 97.5])
    return Bounds(float(statistic(*samples)), float(low), float(high))


def probability_of_improvement(first: np.ndarray, second: np.ndarray) -> float:
    """How often a run of the first is above one of the second, `[S]` and `[R]`, over all pairs; ties count half.

    Mann and Whitney's U over its greatest value.
    """
    return float(np.mean((np.sign(np.subtract.outer(first, second)) + 1) / 2))


def paired(first: Mapping[int, float], second: Mapping[int, float]) -> Paired | None:
    """The values of two methods by seed, compared on the seeds that both have; None where there is none."""
    seeds: Sequence[int] = sorted(first.keys() & second.keys())
    if not seeds:
        return None
    differences = np.array([first[seed] - second[seed] for seed in seeds])
    return Paired(tuple(seeds), interval(differences), float(np.sum((np.sign(differences) + 1) / 2)))
