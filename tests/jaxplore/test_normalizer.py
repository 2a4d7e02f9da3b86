"""Running statistics against NumPy on all rows at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import beliefs, dynamics, normalizer, rewards
from jaxplore.types import Transition

RNG = np.random.default_rng(0)
update, normalize, denormalize = map(jax.jit, (normalizer.update, normalizer.normalize, normalizer.denormalize))


@pytest.mark.parametrize("sizes", [(50,), (1,) * 12, (3, 20, 1, 7)])
def test_batches_give_the_statistics_of_all_rows(sizes):
    # NumPy float64 mean and population std, rows 0.1 to 1000 in size and off the origin
    batches = [RNG.normal(size=(n, 4)) * [0.1, 1, 10, 1000] + [5, -5, 100, 0] for n in sizes]
    state = normalizer.init(4)
    for batch in batches:
        state = update(state, batch.astype(np.float32))
    rows = np.concatenate(batches).astype(np.float32).astype(float)
    np.testing.assert_allclose(state.mean, rows.mean(axis=0), rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(state.std, np.maximum(rows.std(axis=0), normalizer.MIN_STD), rtol=1e-4)
    assert int(state.count) == len(rows)


def test_rows_left_out_leave_no_trace():
    # weights 0 and 1: the rows with 1, even where the others hold NaN or infinity; a batch of none changes nothing
    rows = RNG.normal(size=(20, 3)).astype(np.float32)
    weights = np.arange(20) % 3 == 0
    dirty = np.where(weights[:, None], rows, np.where(np.arange(20)[:, None] % 2, np.nan, np.inf)).astype(np.float32)
    state = update(normalizer.init(3), dirty, weights.astype(np.float32))
    np.testing.assert_allclose(state.mean, rows[weights].mean(axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(state.std, rows[weights].std(axis=0), rtol=1e-5)
    assert int(state.count) == weights.sum()
    after = update(state, dirty, np.zeros(20, np.float32))
    jax.tree.map(np.testing.assert_array_equal, after, state)


def test_an_entry_that_never_moves_is_not_divided_by_zero():
    # std is floored at MIN_STD = 1e-3: a constant entry normalises to 0, and a first change of 1e-3 to 1
    state = update(normalizer.init(2), np.array([[2.0, 1.0], [2.0, 3.0]], np.float32))
    np.testing.assert_allclose(state.std, [1e-3, 1.0], rtol=1e-6)
    np.testing.assert_allclose(normalize(state, np.array([2.0, 4.0], np.float32)), [0.0, 2.0], rtol=1e-6)
    np.testing.assert_allclose(normalize(state, np.array([2.001, 2.0], np.float32)), [1.0, 0.0], rtol=1e-3)


def test_no_rows_are_the_identity():
    # mean 0, std 1
    rows = jnp.asarray(RNG.normal(size=(5, 3)), jnp.float32)
    np.testing.assert_array_equal(normalize(normalizer.init(3), rows), rows)


@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 5, 3)])
def test_normalised_rows_come_back(shape):
    # (x - mean) / std, and back, for any leading axes
    state = update(normalizer.init(3), jnp.asarray(RNG.normal(size=(40, 3)) * 3 + 1, jnp.float32))
    rows = RNG.normal(size=shape).astype(np.float32)
    got = normalize(state, rows)
    np.testing.assert_allclose(got, (rows - np.asarray(state.mean)) / np.asarray(state.std), rtol=1e-5)
    np.testing.assert_allclose(denormalize(state, got), rows, rtol=1e-4, atol=1e-5)


def test_dynamics_units():
    # inputs [obs, action] and targets next_obs - obs, each in its own statistics; apply_delta inverts the target
    obs, next_obs = (RNG.normal(size=(30, 2)).astype(np.float32) * 4 + 1 for _ in range(2))
    action = RNG.uniform(-1, 1, size=(30, 1)).astype(np.float32)
    flag = np.zeros(30, bool)
    rows = Transition(obs, action, np.zeros(30, np.float32), next_obs, flag, flag)

    @jax.jit
    def written(rows, valid):
        state = dynamics.update_normalizers(dynamics.init_normalizers(2, 1), rows, valid)
        targets = dynamics.model_targets(state, rows.obs, rows.next_obs)
        inputs = dynamics.model_inputs(state, rows.obs, rows.action)
        return inputs, targets, dynamics.apply_delta(state, rows.obs, targets)

    inputs, targets, applied = written(rows, np.arange(30) < 20)

    def standard(x):
        return (x - x[:20].mean(axis=0)) / x[:20].std(axis=0)

    np.testing.assert_allclose(inputs, np.hstack([standard(obs), standard(action)]), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(targets, standard(next_obs - obs), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(applied, next_obs, rtol=1e-4, atol=1e-5)


def test_an_entry_that_stood_still_is_not_a_million_times_as_far_as_the_rest():
    # Humanoid-v5's contact forces: 0 for long, then hundreds. Beyond the statistics everything is 10 away, within them
    # nothing changes
    still = np.tile(np.array([0.0, 100.0, 1e5, 0.3], np.float32), (500, 1))
    state = update(normalizer.init(4), still + np.array([0, 0, 0, 1.0]) * RNG.normal(size=(500, 1)).astype(np.float32))
    np.testing.assert_allclose(state.std[:3], [1e-3, 1e-3, 1.0], rtol=1e-3)
    rows = np.array([[400.0, 104.0, 1e5 + 3.0, 0.5], [0.0, 100.0, 1e5, 5.0]], np.float32)
    seen = np.asarray(normalize(state, rows))
    np.testing.assert_allclose(seen[0, :3], [10.0, 10.0, 3.0], rtol=1e-2)
    np.testing.assert_allclose(seen[1, :3], 0.0, atol=0.02)
    free = np.asarray(normalizer.normalize(state, rows, limit=None))
    assert free[0, 0] == pytest.approx(4e5, rel=1e-2)
    np.testing.assert_array_equal(seen[:, 3], free[:, 3])
    np.testing.assert_allclose(denormalize(state, free), rows, rtol=1e-4)


def test_a_belief_sees_and_aims_at_what_is_within_the_limit():
    # and of an action the gradient goes through wherever it is
    state = dynamics.init_normalizers(2, 2)
    obs, action = jnp.array([[50.0, -0.5]]), jnp.array([[40.0, 0.7]])
    inputs, pull = jax.vjp(lambda obs, action: dynamics.model_inputs(state, obs, action), obs, action)
    np.testing.assert_array_equal(inputs, np.array([[10.0, -0.5, 10.0, 0.7]], np.float32))
    obs_gradient, action_gradient = pull(jnp.ones((1, 4)))
    np.testing.assert_array_equal(obs_gradient, [[0.0, 1.0]])
    np.testing.assert_array_equal(action_gradient, [[1.0, 1.0]])
    np.testing.assert_array_equal(dynamics.model_targets(state, obs, obs + 30.0), [[10.0, 10.0]])


def test_rewards_stay_bounded_where_an_entry_has_hardly_moved():
    # as in Humanoid-v5: a contact force of 0 and a constant of 1e5, each with a jitter, and an entry as usual; 1 of 3
    # choices is never taken. Then the first two jump, by that choice. Two models say 1 and -1 times what they see of
    # the observation, and of the choice in the last entry: by hand each of the three is 10 away or, the last, 10 and
    # what it sees; a variance of 1.6e11 without the limit
    rng = np.random.default_rng(2)
    obs = jnp.float32(np.array([0.0, 1e5, 0.0]) + np.array([1e-6, 1e-2, 1.0]) * rng.normal(size=(501, 3)))
    flag, action = jnp.zeros(500, bool), jnp.eye(3)[rng.integers(0, 2, size=500)]
    rows = Transition(obs[:-1], action, jnp.zeros(500), obs[1:], flag, flag)
    state = dynamics.update_normalizers(dynamics.init_normalizers(3, 3), rows, ~flag)
    jumped, last = jnp.array([[400.0, 2e5, 0.0]]), jnp.eye(3)[2:]
    says = jnp.hstack([jnp.eye(3), jnp.zeros((3, 2)), jnp.eye(3)[:, 2:]])
    models = jnp.stack([says, -says])
    belief = beliefs.make_no_belief()._replace(
        predict=lambda models, inputs: dynamics.Prediction(jnp.einsum("moi,ni->mno", models, inputs))
    )
    one = Transition(jumped, last, rows.reward[:1], obs[-1:], flag[:1], flag[:1])
    prediction, target = belief.judge(models, state, one)
    seen = 10.0 - float(state.obs.mean[2] / state.obs.std[2])
    assert rewards.variance(prediction)[0] == pytest.approx(100 + 100 + seen**2, rel=1e-5)
    assert rewards.prediction_error(prediction, target)[0] == pytest.approx(100 + 100 + float(target[0, 2]) ** 2)
    in_obs_units = state.delta.std / state.obs.std
    assert rewards.prediction_error(prediction, target, in_obs_units)[0] < 3 * (2 * 10) ** 2


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda state: normalizer.update(state, jnp.zeros((5, 1))), r"rows=\(5, 1\) is their shape\. .*\[B, 3\]"),
        (lambda state: normalizer.update(state, jnp.zeros(3)), r"rows=\(3,\) is their shape\. Allowed: .*\[B, 3\]"),
        (lambda state: normalizer.update(state, jnp.zeros((5, 3)), jnp.ones(1)), r"weights=\(1,\) .*shape \(5,\)"),
        (lambda state: normalizer.normalize(state, jnp.zeros((5, 1))), r"rows=\(5, 1\) .*\[\.\.\., 3\]"),
        (lambda state: normalizer.denormalize(state, jnp.zeros(())), r"rows=\(\) .*\[\.\.\., 3\]"),
        (lambda state: normalizer.init(0), r"size=0 is out of range"),
    ],
)
def test_rows_of_another_width_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(normalizer.init(3))
