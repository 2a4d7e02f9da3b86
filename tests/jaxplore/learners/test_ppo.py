"""PPO: advantages by hand and against a loop, the objective by hand, its two streams, and probes with known values."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxplore.learners.ppo import (
    PPOConfig,
    Rollout,
    clipped_log_prob,
    clipped_objective,
    generalized_advantages,
    make_ppo,
    minibatches,
)
from jaxplore.types import Transition
from tests.jaxplore import classic, probes, programs


def test_advantages_by_hand():
    # gamma 0.5, lambda 0.8; rewards 1, 2, 3; values 1, 0, 2; after them 0, 2, 4; the second step does not lead on:
    # deltas 1 + 0 - 1 = 0, 2 + 1 - 0 = 3, 3 + 2 - 2 = 3, and so 0 + 0.4 * 3, 3, 3
    reward, value, next_value = jnp.array([1.0, 2, 3]), jnp.array([1.0, 0, 2]), jnp.array([0.0, 2, 4])
    got = generalized_advantages(reward, value, next_value, jnp.array([True, False, True]), 0.5, 0.8)
    np.testing.assert_allclose(got, [1.2, 3, 3], rtol=1e-6)


def test_advantages_are_the_mean_of_all_horizons():
    # A_t = (1 - lambda) sum_n lambda^(n-1) (n-step return - V), the longest with all that is left of the weight
    rng, gamma, lam = np.random.default_rng(0), 0.9, 0.7
    reward, value, next_value = rng.normal(size=(3, 12))
    goes_on = rng.uniform(size=12) < 0.8
    want = []
    for t in range(12):
        stop = t + 1
        while stop < 12 and goes_on[stop - 1]:
            stop += 1
        # deltas add up to the n-step return less the value only where the stream is one: as it is within an episode
        follows = [value[k + 1] if k + 1 < stop else next_value[k] for k in range(t, stop)]
        steps = stop - t
        n_step = [
            sum(gamma**k * reward[t + k] for k in range(n)) + gamma**n * follows[n - 1] - value[t]
            for n in range(1, steps + 1)
        ]
        weights = [(1 - lam) * lam ** (n - 1) for n in range(1, steps)] + [lam ** (steps - 1)]
        want.append(np.dot(weights, n_step))
    joined = np.where(goes_on & (np.arange(12) < 11), np.roll(value, -1), next_value)
    arrays = (jnp.asarray(x, jnp.float32) for x in (reward, value, joined))
    got = generalized_advantages(*arrays, jnp.asarray(goes_on), gamma, lam)
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "want", "slope"),
    [(1.1, 2.0, 2.2, 2.2), (1.5, 2.0, 2.4, 0.0), (0.5, 2.0, 1.0, 1.0), (1.5, -1.0, -1.5, -1.5), (0.5, -1.0, -0.8, 0.0)],
)
def test_objective_by_hand(ratio, advantage, want, slope):
    # clip 0.2: what is better than the clip pays no more and has no gradient; what is worse still counts
    def one(log_prob):
        return clipped_objective(log_prob, jnp.float32(0.3), jnp.float32(advantage), 0.2)

    value, gradient = jax.value_and_grad(one)(jnp.float32(0.3 + math.log(ratio)))
    np.testing.assert_allclose([value, gradient], [want, slope], rtol=1e-5, atol=1e-6)


def test_probability_of_a_clipped_draw():
    # the density inside, all that lies beyond at the ends, and together 1; far outside it stays finite, gradient too
    mean, log_std = jnp.array([0.3]), jnp.array([-0.5])
    std = math.exp(-0.5)
    grid = np.linspace(-0.9999, 0.9999, 4001)
    densities = jax.jit(jax.vmap(lambda a: jnp.exp(clipped_log_prob(mean, log_std, a[None]))))
    density = densities(grid.astype(np.float32))
    np.testing.assert_allclose(density, stats.norm.pdf(grid, 0.3, std), rtol=1e-4)
    ends = np.asarray(densities(np.array([-1, 1], np.float32))).tolist()
    np.testing.assert_allclose(ends, [stats.norm.cdf(-1, 0.3, std), stats.norm.sf(1, 0.3, std)], rtol=1e-4)
    assert np.trapezoid(density, grid) + sum(ends) == pytest.approx(1, abs=1e-3)
    beyond = jax.jit(jax.value_and_grad(lambda m: clipped_log_prob(m, jnp.array([-3.0]), jnp.array([1.0]))))
    far = beyond(np.array([-2.0], np.float32))
    assert np.all(np.isfinite(far[0])) and float(far[1][0]) > 0


def test_each_epoch_goes_through_all_steps_once():
    # 6 rows of 8 hold something: each is taken once in each epoch, in a new order; 2 rows are each taken three times
    draw = jax.jit(minibatches, static_argnums=(1, 3, 4, 5))
    order = np.asarray(draw(jax.random.key(0), 8, np.int32(6), 3, 2, 5))
    assert order.shape == (15, 2)
    epochs = order.reshape(5, 6)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(6), (5, 1)))
    assert len({tuple(epoch) for epoch in epochs}) > 1
    few = np.asarray(draw(jax.random.key(0), 8, np.int32(2), 3, 2, 5)).reshape(5, 6)
    np.testing.assert_array_equal(np.sort(few, axis=1), np.tile([0, 0, 0, 1, 1, 1], (5, 1)))


LENGTH = 6
SMALL = {"hidden": (4,), "rollout_steps": LENGTH, "minibatch_size": LENGTH, "epochs": 1, "normalize_advantage": False}


def constant_values(ppo, extrinsic, intrinsic):
    """Everything 0 but the last biases of the values: these numbers everywhere."""
    shapes = jax.eval_shape(ppo.init, jax.random.key(0))
    state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    state.params["value"]["output"]["bias"][:] = extrinsic, intrinsic
    return state


def rollout_of(terminated, truncated=(False,) * LENGTH, extra=0):
    """Steps with extrinsic reward 1 and intrinsic reward 2, and `extra` rows of padding."""
    total = LENGTH + extra
    obs, ones = np.arange(1, total + 1, dtype=np.float32)[:, None], np.ones(total, np.float32)
    flags = (np.array([*flag, *(False,) * extra]) for flag in (terminated, truncated))
    steps = Transition(obs, 0.5 * ones[:, None], ones, obs + 0.5, *flags)
    return Rollout(steps, 2 * ones, ones * np.float32(-0.5 * 0.25 - 0.5 * math.log(2 * math.pi)))


@pytest.mark.parametrize(("extrinsic", "intrinsic"), [(1.0, 0.0), (0.0, 1.0)])
def test_ends_of_episodes_are_ends_for_the_extrinsic_stream_alone(extrinsic, intrinsic):
    # lambda 1, gamma 0.5, values 3 (extrinsic) and 5 (intrinsic) everywhere; the policy is the one that acted, so its
    # loss is minus the mean advantage, and with one gradient step that is what the metric shows
    ppo = make_ppo(
        1,
        1,
        PPOConfig(
            **SMALL,
            discount=0.5,
            intrinsic_discount=0.5,
            gae_lambda=1.0,
            extrinsic_weight=extrinsic,
            intrinsic_weight=intrinsic,
        ),
    )
    update, state = jax.jit(ppo.update), constant_values(ppo, 3.0, 5.0)

    def returns(reward, value, stops, worth):
        """Discounted sums up to each stop, which is worth `worth` in the end, or the value where the rollout ends."""
        total, found = value, []
        for t in reversed(range(LENGTH)):
            total = reward + 0.5 * (worth if t in stops else total)
            found.append(total)
        return np.mean(found)

    for terminated, truncated in (((), ()), ((2,), ()), ((), (2,)), ((5,), ()), ((), (5,))):
        flags = [[t in stops for t in range(LENGTH)] for stops in (terminated, truncated)]
        loss = -float(
            update(jax.random.key(0), state, rollout_of(*flags), np.ones(1, np.float32), np.int32(6))[1]["policy_loss"]
        )
        if extrinsic:
            # an end is worth nothing; a time limit what its successor is worth, 3
            assert loss == pytest.approx(returns(1.0, 3.0, [*terminated, *truncated], 0 if terminated else 3) - 3)
        else:
            assert loss == pytest.approx(returns(2.0, 5.0, [], None) - 5)


def test_the_intrinsic_stream_goes_on_to_what_is_seen_next():
    # lambda 0, gamma 1, no rewards: the advantage is V(next) - V, with V = the observation through a nearly linear
    # network. In the stream the next observation is the next row's, and after the last row the one that is given; for
    # the extrinsic stream it is the successor, half a step on
    for extrinsic, want in ((0.0, [1, 1, 1, 1, 1, -6]), (1.0, [0.5] * 6)):
        config = PPOConfig(
            **SMALL, discount=1.0, intrinsic_discount=1.0, gae_lambda=0.0, extrinsic_weight=extrinsic,
            intrinsic_weight=1 - extrinsic,
        )  # fmt: skip
        ppo = make_ppo(1, 1, config)
        state = constant_values(ppo, 0.0, 0.0)
        state.params["value"]["hidden_0"]["kernel"][:] = 1e-3
        state.params["value"]["output"]["kernel"][:] = 250.0
        rollout = rollout_of([False] * LENGTH)
        steps = rollout.transitions._replace(reward=np.zeros(LENGTH, np.float32))
        rollout = rollout._replace(transitions=steps, intrinsic_reward=np.zeros(LENGTH, np.float32))
        metrics = jax.jit(ppo.update)(jax.random.key(0), state, rollout, np.zeros(1, np.float32), np.int32(6))[1]
        assert -float(metrics["policy_loss"]) == pytest.approx(np.mean(want), abs=1e-3)


def test_padding_changes_nothing_and_without_steps_nothing_is_learned():
    # the same six steps, with two rows of rubbish after them or without, in one gradient step
    ppo, rng = make_ppo(1, 1, PPOConfig(**SMALL)), np.random.default_rng(0)
    state, update = constant_values(ppo, 0.0, 0.0), jax.jit(ppo.update)
    draw = lambda leaf: np.asarray(0.3 * rng.normal(size=leaf.shape), np.float32)  # noqa: E731
    state = state.replace(params=jax.tree.map(draw, state.params))
    ends = [False, False, True, False, False, False]
    one = np.ones(1, np.float32)
    plain = update(jax.random.key(0), state, rollout_of(ends), one, np.int32(6))
    padded = update(jax.random.key(0), state, rollout_of(ends, extra=2), one, np.int32(6))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), plain, padded)
    after, _ = update(jax.random.key(0), state, rollout_of(ends, extra=2), one, np.int32(0))
    jax.tree.map(np.testing.assert_array_equal, after, state)


@pytest.fixture(scope="module")
def trained():
    """On every probe: 150 updates of 64 steps each, with actions of its own; both streams get the probe's reward."""
    config = PPOConfig(
        hidden=(32,), lr=5e-3, rollout_steps=64, minibatch_size=64, epochs=6, discount=0.5, intrinsic_discount=0.5,
        gae_lambda=0.5, extrinsic_weight=1.0, intrinsic_weight=0.0, log_std=-0.5, max_grad_norm=10.0,
    )  # fmt: skip
    ppo = make_ppo(1, 1, config)

    names = ("two_steps", "endless", "target_action")

    @programs.compiled
    @jax.vmap
    def learn(which):
        def go(state, key):
            rows_key, act_key, update_key = jax.random.split(key, 3)
            each = [probes.PROBES[name](rows_key, 64) for name in names]
            steps = jax.tree.map(lambda *leaves: jnp.stack(leaves)[which], *each)
            action = ppo.act(act_key, ppo.actor(state), steps.obs)
            # This probe's reward is of the action that was taken.
            reward = jnp.where(which == 2, -((action - steps.obs / 2)[:, 0] ** 2), steps.reward)
            log_prob = ppo.log_prob(ppo.actor(state), steps.obs, action)
            rollout = Rollout(steps._replace(action=action, reward=reward), reward, log_prob)
            return ppo.update(update_key, state, rollout, steps.obs[0], jnp.int32(64))[0], None

        keys = jax.random.split(jax.random.key(1), 150)
        return jax.lax.scan(go, ppo.init(jax.random.key(0)), keys)[0]

    states = jax.device_get(learn(np.arange(3)))
    return ppo, {name: jax.tree.map(lambda leaf, i=i: leaf[i], states) for i, name in enumerate(names)}


