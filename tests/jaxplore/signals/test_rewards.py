"""Intrinsic rewards: closed forms, double loops, and the values that nnaisense/max's own code gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore.dynamics import Prediction
from jaxplore.signals import rewards
from jaxplore.signals.rewards import variance_within
from jaxplore.validate import FieldError

variance, jensen_renyi, jensen_shannon, prediction_error, trajectory_spread = map(
    jax.jit,
    (
        rewards.variance,
        rewards.jensen_renyi,
        rewards.jensen_shannon,
        rewards.prediction_error,
        rewards.trajectory_spread,
    ),
)

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
    np.testing.assert_allclose(variance(Prediction(MEANS)), want, rtol=1e-5)


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
    base = np.asarray(variance(Prediction(MEANS)))
    np.testing.assert_allclose(variance(Prediction(change(MEANS))), factor * base, rtol=1e-5, atol=1e-12)


def test_variance_in_raw_units():
    # a delta in raw units is delta_std times the normalised one: the same as predicting in raw units
    std = np.array([0.1, 1.0, 30.0], np.float32)
    raw = variance(Prediction(MEANS * std))
    np.testing.assert_allclose(variance(Prediction(MEANS), std), raw, rtol=1e-5)


def test_variance_ignores_stated_variances():
    # equation 1 is about means only
    stated = Prediction(MEANS, np.full_like(MEANS, 9.0))
    np.testing.assert_array_equal(variance(stated), variance(Prediction(MEANS)))


def test_variance_within_is_each_groups_own():
    # two groups of two: unbiased variances by hand, whatever lies between the groups
    groups = MEANS[:4].astype(float).reshape(2, 2, *MEANS.shape[1:])
    want = np.mean([group.var(axis=0, ddof=1).sum(axis=-1) for group in groups], axis=0)
    far = MEANS[:4] + np.array([0, 0, 50, 50], np.float32)[:, None, None]
    np.testing.assert_allclose(variance_within(Prediction(MEANS[:4]), 2), want, rtol=1e-5)
    np.testing.assert_allclose(variance_within(Prediction(far), 2), want, rtol=1e-3)
    # one group: all models, whose unbiased variance is m / (m - 1) times equation 1
    whole = variance_within(Prediction(MEANS[:4]), 1)
    np.testing.assert_allclose(whole, variance(Prediction(MEANS[:4])) * 4 / 3, rtol=1e-5)


@pytest.mark.parametrize("num", [0, 3, 4])
def test_groups_without_pairs_are_refused(num):
    with pytest.raises(
        FieldError, match=rf"num_groups={num}\. Allowed: a divisor of 4 models that leaves 2 or more in each"
    ):
        variance_within(Prediction(MEANS[:4]), num)


LOW, HIGH = np.exp(-5.0), np.exp(-1.0)
VARS = np.exp(np.random.default_rng(1).uniform(-5, -1, size=MEANS.shape)).astype(np.float32)


@pytest.mark.parametrize("decay", [0.1, 1.0])
def test_jensen_renyi_is_a_double_loop(decay):
    # all pairs of full Gaussian densities, i = j included, float64: nothing cancelled, nothing in logs
    squeezed = HIGH - decay * (HIGH - VARS.astype(float))
    count, actors, size = MEANS.shape
    found = np.asarray(jensen_renyi(Prediction(MEANS, VARS), decay))
    for n in range(actors):
        total = 0.0
        for i in range(count):
            for j in range(count):
                var = squeezed[i, n] + squeezed[j, n]
                gap = MEANS[i, n].astype(float) - MEANS[j, n]
                total += np.prod(np.exp(-0.5 * gap**2 / var) / np.sqrt(2 * np.pi * var))
        own = [0.5 * np.sum(np.log(squeezed[i, n])) + 0.5 * size * np.log(4 * np.pi) for i in range(count)]
        want = -np.log(total / count**2) - np.mean(own)
        assert found[n] == pytest.approx(want, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("gap", [0.0, 0.3, 1.0, 30.0])
def test_jensen_renyi_of_two_gaussians(gap):
    # equal variances v, means `gap` apart: -ln (1 + exp(-gap^2 / 4 v)) / 2, from 0 to ln 2
    mean = np.array([[[0.0]], [[gap]]], np.float32)
    for stated in (LOW, 0.1, HIGH):
        v = HIGH - 0.1 * (HIGH - stated)
        got = jensen_renyi(Prediction(mean, np.full_like(mean, stated)))
        np.testing.assert_allclose(got, [-np.log((1 + np.exp(-(gap**2) / (4 * v))) / 2)], rtol=1e-5, atol=1e-6)
    # networks that state no variance are as sure as a Gaussian one can be
    np.testing.assert_allclose(jensen_renyi(Prediction(mean)), jensen_renyi(Prediction(mean, np.full_like(mean, LOW))))


@pytest.mark.parametrize(
    ("spread", "low", "high", "plain"),
    [
        (0.01, 0.0041, 0.0045, 0.0030),
        (0.1, 0.40, 0.45, 0.30),
        (0.2, 1.5, 1.6, 1.2),
        (0.5, 3.46, 3.46, 7.5),
        (1.0, 3.47, 3.47, 30.0),
    ],
)
def test_jensen_renyi_has_the_values_of_max(spread, low, high, plain):
    # measured with nnaisense/max's class: 32 models, 31 entries, means spread so far; `low` where all state the largest
    # variance, `high` the smallest
    mean = np.asarray(spread * np.random.default_rng(2).normal(size=(32, 64, 31)), np.float32)
    for stated, want in ((HIGH, low), (LOW, high)):
        got = jensen_renyi(Prediction(mean, np.full_like(mean, stated)))
        assert np.mean(got) == pytest.approx(want, rel=0.025)
        assert np.min(got) >= 0.0 and np.max(got) <= np.log(32) + 1e-4
    assert np.mean(variance(Prediction(mean))) == pytest.approx(plain, rel=0.02)


def test_jensen_renyi_stays_below_ln_m_and_takes_far_means():
    # means 1e4 apart: no overlap but each with itself, ln 7 less what unequal variances cost; nothing overflows
    got = np.asarray(jensen_renyi(Prediction(np.float32(1e4) * MEANS, VARS)))
    assert np.all(np.isfinite(got)) and np.all(got <= np.log(7) + 1e-5) and np.all(got > np.log(7) - 0.1)
    equal = jensen_renyi(Prediction(np.float32(1e4) * MEANS))
    np.testing.assert_allclose(equal, np.log(7), rtol=1e-5)


def test_jensen_shannon_by_hand():
    # (1, 0) and (1/2, 1/2): H(3/4, 1/4) - H(1/2, 1/2) / 2, in nats
    mixture = -(0.75 * np.log(0.75) + 0.25 * np.log(0.25))
    got = jensen_shannon(Prediction(jnp.array([[[1.0, 0.0]], [[0.5, 0.5]]])))
    np.testing.assert_allclose(got, [mixture - 0.5 * np.log(2.0)], rtol=1e-5)


def test_jensen_shannon_is_within_its_range():
    # 0 where all agree, ln m where all are sure of different things, between for anything else; probabilities of 0 are
    # no trouble, nor are their gradients elsewhere
    sure = Prediction(np.eye(5, dtype=np.float32)[:, None, :])
    np.testing.assert_allclose(jensen_shannon(sure), np.log(5), rtol=1e-6)
    powers = np.exp(5 * np.random.default_rng(0).normal(size=(5, 200, 9)))
    chances = (powers / powers.sum(axis=-1, keepdims=True)).astype(np.float32)
    any_at_all = np.asarray(jensen_shannon(Prediction(chances)))
    assert np.min(any_at_all) > 0.0 and np.max(any_at_all) < np.log(5)
    agreed = np.broadcast_to(chances[:1], chances.shape)
    np.testing.assert_allclose(jensen_shannon(Prediction(agreed)), 0.0, atol=1e-5)


def test_prediction_error_is_of_the_mean_in_the_units_given():
    # two loops; in standard deviations of the observation each entry is delta std / obs std as long
    delta = np.random.default_rng(3).normal(size=(5, 3)).astype(np.float32)
    error = MEANS.astype(float).mean(axis=0) - delta
    np.testing.assert_allclose(prediction_error(Prediction(MEANS), delta), (error**2).sum(axis=1), rtol=1e-5)
    scale = np.array([0.1, 1.0, 30.0], np.float32)
    got = prediction_error(Prediction(MEANS), delta, scale)
    np.testing.assert_allclose(got, ((error * scale) ** 2).sum(axis=1), rtol=1e-5)


def test_prediction_error_against_a_models_own_step_is_the_variance():
    # averaged over which of the 7 models is taken for the truth
    prediction = Prediction(MEANS)
    mean = np.mean([prediction_error(prediction, MEANS[i]) for i in range(7)], axis=0)
    np.testing.assert_allclose(mean, variance(prediction), rtol=1e-5)


def test_trajectory_spread_is_over_actors():
    # unbiased, summed over entries, the same for all; a single actor has none
    delta = MEANS[0]
    want = np.sum(np.std(delta.astype(float), axis=0, ddof=1))
    np.testing.assert_allclose(trajectory_spread(delta), np.full(5, want), rtol=1e-5)
    np.testing.assert_array_equal(trajectory_spread(np.ones((1, 3), np.float32)), [0.0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rewards.jensen_renyi(Prediction(jnp.zeros((2, 3, 4))), decay=2), r"decay=2\.0 is out of range"),
        (lambda: rewards.jensen_renyi(Prediction(jnp.zeros((2, 3, 4))), decay=0.0), r"decay=0\.0 is out of range"),
        (lambda: rewards.variance(Prediction(jnp.zeros((3, 4)))), r"prediction\.mean=\(3, 4\) is its shape"),
        (lambda: rewards.variance(Prediction(jnp.zeros((0, 3, 4)))), r"with M of 1 or more"),
        (
            lambda: rewards.jensen_renyi(Prediction(jnp.zeros((2, 3, 4)), jnp.zeros((2, 3, 1)))),
            r"prediction\.var=\(2, 3, 1\) is its shape\. Allowed: shape \(2, 3, 4\)",
        ),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_information_gain_by_hand():
    # models (0, 1) and (2, 1): variances 1 and 0. Noise of 0.5: log(1 + 1 / 0.25) + log 1 = log 5. Models that state
    # variances of 0.1 and 0.3: log(1 + 1 / 0.2), and never less noise than the floor
    mean = jnp.array([[[0.0, 1.0]], [[2.0, 1.0]]])
    stated = jnp.array([[[0.1, 0.1]], [[0.3, 0.3]]])
    gain = jax.jit(rewards.information_gain)
    for prediction, noise, want in (
        (Prediction(mean), 0.5, np.log(5.0)),
        (Prediction(mean, stated), 0.1, np.log(6.0)),
        (Prediction(mean, stated), 1.0, np.log(2.0)),
    ):
        np.testing.assert_allclose(gain(prediction, noise), [want], rtol=1e-6)


def test_information_gain_is_numpys_and_small_spreads_are_not_lost():
    # two loops in float64; with spreads of 1e-4 of the noise it is their ratio squared, which 1 + x alone would round
    want = [sum(np.log(1 + MEANS[:, n, o].astype(float).var() / 0.3**2) for o in range(3)) for n in range(5)]
    np.testing.assert_allclose(rewards.information_gain(Prediction(MEANS), 0.3), want, rtol=1e-5)
    small = rewards.information_gain(Prediction(1e-4 * MEANS), 1.0)
    np.testing.assert_allclose(small, 1e-8 * np.asarray(variance(Prediction(MEANS))), rtol=1e-4)


def test_information_gain_refuses_no_noise():
    with pytest.raises(ValueError, match=r"noise_std=0\.0 .*\(0, inf"):
        rewards.information_gain(Prediction(MEANS), 0.0)
    with pytest.raises(ValueError, match=r"prediction\.mean"):
        rewards.information_gain(Prediction(MEANS[0]))
