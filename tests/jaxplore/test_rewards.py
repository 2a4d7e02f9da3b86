"""The variance reward, equation 1 of the paper (asvgd.md T13)."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore.dynamics import Prediction
from jaxplore.rewards import variance

MEANS = np.random.default_rng(0).normal(size=(7, 5, 3)).astype(np.float32)


def test_variance_is_over_models():
    # T13: models (0, 0) and (2, 2) -> 2; over the wrong axis (entries, hypergan_rl's) it would be 0
    assert float(variance(Prediction(jnp.array([[[0.0, 0.0]], [[2.0, 2.0]]])))[0]) == 2.0
    # and the reverse: models that agree on (0, 2) -> 0, where the wrong axis gives 1 or more
    assert float(variance(Prediction(jnp.array([[[0.0, 2.0]], [[0.0, 2.0]]])))[0]) == 0.0


def test_variance_is_numpys():
    # equation 1 in two loops, float64, divided by m (not m - 1)
    want = np.zeros(5)
    for n in range(5):
        centre = MEANS[:, n].astype(float).mean(axis=0)
        want[n] = sum(np.sum((MEANS[i, n] - centre) ** 2) for i in range(7)) / 7
    np.testing.assert_allclose(variance(Prediction(jnp.asarray(MEANS))), want, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "factor"),
    [
        (lambda x: x[::-1], 1.0),
        (lambda x: x + np.float32(3.0), 1.0),
        (lambda x: -2 * x, 4.0),
        (lambda x: x[[0] * 7], 0.0),
    ],
    ids=["permuted", "shifted", "scaled", "one model"],
)
def test_variance_under_changes_of_the_models(change, factor):
    # no order, no origin, quadratic in scale, nothing where all agree
    base = variance(Prediction(jnp.asarray(MEANS)))
    np.testing.assert_allclose(variance(Prediction(jnp.asarray(change(MEANS)))), factor * base, rtol=1e-5, atol=1e-12)


def test_variance_in_raw_units():
    # a delta in raw units is delta_std times the normalised one: the same as predicting in raw units
    std = np.array([0.1, 1.0, 30.0], np.float32)
    raw = variance(Prediction(jnp.asarray(MEANS * std)))
    np.testing.assert_allclose(variance(Prediction(jnp.asarray(MEANS)), jnp.asarray(std)), raw, rtol=1e-5)


def test_variance_ignores_stated_variances():
    # equation 1 is about means only
    means = jnp.asarray(MEANS)
    np.testing.assert_array_equal(variance(Prediction(means, 9.0 * jnp.ones_like(means))), variance(Prediction(means)))
