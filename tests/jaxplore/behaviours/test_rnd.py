"""Random network distillation in rounds: who learns from what when, and what is reported of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, normalizer, replay
from jaxplore.behaviours import Experience, ReactiveConfig, make_on_policy, make_reactive
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.exploration import make_explorer
from jaxplore.learners.base import Learner
from jaxplore.learners.ppo import PPOConfig
from jaxplore.learners.sac import SACConfig
from jaxplore.methods import METHODS
from jaxplore.signals.distillation import RNDConfig, make_distillation, newest
from jaxplore.types import Transition
from tests.jaxplore import distillation

SMALL = RNDConfig(hidden=(16,), features=8, lr=3e-3)


OBS, ACTION, PER_ROUND, WARM_UP = 2, 1, 3, 4
PPO = PPOConfig(hidden=(4,), rollout_steps=8, minibatch_size=4, epochs=1)
SIGNAL = make_distillation(OBS, PER_ROUND, SMALL)


def rows(first, count):
    """Transitions number `first` on: their observations tell their number."""
    number = np.arange(first, first + count, dtype=np.float32)
    obs, flags = np.stack([number, np.zeros(count, np.float32)], axis=1), np.zeros(count, bool)
    return Transition(obs, np.sin(obs[:, :1]), np.zeros(count, np.float32), obs + 1, flags, flags)


@jax.jit
def take_in(data, normalizers, fresh):
    valid = jnp.ones(fresh.reward.shape[0], bool)
    return replay.add(data, fresh), dynamics.update_normalizers(normalizers, fresh, valid)


def rounds(num, capacity):
    """The `Experience` after the random steps and after each of `num` rounds of `PER_ROUND` steps."""
    data = replay.init(jax.tree.map(lambda leaf: leaf[0], rows(0, 1)), capacity)
    normalizers, taken = dynamics.init_normalizers(OBS, ACTION), 0
    for i in range(num + 1):
        fresh = rows(taken, PER_ROUND if i else WARM_UP)
        data, normalizers = take_in(data, normalizers, fresh)
        taken += len(fresh.reward)
        yield Experience((), data, np.int32(taken), normalizers, fresh.next_obs[-1])


def play(behaviour, num, capacity):
    """`(state, metrics, normalizers)` after the random steps and after each round."""
    improve, state, seen = jax.jit(behaviour.improve), jax.jit(behaviour.init)(jax.random.key(0)), []
    for i, experience in enumerate(rounds(num, capacity)):
        state, metrics = improve(jax.random.key(i), state, experience)
        seen.append((*jax.device_get((state, metrics)), experience.normalizers))
    return seen


@pytest.mark.parametrize("capacity", [100, 7])
def test_what_a_round_brought_is_found_in_the_replay(capacity):
    # by their numbers, whether or not the replay has wrapped around; nothing the first time
    find, position = jax.jit(newest, static_argnums=2), np.int32(-1)
    for i, experience in enumerate(rounds(8, capacity)):
        found, valid, position = find(experience.data, position, PER_ROUND)
        assert np.sum(valid) == (PER_ROUND if i else 0)
        want = WARM_UP + PER_ROUND * (i - 1) + np.arange(PER_ROUND)
        np.testing.assert_array_equal(found.obs[:, 0][valid], want if i else [])
        assert int(position) == (WARM_UP + PER_ROUND * i) % capacity


def test_ppo_learns_every_so_many_steps_from_the_steps_of_its_own_policy():
    # 4 random steps, then 3 a round, 8 an update: after 9, 18, 24 of its own, with no random ones among them, though
    # the replay wraps around; statistics and policy stand still in between
    behaviour = make_on_policy(SIGNAL, OBS, ACTION, PER_ROUND, WARM_UP, PPO)
    seen = play(behaviour, 8, 7)
    assert [int(metrics["updated"]) for _, metrics, _ in seen] == [0, 0, 0, 1, 0, 0, 1, 0, 1]
    assert [int(state.num) for state, _, _ in seen] == [0, 3, 6, 0, 3, 6, 0, 3, 0]
    np.testing.assert_array_equal(seen[2][0].steps.obs[:6, 0], WARM_UP + np.arange(6))
    np.testing.assert_array_equal(seen[5][0].steps.obs[:6, 0], WARM_UP + 9 + np.arange(6))
    for i in (1, 2, 4, 5):
        for part in ("ppo", "own", "obs"):
            jax.tree.map(np.testing.assert_array_equal, getattr(seen[i][0], part), getattr(seen[i - 1][0], part))
    for i in (3, 6, 8):
        for part in ("ppo", "own", "obs"):
            before, after = (jax.tree.leaves(getattr(seen[k][0], part)) for k in (i - 1, i))
            assert any(not np.array_equal(a, b) for a, b in zip(before, after, strict=True)), part
        jax.tree.map(np.testing.assert_array_equal, seen[i][0].obs, seen[i][2].obs)
        assert float(seen[i][1]["rnd_error"]) > 0


def test_probabilities_are_those_under_the_policy_that_acted():
    # with one gradient step per update the ratio is 1: nothing is clipped, no divergence, though the statistics of all
    # data have moved meanwhile. Updates come when they do in a replay that wraps around
    config = PPOConfig(hidden=(4,), rollout_steps=8, minibatch_size=8, epochs=1)
    behaviour = make_on_policy(SIGNAL, OBS, ACTION, PER_ROUND, WARM_UP, config)
    seen = play(behaviour, 6, 100)
    assert [int(metrics["updated"]) for _, metrics, _ in seen] == [0, 0, 0, 1, 0, 0, 1]
    assert [int(state.num) for state, _, _ in seen] == [0, 3, 6, 0, 3, 6, 0]
    np.testing.assert_array_equal(seen[5][0].steps.obs[:6, 0], WARM_UP + 9 + np.arange(6))
    for i in (3, 6):
        assert float(seen[i][1]["kl"]) == pytest.approx(0.0, abs=1e-6)
        assert float(seen[i][1]["clipped"]) == 0.0
    state, _, normalizers = seen[5]
    one, other = (behaviour.act(jax.random.key(0), behaviour.actor(state), n, jnp.ones(2)) for n in (normalizers, None))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("normalize_reward", "std_draws"), [(False, 0), (True, 0), (True, 1024)])
def test_a_learner_gets_the_bonus_of_successors_as_reward(normalize_reward, std_draws):
    # what it is shown: normalised observations and errors of the predictor as it is after the round, over the spread
    # of their sum in time or over their own
    batch = rows(0, 8)
    spy = Learner(
        init=lambda key: jax.tree.map(jnp.asarray, batch),
        actor=lambda state: (),
        act=lambda key, actor, obs: obs[..., :1],
        act_greedily=lambda actor, obs: -obs[..., :1],
        update=lambda key, state, batch: (batch, {"mean": jnp.mean(batch.reward)}),
        batch_size=8,
    )
    config = ReactiveConfig(updates=2, normalize_reward=normalize_reward)
    behaviour = make_reactive(SIGNAL, spy, OBS, ACTION, config, lasting=True, std_draws=std_draws)

    @jax.jit
    def one_round(key, own, experience):
        own, metrics = SIGNAL.fit(own, experience.data, experience.normalizers)
        return own, metrics, behaviour.improve(key, behaviour.init(key), experience._replace(own=own))[0]

    first = own = jax.jit(SIGNAL.init)(jax.random.key(0))
    for i, experience in enumerate(rounds(3, 100)):
        own, metrics, shown = jax.device_get(one_round(jax.random.key(i), own, experience))
        if i == 0:
            # The random steps teach nothing.
            jax.tree.map(np.testing.assert_array_equal, own.rnd, first.rnd)
            continue
        obs = experience.normalizers.obs
        mean, std = (np.asarray(leaf)[None] for leaf in (obs.mean, obs.std))
        np.testing.assert_allclose((shown.obs * std + mean + 1)[:, 0], (shown.next_obs * std + mean)[:, 0], atol=1e-4)
        # the second entry of all observations is 0, so that 1 is 1,000 of the smallest standard deviation away
        np.testing.assert_array_equal(shown.next_obs[:, 1], normalizer.LIMIT)
        errors, spread = distillation.error(own.rnd, shown.next_obs), float(own.scale.std)
        if normalize_reward:
            # the successors of all rows so far; 1,024 draws of them have their spread within a tenth
            held = np.arange(1.0, own.position + 1)
            every = np.stack([held, np.ones(len(held))], axis=1)
            spread = float(np.std(distillation.error(own.rnd, np.clip((every - mean) / std, -10, 10))))
        np.testing.assert_allclose(shown.reward, errors / spread, rtol=0.1 if std_draws else 1e-3)
        assert float(metrics["rnd_error"]) > 0
        assert not np.array_equal(own.rnd.predictor["output"]["kernel"], first.rnd.predictor["output"]["kernel"])


@pytest.mark.parametrize("name", ["rnd", "rnd_sac", "rnd_active"])
def test_the_distillation_error_of_new_transitions_is_reported(name):
    # by hand, of valid rows alone, on observations normalised as the predictor sees them: by all data, or with PPO once
    # it has started by the statistics of its last update, here mean 0 and standard deviation 1
    config = ExplorationConfig(
        steps_per_round=PER_ROUND,
        data_capacity=20,
        ppo=PPO,
        rnd=SMALL,
        sac=SACConfig(hidden=(4,), batch_size=4),
        dynamics=dynamics.DynamicsConfig(hidden=(4,)),
    )
    explorer = make_explorer(METHODS[name], Sizes(OBS, ACTION), config)
    taken, valid = rows(0, 12), np.arange(7) % 3 != 1
    start = jax.jit(lambda key: explorer.observe(explorer.init(key), taken, jnp.ones(12, bool)))
    state, assess, new = start(jax.random.key(0)), jax.jit(explorer.assess), rows(20, 7)

    def reported_and_wanted(state, mean, std):
        own = state.behaviour.own if name == "rnd" else state.signal
        want = distillation.error(jax.device_get(own.rnd), (new.next_obs[valid] - mean) / std)
        got = assess(jax.random.key(1), state, new, valid)
        assert ("variance" in got) == (name == "rnd_active") and np.min(want) > 0
        told = [float(got[field]) for field in ("intrinsic_reward", "intrinsic_reward_p95")]
        return told, [np.mean(want), np.percentile(want, 95)]

    # a constant entry has the smallest standard deviation that is divided by
    std = np.maximum(np.std(taken.obs, axis=0), 1e-3)
    np.testing.assert_allclose(*reported_and_wanted(state, np.mean(taken.obs, axis=0), std), rtol=1e-4)
    if name == "rnd":
        state = state.replace(behaviour=state.behaviour.replace(position=jnp.int32(12)))
        np.testing.assert_allclose(*reported_and_wanted(state, 0.0, 1.0), rtol=1e-4)


def test_refusals():
    with pytest.raises(ValueError, match=r"PPOConfig\.rollout_steps=8 .*at least steps_per_round=9"):
        make_on_policy(SIGNAL, OBS, ACTION, 9, WARM_UP, PPO)
    with pytest.raises(ValueError, match=r"RNDConfig\.features=0 .*1 or more"):
        RNDConfig(features=0)
    for name in ("rnd", "rnd_sac", "rnd_active"):
        method, config = METHODS[name], ExplorationConfig(data_capacity=25)
        with pytest.raises(ValueError, match=r"data_capacity=25 .*at least steps_per_round \+ 1 = 26"):
            method.signal(Sizes(3, 1), config)
