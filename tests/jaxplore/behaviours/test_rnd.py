"""Random network distillation: what is seen stops being new, what is not stays so, and who learns from what when."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, replay
from jaxplore.behaviours import Experience, ReactiveConfig, make_rnd_learner, make_rnd_ppo
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.learners.base import Learner
from jaxplore.learners.ppo import PPOConfig
from jaxplore.methods import METHODS
from jaxplore.signals.distillation import RNDConfig, init_scale, make_rnd, update_scale
from jaxplore.types import Transition

SMALL = RNDConfig(hidden=(16,), features=8, lr=3e-3)


def test_the_bonus_is_the_mean_squared_error_over_features():
    # against both networks written out: leaky ReLU with slope 0.01, two more layers in the predictor, clip at 5
    rnd = make_rnd(3, SMALL)
    state = jax.jit(rnd.init)(jax.random.key(0))
    obs = jnp.array([[0.5, -1.0, 2.0], [0.5, -9.0, 7.0]])

    def run(params, x):
        for name in sorted(name for name in params if name.startswith("hidden_")):
            x = x @ params[name]["kernel"] + params[name]["bias"][None]
            x = jnp.where(x > 0, x, 0.01 * x)
        return x @ params["output"]["kernel"] + params["output"]["bias"][None]

    assert [len(state.target), len(state.predictor)] == [2, 4]
    seen = jnp.clip(obs, -5, 5)
    want = jnp.mean((run(state.target, seen) - run(state.predictor, seen)) ** 2, axis=-1)
    np.testing.assert_allclose(rnd.error(state, obs), want, rtol=1e-5)
    np.testing.assert_allclose(rnd.error(state, obs[1]), want[1], rtol=1e-5)
    # orthogonal, gain sqrt 2
    kernel = state.target["output"]["kernel"]
    np.testing.assert_allclose(kernel.T @ kernel, 2 * np.eye(8), atol=1e-5)


def test_the_error_falls_on_what_is_seen_and_not_on_what_is_not():
    # 400 steps on a cloud around (1, 0, 0); one around (-1, 1, 0) is never shown, nor one whose weights are 0
    rnd = make_rnd(3, SMALL)
    centres = jnp.array([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0]])
    clouds = centres[:, None] + 0.2 * jax.random.normal(jax.random.key(1), (2, 64, 3))
    weights = jnp.concatenate([jnp.ones(64), jnp.zeros(64)])

    def step(state, _):
        return rnd.update(state, clouds.reshape(128, 3), weights)[0], None

    first = jax.jit(rnd.init)(jax.random.key(0))
    last = jax.jit(lambda state: jax.lax.scan(step, state, length=400)[0])(first)
    seen, unseen = (np.asarray(jnp.mean(rnd.error(last, c)) / jnp.mean(rnd.error(first, c))) for c in clouds)
    assert seen < 0.02
    assert unseen > 10 * seen
    jax.tree.map(np.testing.assert_array_equal, last.target, first.target)


def test_rewards_are_scaled_by_the_spread_of_their_discounted_sum_in_time():
    # rewards come in several calls, some left out; the sums run forward in time and are not centred
    rng = np.random.default_rng(0)
    rewards, valid = rng.uniform(size=50), rng.uniform(size=50) < 0.7
    scale = init_scale()
    assert float(scale.std) == 1.0
    for part in (slice(0, 20), slice(20, 50)):
        scale = update_scale(scale, jnp.asarray(rewards[part], jnp.float32), jnp.asarray(valid[part]), 0.9)
    running, sums = 0.0, []
    for reward in rewards[valid]:
        running = 0.9 * running + reward
        sums.append(running)
    assert float(scale.running) == pytest.approx(running, rel=1e-5)
    assert float(scale.std) == pytest.approx(np.std(sums), rel=1e-4)


# In rounds.

OBS, ACTION, PER_ROUND, WARM_UP = 2, 1, 3, 4
PPO = PPOConfig(hidden=(4,), rollout_steps=8, minibatch_size=4, epochs=1)


def rows(first, count):
    """Transitions number `first` on: their observations tell their number."""
    obs = jnp.stack([jnp.arange(first, first + count, dtype=jnp.float32), jnp.zeros(count)], axis=1)
    flags = jnp.zeros(count, bool)
    return Transition(obs, jnp.sin(obs[:, :1]), jnp.zeros(count), obs + 1, flags, flags)


def play(behaviour, rounds, capacity):
    """`(states, metrics)` after the random steps and after each round of `PER_ROUND` steps."""
    data = replay.init(jax.tree.map(lambda leaf: leaf[0], rows(0, 1)), capacity)
    normalizers = dynamics.init_normalizers(OBS, ACTION)
    improve, state, num, seen = jax.jit(behaviour.improve), behaviour.init(jax.random.key(0)), 0, []
    for i in range(rounds + 1):
        count = PER_ROUND if i else WARM_UP
        fresh = rows(num, count)
        data, num = replay.add(data, fresh), num + count
        normalizers = dynamics.update_normalizers(normalizers, fresh, jnp.ones(count, bool))
        state, metrics = improve(
            jax.random.key(i), state, Experience((), data, jnp.int32(num), normalizers, fresh.next_obs[-1])
        )
        seen.append((state, metrics, normalizers))
    return seen


@pytest.mark.parametrize("capacity", [100, 7])
def test_ppo_learns_every_so_many_steps_from_the_steps_of_its_own_policy(capacity):
    # 4 random steps, then 3 a round, 8 an update: after 9, 18, 24 of its own, with no random ones among them, whether
    # or not the replay has come round; statistics and policy stand still in between
    behaviour = make_rnd_ppo(OBS, ACTION, PER_ROUND, WARM_UP, PPO, SMALL)
    seen = play(behaviour, 8, capacity)
    assert [int(metrics["updated"]) for _, metrics, _ in seen] == [0, 0, 0, 1, 0, 0, 1, 0, 1]
    assert [int(state.num) for state, _, _ in seen] == [0, 3, 6, 0, 3, 6, 0, 3, 0]
    np.testing.assert_array_equal(seen[2][0].steps.obs[:6, 0], WARM_UP + np.arange(6))
    np.testing.assert_array_equal(seen[5][0].steps.obs[:6, 0], WARM_UP + 9 + np.arange(6))
    for i in (1, 2, 4, 5):
        for part in ("ppo", "rnd", "obs", "scale"):
            jax.tree.map(np.testing.assert_array_equal, getattr(seen[i][0], part), getattr(seen[i - 1][0], part))
    for i in (3, 6, 8):
        for part in ("ppo", "rnd", "obs"):
            before, after = (jax.tree.leaves(getattr(seen[k][0], part)) for k in (i - 1, i))
            assert any(not np.array_equal(a, b) for a, b in zip(before, after, strict=True)), part
        jax.tree.map(np.testing.assert_array_equal, seen[i][0].obs, seen[i][2].obs)
        assert float(seen[i][1]["rnd_error"]) > 0


def test_probabilities_are_those_under_the_policy_that_acted():
    # with one gradient step per update the ratio is 1: nothing is clipped, no divergence, though the statistics of all
    # data have moved meanwhile
    config = PPOConfig(hidden=(4,), rollout_steps=8, minibatch_size=8, epochs=1)
    seen = play(make_rnd_ppo(OBS, ACTION, PER_ROUND, WARM_UP, config, SMALL), 6, 100)
    for i in (3, 6):
        assert float(seen[i][1]["kl"]) == pytest.approx(0.0, abs=1e-6)
        assert float(seen[i][1]["clipped"]) == 0.0
    behaviour = make_rnd_ppo(OBS, ACTION, PER_ROUND, WARM_UP, config, SMALL)
    state, _, normalizers = seen[5]
    one, other = (behaviour.act(jax.random.key(0), behaviour.actor(state), n, jnp.ones(2)) for n in (normalizers, None))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("normalize_reward", [False, True])
def test_a_learner_gets_the_bonus_of_successors_as_reward(normalize_reward):
    # what it is shown: normalised observations and errors of the predictor as it is after the round, over the spread
    # of their sum in time or over their own
    def update(key, state, batch):
        return batch, {"mean": jnp.mean(batch.reward)}

    batch = Transition(
        jnp.zeros((8, OBS)), jnp.zeros((8, ACTION)), jnp.zeros(8), jnp.zeros((8, OBS)), *[jnp.zeros(8, bool)] * 2
    )
    spy = Learner(
        init=lambda key: batch,
        actor=lambda state: (),
        act=lambda key, actor, obs: obs[..., :1],
        act_greedily=lambda actor, obs: -obs[..., :1],
        update=update,
        batch_size=8,
    )
    config = ReactiveConfig(updates=2, normalize_reward=normalize_reward)
    behaviour = make_rnd_learner(spy, OBS, PER_ROUND, config, SMALL)
    seen, rnd = play(behaviour, 3, 100), make_rnd(OBS, SMALL)
    jax.tree.map(np.testing.assert_array_equal, seen[0][0].rnd, behaviour.init(jax.random.key(0)).rnd)
    for state, metrics, normalizers in seen[1:]:
        shown = state.learner
        mean, std = normalizers.obs.mean[None], normalizers.obs.std[None]
        np.testing.assert_allclose(shown.obs * std + mean + 1, shown.next_obs * std + mean, atol=1e-4)
        errors, spread = rnd.error(state.rnd, shown.next_obs), float(state.scale.std)
        if normalize_reward:
            # the successors of all rows so far; 1,024 draws of them have their spread within a tenth
            held = np.arange(1.0, state.position + 1)
            every = jnp.stack([jnp.asarray(held), jnp.ones(len(held))], axis=1)
            spread = float(jnp.std(rnd.error(state.rnd, (every - mean) / std)))
        np.testing.assert_allclose(shown.reward, errors / spread, rtol=0.1 if normalize_reward else 1e-4)
        assert float(metrics["intrinsic_reward"]) > 0
    before, after = (np.asarray(state.rnd.predictor["output"]["kernel"]) for state, _, _ in seen[:2])
    assert not np.array_equal(before, after)


def test_refusals():
    with pytest.raises(ValueError, match=r"PPOConfig\.rollout_steps=8 .*at least steps_per_round=9"):
        make_rnd_ppo(OBS, ACTION, 9, WARM_UP, PPO, SMALL)
    with pytest.raises(ValueError, match=r"RNDConfig\.features=0 .*1 or more"):
        RNDConfig(features=0)
    for name in ("rnd", "rnd_sac"):
        method, config = METHODS[name], ExplorationConfig(data_capacity=25)
        belief, score = method.belief(Sizes(3, 1), config), method.reward(config).score
        with pytest.raises(ValueError, match=r"data_capacity=25 .*at least steps_per_round \+ 1 = 26"):
            method.behaviour(Sizes(3, 1), config, belief, score)