def values(state, obs):
    """Both heads at one observation: a tanh network written out."""
    hidden = state.params["value"]["hidden_0"]
    x = np.tanh(np.array([obs]) @ hidden["kernel"] + hidden["bias"])
    return x @ state.params["value"]["output"]["kernel"] + state.params["value"]["output"]["bias"]


@pytest.mark.parametrize(("probe", "want"), [("two_steps", {-1.0: 0.5, 1.0: 1.0}), ("endless", {0.0: 2.0})])
def test_extrinsic_values_of_the_probes(trained, probe, want):
    # see probes.py
    for obs, value in want.items():
        assert float(values(trained[1][probe], obs)[0]) == pytest.approx(value, abs=0.1)


def test_intrinsic_values_of_a_probe(trained):
    # a reward of 1 for ever is worth 2 to both; where the extrinsic stream ends, the intrinsic one goes on: rows of
    # -1 (reward 0) and 1 (reward 1) in random order, so that what comes next is worth (0 + 1) / 2 / (1 - 0.5) = 1
    assert float(values(trained[1]["endless"], 0.0)[1]) == pytest.approx(2.0, abs=0.1)
    for obs, reward in ((-1.0, 0.0), (1.0, 1.0)):
        assert float(values(trained[1]["two_steps"], obs)[1]) == pytest.approx(reward + 0.5 * 1.0, abs=0.2)


