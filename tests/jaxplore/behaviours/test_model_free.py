"""Learners on real transitions and the environment's own reward: what they are shown, and that they learn from it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, replay
from jaxplore.behaviours import Experience, ModelFreeConfig, make_model_free
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.exploration import make_explorer
from jaxplore.learners.base import Learner
from jaxplore.learners.ddqn import DDQNConfig, make_ddqn
from jaxplore.learners.sac import SACConfig, make_sac
from jaxplore.methods import METHODS
from jaxplore.types import Transition
from tests.jaxplore import programs

FLAG = jnp.zeros((), bool)


def experience_of(obs, reward):
    """Real data `obs [T, O]` with `reward [T]`, each observation its own successor, and normalisers fitted to it."""
    count = len(obs)
    flags = np.zeros(count, bool)
    return experience_in(Transition(obs, np.zeros((count, 1), np.float32), reward, obs, flags, flags))


@jax.jit
def experience_in(rows):
    count, obs = len(rows.reward), rows.obs
    data = replay.add(replay.init(jax.tree.map(lambda x: x[0], rows), count), rows)
    normalizers = dynamics.update_normalizers(dynamics.init_normalizers(obs.shape[1], 1), rows, jnp.ones(count, bool))
    return Experience((), data, jnp.int32(count), normalizers, obs[0])


def make_spy(batch_size=256):
    """A learner that remembers what it was shown: updates, and sums of obs, next_obs and reward over batches."""

    def update(key, state, batch):
        shown = jnp.stack([jnp.float32(1), *(jnp.mean(x) for x in (batch.obs, batch.next_obs, batch.reward))])
        return state + shown, {"last": jnp.mean(batch.reward)}

    return Learner(
        init=lambda key: jnp.zeros(4),
        actor=lambda state: state[0],
        act=lambda key, actor, obs: 100 + actor + obs[..., :1],
        act_greedily=lambda actor, obs: actor + obs[..., :1],
        update=update,
        batch_size=batch_size,
    )


@pytest.mark.parametrize("normalize_obs", [True, False])
def test_the_learner_sees_real_data_and_its_own_reward(normalize_obs):
    # observations of 5 +- 2: 0 on average if normalised, else 5; 256 draws a batch, 7 batches
    behaviour = make_model_free(make_spy(), 3, 1, ModelFreeConfig(updates_per_round=7, normalize_obs=normalize_obs))
    obs = np.asarray(5 + 2 * np.random.default_rng(0).normal(size=(100, 3)), np.float32)
    experience, improve = experience_of(obs, np.full(100, -0.25, np.float32)), jax.jit(behaviour.improve)
    state, metrics = improve(jax.random.key(1), behaviour.init(jax.random.key(2)), experience)
    want = 0.0 if normalize_obs else 5.0
    np.testing.assert_allclose(np.asarray(state) / 7, [1, want, want, -0.25], atol=0.25)
    assert float(metrics["last"]) == -0.25
    # a second round goes on from the first
    state, _ = improve(jax.random.key(3), state, experience)
    assert state[0] == 14
    seen = (obs[0, 0] - np.mean(obs[:, 0])) / np.std(obs[:, 0]) if normalize_obs else obs[0, 0]
    action = jax.jit(behaviour.act)(jax.random.key(4), behaviour.actor(state), experience.normalizers, obs[0])
    np.testing.assert_allclose(action, [100 + 14 + seen], rtol=1e-5)


def test_batches_are_new_at_each_update_and_in_each_round():
    # the mean reward of 8 rows drawn from 100 different ones hardly ever comes twice
    behaviour = make_model_free(make_spy(8), 3, 1, ModelFreeConfig(updates_per_round=1))
    experience = experience_of(np.ones((100, 3), np.float32), np.arange(100, dtype=np.float32) ** 2)
    improve, state = jax.jit(behaviour.improve), behaviour.init(jax.random.key(0))
    drawn = [float(improve(jax.random.key(i), state, experience)[1]["last"]) for i in range(5)]
    assert len(set(drawn)) == 5
    twice = make_model_free(make_spy(8), 3, 1, ModelFreeConfig(updates_per_round=2))
    total, metrics = jax.jit(twice.improve)(jax.random.key(0), state, experience)
    assert float(total[3] - metrics["last"]) != pytest.approx(float(metrics["last"]))


def test_acting_greedily_is_a_setting():
    experience = experience_of(np.ones((4, 3), np.float32), np.zeros(4, np.float32))
    for greedy, want in ((True, 1.0), (False, 101.0)):
        behaviour = make_model_free(make_spy(), 3, 1, ModelFreeConfig(act_greedily=greedy, normalize_obs=False))
        assert behaviour.act(jax.random.key(0), jnp.float32(0), experience.normalizers, jnp.ones(3)) == want


def test_any_learner_fits():
    # SAC, as shapes only: its state and metrics come out as they went in
    sac = make_sac(3, 1, SACConfig(hidden=(4,), batch_size=8))
    behaviour = make_model_free(sac, 3, 1)
    experience = experience_of(np.ones((20, 3), np.float32), np.zeros(20, np.float32))
    state = jax.eval_shape(behaviour.init, jax.random.key(0))
    after, metrics = jax.eval_shape(behaviour.improve, jax.random.key(1), state, experience)
    assert jax.tree.map(lambda x: x.shape, after) == jax.tree.map(lambda x: x.shape, state)
    assert metrics.keys() == {"q_loss", "v_loss", "policy_loss", "q", "entropy"}


# Double DQN as a method.


def ddqn_act(sizes, normalize_obs, epsilon=0.0):
    """What `ddqn` does in the 5 one-hot states, as choices, with normalisers far from 0 and 1."""
    ddqn = DDQNConfig(hidden=(8,), epsilon_start=epsilon, epsilon_end=epsilon, lr=0.1)
    config = ExplorationConfig(ddqn=ddqn, model_free=ModelFreeConfig(normalize_obs=normalize_obs))
    method = METHODS["ddqn"]
    behaviour = method.behaviour(sizes, config, method.signal(sizes, config))
    obs = np.linspace(20.0, 80.0, 50, dtype=np.float32).reshape(10, 5)
    learner, experience = make_ddqn(5, 3, ddqn), experience_of(obs, np.zeros(10, np.float32))

    @jax.jit
    def both(key, obs):
        state = behaviour.init(key)
        got = behaviour.act(jax.random.key(1), behaviour.actor(state), experience.normalizers, obs)
        return jnp.argmax(got, axis=-1), jnp.argmax(learner.act_greedily(learner.actor(state), obs), axis=-1)

    return both(jax.random.key(0), np.eye(5, dtype=np.float32))


def test_one_hot_observations_are_never_normalised():
    one_hot, plain = Sizes(5, 3, discrete=True, one_hot_obs=True), Sizes(5, 3, discrete=True)
    for sizes, normalize_obs, same in ((one_hot, True, True), (plain, False, True), (plain, True, False)):
        got, raw = ddqn_act(sizes, normalize_obs)
        assert np.array_equal(got, raw) == same


def test_ddqn_refuses_continuous_actions():
    sizes = Sizes(6, 2, has_reward=True)
    with pytest.raises(ValueError, match=r"method='ddqn' .*numbers in \[-1, 1\], 2 of.*discrete actions, or .*random"):
        make_explorer(METHODS["ddqn"], sizes, ExplorationConfig())


def test_methods_that_need_a_reward_are_refused_where_there_is_none():
    # and the message lists every method that fits, and none that does not
    for name, row in METHODS.items():
        sizes = Sizes(6, 2, discrete=row.actions == "discrete")
        assert row.fits(sizes._replace(has_reward=True))
        assert row.fits(sizes) == (not row.needs_reward)
        if row.needs_reward:
            with pytest.raises(ValueError, match=rf"method='{name}' .*environment has none\. Allowed: ") as caught:
                make_explorer(row, sizes, ExplorationConfig())
            listed = str(caught.value).partition("methods ")[2].rstrip(".").split(", ")
            assert listed == [other for other, fit in METHODS.items() if fit.fits(sizes)]
            assert "random" in listed and name not in listed


NUM_STATES, DISCOUNT = 6, 0.8
FLIPS = np.array([0, 1, 0, 1, 1, 0])


def move(state, choice):
    """A chain: 1 forward, 0 back, exchanged in flip-states, clamped; 0.01 at the start, 1 at the end."""
    forward = (choice == 1) != (FLIPS[state] == 1)
    after = np.clip(state + np.where(forward, 1, -1), 0, NUM_STATES - 1)
    return after, np.where(after == NUM_STATES - 1, 1.0, np.where(after == 0, 0.01, 0.0))


def chain_values():
    """Q of the best policy `[states, 2]`, by value iteration."""
    q = np.zeros((NUM_STATES, 2))
    after, reward = move(np.arange(NUM_STATES)[:, None], np.arange(2)[None])
    for _ in range(300):
        q = reward + DISCOUNT * q.max(axis=1)[after]
    return q


def test_ddqn_learns_a_short_chain():
    # by acting in it, episodes of 10 steps from state 1: every value, and every flip, is found
    config = ExplorationConfig(
        warm_up_steps=1,
        steps_per_round=1,
        data_capacity=2000,
        model_free=ModelFreeConfig(updates_per_round=2),
        ddqn=DDQNConfig(hidden=(64,), lr=3e-3, discount=DISCOUNT, target_every=20, epsilon_end=0.3, epsilon_steps=1000),
    )
    explorer = make_explorer(METHODS["ddqn"], Sizes(NUM_STATES, 2, True, True, True), config)
    after, reward = (jnp.asarray(x) for x in move(np.arange(NUM_STATES)[:, None], np.arange(2)[None]))
    see = lambda state: jax.nn.one_hot(state, NUM_STATES)  # noqa: E731

    def step(carry, t):
        explored, state = carry
        act_key, learn_key = jax.random.split(jax.random.fold_in(jax.random.key(1), t))
        action = explorer.act(act_key, explorer.actor(explored), see(state))
        choice, ends = jnp.argmax(action), t % 10 == 9
        next_state = after[state, choice]
        row = Transition(see(state), action, jnp.float32(reward[state, choice]), see(next_state), FLAG, ends)
        explored = explorer.observe(explored, jax.tree.map(lambda x: x[None], row), jnp.ones(1, bool))
        explored, _ = explorer.improve(learn_key, explored, see(next_state), t + 1)
        return (explored, jnp.where(ends, 1, next_state)), None

    @programs.compiled
    def run(key):
        return jax.lax.scan(step, (explorer.init(key), jnp.int32(1)), jnp.arange(2000))[0][0].behaviour.params

    params = jax.device_get(run(jax.random.key(0)))
    hidden = np.tanh(np.eye(NUM_STATES) @ params["hidden_0"]["kernel"] + params["hidden_0"]["bias"])
    q = hidden @ params["output"]["kernel"] + params["output"]["bias"]
    np.testing.assert_allclose(q, chain_values(), atol=0.3)
    np.testing.assert_array_equal(np.argmax(q, axis=1), 1 - FLIPS)


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match=r"ModelFreeConfig\.updates_per_round=0 .*1 or more"):
        ModelFreeConfig(updates_per_round=0)
    assert dataclasses.replace(ModelFreeConfig(), updates_per_round=1).normalize_obs
