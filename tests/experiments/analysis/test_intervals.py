import numpy as np
import pytest
from scipy import stats

from experiments.analysis.intervals import (
    bootstrap,
    interquartile_mean,
    interval,
    paired,
    probability_of_improvement,
)

FIRST = np.array([0.62, 0.92, 0.83, 0.67, 0.7, 0.71, 0.55, 0.74, 0.9])
SECOND = np.array([0.57, 0.7, 0.58, 0.68, 0.7, 0.5])


def test_the_interval_is_students():
    expected = stats.ttest_1samp(FIRST, 0).confidence_interval(0.95)
    mean, half_width = interval(FIRST)
    assert half_width is not None
    np.testing.assert_allclose([mean - half_width, mean + half_width], expected)
    assert interval(FIRST[:1]) == (FIRST[0], None)


@pytest.mark.parametrize("count", range(1, 10))
def test_the_interquartile_mean_is_scipys_trimmed_mean(count: int):
    assert interquartile_mean(FIRST[:count]) == pytest.approx(stats.trim_mean(FIRST[:count], 0.25))


def test_an_outlier_does_not_move_the_interquartile_mean():
    assert interquartile_mean(np.array([1.0, 2.0, 3.0, 4.0])) == interquartile_mean(np.array([-9.0, 2.0, 3.0, 400.0]))


def test_the_probability_of_improvement_is_mann_and_whitneys():
    expected = stats.mannwhitneyu(FIRST, SECOND).statistic / (len(FIRST) * len(SECOND))
    assert probability_of_improvement(FIRST, SECOND) == pytest.approx(expected)
    assert probability_of_improvement(SECOND, FIRST) == pytest.approx(1 - expected)
    assert probability_of_improvement(FIRST, FIRST) == 0.5


def test_a_bootstrap_of_one_sample_is_scipys():
    expected = stats.bootstrap((FIRST,), np.mean, method="percentile", rng=np.random.default_rng(0)).confidence_interval
    found = bootstrap(np.mean, FIRST)  # pyright: ignore[reportArgumentType]
    assert found.value == np.mean(FIRST)
    np.testing.assert_allclose([found.low, found.high], expected, atol=0.01)


def test_strata_are_resampled_each_by_itself():
    """The first is always 0 and the second always 1: mixed up, the mean of both would vary."""
    found = bootstrap(lambda a, b: float(np.mean(a) + 2 * np.mean(b)), np.zeros(3), np.ones(4))
    assert found == (2.0, 2.0, 2.0)


def test_a_bootstrap_can_be_repeated():
    assert bootstrap(interquartile_mean, FIRST) == bootstrap(interquartile_mean, FIRST)
    assert bootstrap(interquartile_mean, FIRST) != bootstrap(interquartile_mean, FIRST, seed=1)


def test_a_bootstrap_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"samples: an empty one has no interval. Allowed: one value or more"):
        bootstrap(interquartile_mean, FIRST, FIRST[:0])


def test_pairs_are_the_seeds_that_both_have():
    found = paired({0: 0.5, 1: 0.7, 2: 0.9, 5: 0.4}, {1: 0.6, 2: 0.9, 5: 0.1, 7: 1.0})
    assert found is not None
    assert found.seeds == (1, 2, 5)
    assert found.ahead == 2.5
    expected = stats.ttest_rel([0.7, 0.9, 0.4], [0.6, 0.9, 0.1]).confidence_interval(0.95)
    mean, half_width = found.difference
    assert half_width is not None
    np.testing.assert_allclose([mean - half_width, mean + half_width], expected)
    assert paired({0: 1.0}, {1: 1.0}) is None