def test_policy_finds_the_best_action(trained):
    # reward -(action - obs / 2)^2
    ppo, states = trained
    act = jax.jit(ppo.act_greedily)
    for obs in (-1.0, 1.0):
        greedy = act(ppo.actor(states["target_action"]), np.array([obs], np.float32))
        assert float(greedy[0]) == pytest.approx(obs / 2, abs=0.1)


@pytest.mark.slow
def test_balances_a_pole():
    # an episode is 200 steps if the pole stays up, about 20 under random pushes
    config = PPOConfig(
        hidden=(64, 64), rollout_steps=1024, minibatch_size=64, epochs=10, extrinsic_weight=1.0, intrinsic_weight=0.0
    )
    ppo = make_ppo(4, 1, config)

    def rollout(carry, key):
        learned, state, count = carry
        learn_key, steps_key = jax.random.split(key)

        def go(carry, step_key):
            state, count = carry
            act_key, reset_key = jax.random.split(step_key)
            action = ppo.act(act_key, ppo.actor(learned), state)
            after, count, row = classic.advance(reset_key, state, count, action)
            return (after, count), (row, ppo.log_prob(ppo.actor(learned), state, action))

        (state, count), (rows, log_prob) = jax.lax.scan(go, (state, count), jax.random.split(steps_key, 1024))
        taken = Rollout(rows, jnp.zeros(1024), log_prob)
        return (ppo.update(learn_key, learned, taken, state, jnp.int32(1024))[0], state, count), None

    start = (ppo.init(jax.random.key(0)), classic.reset(jax.random.key(2)), jnp.int32(0))
    learned = jax.jit(lambda: jax.lax.scan(rollout, start, jax.random.split(jax.random.key(1), 40))[0][0])()
    act = lambda key, obs: ppo.act_greedily(ppo.actor(learned), obs)  # noqa: E731
    assert classic.episode_length(act, jax.random.key(3)) > 180


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"clip": 0.0}, r"PPOConfig\.clip=0\.0 .*\(0, inf"),
        ({"gae_lambda": 1.5}, r"PPOConfig\.gae_lambda=1\.5 .*\[0, 1\]"),
        ({"epochs": 0}, r"PPOConfig\.epochs=0 .*1 or more"),
        ({"rollout_steps": 16}, r"minibatch_size=32 .*at most rollout_steps=16"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        PPOConfig(**settings)
