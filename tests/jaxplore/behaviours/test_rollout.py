"""Imagined rollouts against dynamics iterated by hand in NumPy: three linear models, a linear policy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore.behaviours.rollout import World, rollout
from jaxplore.beliefs import Belief, make_no_belief
from jaxplore.dynamics import Normalizers, Prediction
from jaxplore.normalizer import Normalizer

M, N, O, A, H = 3, 4, 2, 1, 6  # noqa: E741
RNG = np.random.default_rng(0)
MODELS = (0.5 * RNG.normal(size=(M, O, O + A))).astype(np.float32)
GAIN = np.array([[0.4], [-0.3]], np.float32)
START = RNG.normal(size=(N, O)).astype(np.float32)
MEANS = {"obs": np.array([1.0, -2.0]), "action": np.array([0.1]), "delta": np.array([0.05, -0.02])}
STDS = {"obs": np.array([2.0, 0.5]), "action": np.array([0.6]), "delta": np.array([0.3, 0.1])}


def stats(name):
    mean, std = (jnp.asarray(values[name], jnp.float32) for values in (MEANS, STDS))
    return Normalizer(count=jnp.ones(()), mean=mean, sum_squares=std**2)


NORMALIZERS = Normalizers(stats("obs"), stats("action"), stats("delta"))


def act(key, obs):
    return jnp.tanh(obs @ jnp.asarray(GAIN))


def predict(models, inputs):
    return Prediction(jnp.einsum("moi,ni->mno", models, inputs))


def reward(seen):
    # Tells models apart, and the delta that happened from those that did not.
    return jnp.sum(seen.prediction.mean[:, :, 0], axis=0) + 10 * seen.delta[:, 0]


def world_of(models, predict=predict, score=reward):
    """Models, the belief that runs them, and what their predictions are worth."""
    belief: Belief = make_no_belief()._replace(predict=predict)
    return World(belief, models, NORMALIZERS, score)


@functools.partial(jax.jit, static_argnums=(3, 4, 5, 6))
def run(key, models, start, horizon, mover, bound, act):
    return rollout(key, act, world_of(models), start, horizon, mover, bound)


def imagine(mover="per_step", bound=0.0, horizon=H, start=START, seed=0, act=act, models=MODELS):
    """As NumPy arrays."""
    return jax.device_get(run(jax.random.key(seed), models, start, horizon, mover, bound, act))


def by_hand(obs, action):
    """`(deltas [M, O], next observations [M, O])` of one actor, each model on its own, in float64."""
    inputs = np.concatenate([(obs - MEANS["obs"]) / STDS["obs"], (action - MEANS["action"]) / STDS["action"]])
    deltas = MODELS.astype(float) @ inputs
    return deltas, obs + MEANS["delta"] + STDS["delta"] * deltas


def moved_by(rows):
    """Which model moved each actor at each step, `[H, N]`, and a check that it was exactly one of them."""
    movers = np.zeros(rows.obs.shape[:2], int)
    for h, n in np.ndindex(movers.shape):
        gaps = np.max(np.abs(by_hand(rows.obs[h, n], rows.action[h, n])[1] - rows.next_obs[h, n]), axis=1)
        movers[h, n] = np.argmin(gaps)
        assert np.sort(gaps)[0] < 1e-5 < 1e-3 < np.sort(gaps)[1]
    return movers


def test_steps_follow_one_another():
    # each step starts where the last ended, acts by the policy on raw observations, and never ends
    rows = imagine()
    np.testing.assert_array_equal(rows.obs[0], START)
    np.testing.assert_array_equal(rows.obs[1:], rows.next_obs[:-1])
    np.testing.assert_allclose(rows.action, np.tanh(rows.obs @ GAIN), rtol=1e-5, atol=1e-6)
    assert not rows.terminated.any() and not rows.truncated.any()
    assert rows.next_obs.shape == (H, N, O) and rows.action.shape == (H, N, A) and rows.reward.shape == (H, N)


def test_mean_is_the_linear_recurrence():
    # iterated by hand: x <- x + mean_delta + std_delta * mean_m(A_m) [normalised x, normalised action]
    rows = imagine("mean")
    for n in range(N):
        obs = START[n].astype(float)
        for h in range(H):
            deltas, _ = by_hand(obs, np.tanh(obs @ GAIN))
            obs = obs + MEANS["delta"] + STDS["delta"] * deltas.mean(axis=0)
            np.testing.assert_allclose(rows.next_obs[h, n], obs, rtol=1e-4, atol=1e-5)


def test_one_model_moves_an_actor_for_its_whole_rollout():
    # the same model at every step of an actor, not the same for all actors, uniform over models (48 actors, 3 models)
    movers = moved_by(imagine("per_rollout", start=np.tile(START, (12, 1))))
    np.testing.assert_array_equal(movers, np.broadcast_to(movers[:1], movers.shape))
    counts = np.bincount(movers[0], minlength=M)
    assert np.all(counts > 6)


def test_a_model_is_drawn_for_each_actor_at_each_step():
    # 6 x 48 draws: uniform (96 +- 8 each), and no memory (an actor keeps its model in 1/3 of the steps, +-3 %)
    movers = moved_by(imagine("per_step", start=np.tile(START, (12, 1))))
    np.testing.assert_allclose(np.bincount(movers.ravel(), minlength=M), 96, atol=30)
    assert np.mean(movers[1:] == movers[:-1]) == pytest.approx(1 / 3, abs=0.12)
    assert np.mean(movers[:, 1:] == movers[:, :-1]) == pytest.approx(1 / 3, abs=0.12)


def test_models_that_state_a_variance_are_drawn_from():
    # one model, 4,000 actors, 1 step: changes have the model's mean and the variance it states, entry by entry; the
    # mean of models is not drawn from
    var = np.array([0.04, 0.25], np.float32)

    def stating(models, inputs):
        mean = predict(models, inputs).mean
        return Prediction(mean, jnp.broadcast_to(jnp.asarray(var), mean.shape))

    start = np.tile(START[:1], (4_000, 1))

    @functools.partial(jax.jit, static_argnums=0)
    def moved(mover):
        world = world_of(jnp.asarray(MODELS[:1]), stating, lambda seen: seen.delta[:, 1])
        return rollout(jax.random.key(0), act, world, jnp.asarray(start), 1, mover)

    def changes(mover):
        rows = jax.device_get(moved(mover))
        return (rows.next_obs[0] - start - MEANS["delta"]) / STDS["delta"], rows.reward[0]

    want = by_hand(START[0], np.tanh(START[0] @ GAIN))[0][0]
    for mover in ("per_step", "per_rollout"):
        drawn, reported = changes(mover)
        np.testing.assert_allclose(np.mean(drawn, axis=0), want, atol=4 * 0.5 / np.sqrt(4_000))
        np.testing.assert_allclose(np.var(drawn, axis=0), var, rtol=0.1)
        np.testing.assert_allclose(reported, drawn[:, 1], atol=1e-4)  # The reward sees the change that was drawn.
    np.testing.assert_allclose(changes("mean")[0], np.tile(want, (4_000, 1)), atol=1e-4)


@pytest.mark.parametrize("mover", ["per_step", "per_rollout", "mean"])
def test_reward_sees_all_models_and_the_delta_that_happened(mover):
    # recomputed from the rows: predictions of all models at (obs, action), and the actor's own change
    rows = imagine(mover)
    for h, n in np.ndindex(H, N):
        deltas, _ = by_hand(rows.obs[h, n], rows.action[h, n])
        happened = (rows.next_obs[h, n] - rows.obs[h, n] - MEANS["delta"]) / STDS["delta"]
        assert rows.reward[h, n] == pytest.approx(np.sum(deltas[:, 0]) + 10 * happened[0], rel=1e-3, abs=1e-3)


def test_bound_holds_changes_and_observations_near_the_data():
    # models 100 times as strong, from the data's mean: each normalised change is clipped to +-2 (by hand at the first
    # step), observations stop at 2 standard deviations of theirs; without a bound they are soon hundreds away, and no
    # more: what the models see of that is within 10
    start = np.tile(MEANS["obs"].astype(np.float32), (N, 1)) + START / 10
    rows = imagine(bound=2.0, models=100 * MODELS, start=start, horizon=30)
    seen = (rows.next_obs - MEANS["obs"]) / STDS["obs"]
    assert np.max(np.abs(seen)) == pytest.approx(2.0, rel=1e-5)
    change = (rows.next_obs[0] - start - MEANS["delta"]) / STDS["delta"]
    clipped = [np.clip(100 * by_hand(start[n], rows.action[0, n])[0], -2, 2) for n in range(N)]
    for n in range(N):
        assert np.min(np.max(np.abs(clipped[n] - change[n]), axis=1)) < 1e-4
    assert np.max(np.abs(change)) == pytest.approx(2.0, rel=1e-4)
    assert 500 < np.max(np.abs(imagine(models=100 * MODELS).next_obs)) < 5000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mover": "per_stp"}, r"mover='per_stp' is not known\. Did you mean 'per_step'\? Allowed: mean, per_r"),
        ({"horizon": 0}, r"horizon=0 is out of range"),
        ({"bound": -1.0}, r"bound=-1\.0 is out of range"),
        ({"start": START[:, :1]}, r"start=\(\d+, 1\) is its shape\. Allowed: shape \[N, \d+\]"),
    ],
)
def test_refusals(changes, message):
    with pytest.raises(ValueError, match=message):
        imagine(**changes)


def test_a_wide_bound_changes_nothing():
    # nothing here leaves 50 standard deviations
    for a, b in zip(imagine(), imagine(bound=50.0), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_a_longer_horizon_goes_on_and_more_actors_stand_beside():
    # with the mean no draw is involved: the first steps of a long rollout, and the actors of a small one, are the same
    rows, longer = imagine("mean"), imagine("mean", horizon=2 * H)
    wider = imagine("mean", start=np.concatenate([START, START + 1]))
    for a, b, c in zip(rows, longer, wider, strict=True):
        np.testing.assert_allclose(a, b[:H], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(a, c[:, :N], rtol=1e-5, atol=1e-6)


def test_policy_draws_anew_at_each_step():
    # a policy that returns its noise: no two steps and no two rollouts share it
    noise = lambda key, obs: jax.random.uniform(key, (obs.shape[0], A))  # noqa: E731
    actions = np.concatenate([imagine(act=noise, seed=s).action.ravel() for s in (0, 1)])
    assert len(np.unique(actions)) == 2 * H * N


@pytest.mark.parametrize("mover", ["per_step", "per_rollout", "mean"])
def test_jit_changes_nothing(mover):
    # the same rollout, step by step in Python and compiled
    compiled = imagine(mover)
    with jax.disable_jit():
        stepped = imagine(mover)
    for a, b in zip(compiled, stepped, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@jax.jit
def simulated(key, models, start):
    world = world_of(models)._replace(step=lambda obs, action: obs[:, ::-1] + jnp.sum(action, axis=1, keepdims=True))
    return rollout(key, act, world, start, H, bound=0.1)


def test_a_simulator_moves_the_actors_and_the_models_say_what_it_is_worth():
    rows = jax.device_get(simulated(jax.random.key(0), MODELS, START))
    np.testing.assert_array_equal(rows.obs[0], START)
    np.testing.assert_array_equal(rows.obs[1:], rows.next_obs[:-1])
    # what happened is where it went, and no bound is set to that
    went = rows.obs[..., ::-1] + np.sum(rows.action, axis=-1, keepdims=True)
    np.testing.assert_allclose(rows.next_obs, went, rtol=1e-6)
    for h, n in np.ndindex(rows.reward.shape):
        predicted = by_hand(rows.obs[h, n], rows.action[h, n])[0]
        happened = (rows.next_obs[h, n] - rows.obs[h, n] - MEANS["delta"]) / STDS["delta"]
        assert rows.reward[h, n] == pytest.approx(np.sum(predicted[:, 0]) + 10 * happened[0], rel=1e-3, abs=1e-3)
