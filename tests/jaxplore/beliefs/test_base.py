"""What every belief offers: models judged by what happened, in the units of its encoding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import beliefs, dynamics
from jaxplore.beliefs import make_no_belief
from jaxplore.dynamics import DELTA, ONE_HOT, Normalizers, Prediction
from jaxplore.normalizer import Normalizer
from jaxplore.types import Transition

NUM, O, A, M = 5, 3, 2, 4  # noqa: E741
RNG = np.random.default_rng(0)
MODELS = RNG.normal(size=(M, O, O + A)).astype(np.float32)
MEANS = {"obs": [1.0, -2.0, 0.5], "action": [0.1, -0.2], "delta": [0.05, -0.02, 0.3]}
STDS = {"obs": [2.0, 0.5, 1.5], "action": [0.6, 0.4], "delta": [0.3, 0.1, 0.7]}


def linear(models, inputs):
    return Prediction(jnp.einsum("moi,ni->mno", models, inputs))


def statistics():
    return Normalizers(
        *(
            Normalizer(np.float32(1), np.array(MEANS[name], np.float32), np.array(STDS[name], np.float32) ** 2)
            for name in ("obs", "action", "delta")
        )
    )


def judged(encoding, obs, action, next_obs):
    """`(what the models say, what they should have said)`, `[M, N, O]` and `[N, O]`."""
    flag = np.zeros(NUM, bool)
    rows = Transition(obs, action, np.zeros(NUM, np.float32), next_obs, flag, flag)
    belief = make_no_belief()._replace(predict=linear, encoding=encoding)
    prediction, target = jax.jit(belief.judge)(MODELS, statistics(), rows)
    assert prediction.var is None
    np.testing.assert_array_equal(jax.jit(belief.imagine)(MODELS, statistics(), obs, action).mean, prediction.mean)
    return prediction.mean, target


def test_a_belief_in_changes_is_judged_in_units_of_their_spread():
    # inputs less their mean and over their standard deviation; so is the change that happened, within 10 of them
    obs, next_obs = (RNG.normal(size=(NUM, O)).astype(np.float32) for _ in range(2))
    action = RNG.uniform(-1, 1, size=(NUM, A)).astype(np.float32)
    mean, target = judged(DELTA, obs, action, next_obs)
    inputs = np.hstack(
        [np.clip((obs - MEANS["obs"]) / STDS["obs"], -10, 10), (action - MEANS["action"]) / STDS["action"]]
    )
    np.testing.assert_allclose(mean, [inputs @ model.T for model in MODELS], rtol=1e-4, atol=1e-5)
    free = (next_obs - obs - MEANS["delta"]) / STDS["delta"]
    assert np.max(np.abs(free)) > 10
    np.testing.assert_allclose(target, np.clip(free, -10, 10), rtol=1e-4, atol=1e-5)


def test_a_belief_in_states_is_judged_by_the_state_that_came():
    # nothing is normalised, and the target is the next state itself
    obs, next_obs = (np.eye(O, dtype=np.float32)[RNG.integers(0, O, NUM)] for _ in range(2))
    action = np.eye(A, dtype=np.float32)[RNG.integers(0, A, NUM)]
    mean, target = judged(ONE_HOT, obs, action, next_obs)
    np.testing.assert_allclose(mean, [np.hstack([obs, action]) @ model.T for model in MODELS], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(target, next_obs)


def test_a_belief_that_predicts_nothing_judges_nothing_and_is_not_fitted():
    # its state comes out as it went in, without metrics
    belief, row = make_no_belief(), np.zeros((1, O), np.float32)
    with pytest.raises(ValueError, match=r"belief predicts nothing\. Allowed: a belief with `predict`"):
        belief.imagine((), dynamics.init_normalizers(O, A), row, row[:, :A])
    flag = np.zeros(1, bool)
    rows = Transition(row, row[:, :A], np.zeros(1), row, flag, flag)
    with pytest.raises(ValueError, match=r"belief predicts nothing"):
        belief.judge((), dynamics.init_normalizers(O, A), rows)
    assert beliefs.fit(belief, None, "as it was", None, None, None) == ("as it was", {})
