"""Double DQN on targets worked by hand, and on probes whose values are known."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore.learners.ddqn import DDQNConfig, make_ddqn
from jaxplore.types import Transition
from tests.jaxplore import probes


def constant_networks(ddqn, q, target):
    """Networks that say the same everywhere: zero kernels, and these numbers as the last biases."""
    shapes = jax.eval_shape(ddqn.init, jax.random.key(0))
    state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    state.params["output"]["bias"][:] = q
    state.target["output"]["bias"][:] = target
    return state


def one_step(action, reward, terminated=False, truncated=False):
    """A batch of one transition between two observations of 2 entries."""
    flags, obs = (np.array([terminated]), np.array([truncated])), np.ones((1, 2), np.float32)
    return Transition(obs, np.array([action], np.float32), np.array([reward], np.float32), -obs, *flags)


def test_targets_of_one_transition():
    # by hand: the online network prefers action 1 (3 over 1), which the frozen one holds for worth 10, though it
    # prefers action 0 (20); so the target is 0.7 + 0.9 * 10 = 9.7 (a plain maximum would make it 18.7), or 0.7 at an
    # end; a time limit is none. Huber's loss of an error e: e^2 / 2 up to 1, |e| - 1 / 2 beyond
    ddqn = make_ddqn(2, 2, DDQNConfig(hidden=(3,), discount=0.9))
    update = jax.jit(ddqn.update)
    state = constant_networks(ddqn, q=[1.0, 3.0], target=[20.0, 10.0])
    for terminated, truncated in itertools.product((False, True), repeat=2):
        metrics = update(jax.random.key(1), state, one_step([1.0, 0.0], 0.7, terminated, truncated))[1]
        assert float(metrics["q"]) == 1.0
        assert float(metrics["q_loss"]) == pytest.approx(0.3**2 / 2 if terminated else 8.7 - 0.5, rel=1e-5)


def test_an_update_moves_the_value_of_the_action_taken():
    # Adam's first step is lr times the gradient's sign: up to the target for the action taken, nothing for the others
    ddqn = make_ddqn(2, 3, DDQNConfig(hidden=(3,), lr=0.01))
    state = constant_networks(ddqn, q=[1.0, 3.0, 2.0], target=[0.0, 0.0, 0.0])
    update = jax.jit(ddqn.update)
    after, _ = update(jax.random.key(1), state, one_step([0.0, 0.0, 1.0], 5.0, terminated=True))
    np.testing.assert_allclose(after.params["output"]["bias"], [1.0, 3.0, 2.01], atol=1e-6)
    jax.tree.map(np.testing.assert_array_equal, after.target, state.target)
    # the largest entry counts, whatever the others are
    relaxed, _ = update(jax.random.key(1), state, one_step([-0.2, 0.1, 0.3], 5.0, terminated=True))
    jax.tree.map(np.testing.assert_array_equal, relaxed, after)


def test_the_frozen_network_is_copied_every_k_updates():
    # k = 3: a copy of the network as it is after updates 3 and 6, untouched between
    ddqn = make_ddqn(2, 2, DDQNConfig(hidden=(4,), lr=0.1, target_every=3))
    state, update = jax.jit(ddqn.init)(jax.random.key(0)), jax.jit(ddqn.update)
    jax.tree.map(np.testing.assert_array_equal, state.target, state.params)
    copy = state.params
    for i in range(1, 8):
        state, _ = update(jax.random.key(1), state, one_step([1.0, 0.0], 1.0))
        copy = state.params if i % 3 == 0 else copy
        jax.tree.map(np.testing.assert_array_equal, state.target, copy)
        assert int(state.num_updates) == i
        same = np.array_equal(state.target["output"]["bias"], state.params["output"]["bias"])
        assert same == (i % 3 == 0)


@pytest.mark.parametrize(
    ("settings", "want"),
    [
        # 1 -> 0.1 over 490 steps, 147 of which come before the first update
        ({}, {0: 0.73, 1: 1 - 0.9 * 148 / 490, 98: 0.55, 343: 0.1, 5000: 0.1}),
        ({"epsilon_offset": 0, "epsilon_steps": 10}, {0: 1.0, 5: 0.55, 10: 0.1, 11: 0.1}),
        ({"epsilon_start": 0.1}, {0: 0.1, 200: 0.1, 5000: 0.1}),
        ({"epsilon_start": 0.0, "epsilon_end": 1.0, "epsilon_offset": 0, "epsilon_steps": 4}, {1: 0.25, 9: 1.0}),
    ],
)
def test_epsilon_falls_linearly_with_the_updates(settings, want):
    ddqn = make_ddqn(2, 2, DDQNConfig(hidden=(3,), **settings))
    state = constant_networks(ddqn, [0.0, 1.0], [0.0, 0.0])
    for num_updates, epsilon in want.items():
        actor = ddqn.actor(state.replace(num_updates=jnp.int32(num_updates)))
        assert float(actor.epsilon) == pytest.approx(epsilon, abs=1e-6)


def test_actions_are_epsilon_greedy():
    # epsilon 0.4 and 4 choices: the best one has 0.6 + 0.4 / 4 = 0.7, the others 0.1 each (20,000 draws: +-0.0065)
    ddqn = make_ddqn(2, 4, DDQNConfig(hidden=(3,), epsilon_start=0.4, epsilon_end=0.4))
    actor = ddqn.actor(constant_networks(ddqn, [0.0, -1.0, 2.0, 1.0], [9.0, 0.0, 0.0, 0.0]))
    greedy = jax.jit(ddqn.act_greedily)(actor, np.ones((3, 2), np.float32))
    np.testing.assert_array_equal(greedy, [[0, 0, 1, 0]] * 3)
    actions = jax.device_get(jax.jit(ddqn.act)(jax.random.key(0), actor, np.ones((100, 200, 2), np.float32)))
    assert actions.shape == (100, 200, 4)
    assert np.all(actions.sum(axis=-1) == 1)
    assert set(np.unique(actions)) == {0.0, 1.0}
    np.testing.assert_allclose(actions.mean(axis=(0, 1)), [0.1, 0.1, 0.7, 0.1], atol=0.013)


def choice(key, num):
    """Reward obs for the second choice and -obs for the first, then the end: Q is that, and the best is by obs."""
    batch = probes.predictable(key, num)
    return batch._replace(reward=jnp.sign(batch.action[:, 0]) * batch.obs[:, 0])


NAMES = ("constant", "predictable", "two_steps", "endless")


@pytest.fixture(scope="module")
def trained():
    """Double DQN on batches of 64 from each probe with a discount of 0.5, side by side in one program."""
    config = DDQNConfig(hidden=(32, 32), lr=3e-3, discount=0.5, target_every=20)
    ddqn = make_ddqn(1, 2, config)

    def learn(rows):
        # The probes push; here a push to the left is the first choice, one to the right the second.
        rows = rows._replace(action=jax.nn.one_hot((rows.action[..., 0] > 0).astype(int), 2))
        step = lambda state, batch: ddqn.update(jax.random.key(0), state, batch)  # noqa: E731
        return jax.lax.scan(step, ddqn.init(jax.random.key(0)), rows)[0]

    makers = {**{name: probes.PROBES[name] for name in NAMES}, "choice": choice}
    states = probes.train_on_each(list(makers.values()), learn, 1500)
    return ddqn, dict(zip(makers, states, strict=True))


def values(state, obs):
    """Both action values at one observation: a tanh network written out."""
    x = np.array([obs])
    for name in ("hidden_0", "hidden_1"):
        x = np.tanh(x @ state.params[name]["kernel"] + state.params[name]["bias"])
    return x @ state.params["output"]["kernel"] + state.params["output"]["bias"]


@pytest.mark.parametrize(
    ("probe", "want"),
    [
        ("constant", {0.0: 1.0}),
        ("predictable", {-1.0: -1.0, 1.0: 1.0}),
        ("two_steps", {-1.0: 0.5, 1.0: 1.0}),
        ("endless", {0.0: 2.0}),
        ("choice", {-1.0: [1.0, -1.0], 1.0: [-1.0, 1.0]}),
    ],
)
def test_values_of_the_probes(trained, probe, want):
    # see probes.py
    for obs, value in want.items():
        np.testing.assert_allclose(values(trained[1][probe], obs), np.broadcast_to(value, 2), atol=0.05)


def test_the_best_choice_depends_on_what_is_seen(trained):
    ddqn, states = trained
    act = jax.jit(lambda state, obs: ddqn.act_greedily(ddqn.actor(state), obs))
    greedy = act(states["choice"], np.array([[-1.0], [1.0]], np.float32))
    np.testing.assert_array_equal(greedy, [[1, 0], [0, 1]])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"discount": 1.01}, r"DDQNConfig\.discount=1\.01 .*\[0, 1\]"),
        ({"epsilon_end": -0.1}, r"DDQNConfig\.epsilon_end=-0\.1 .*\[0, 1\]"),
        ({"target_every": 0}, r"DDQNConfig\.target_every=0 .*1 or more"),
        ({"epsilon_steps": 0}, r"DDQNConfig\.epsilon_steps=0 .*1 or more"),
        ({"epsilon_offset": -1}, r"DDQNConfig\.epsilon_offset=-1 .*0 or more"),
        ({"activation": "tahn"}, r"DDQNConfig\.activation='tahn' is not known\. Did you mean 'tanh'"),
        ({"lr": 0.0}, r"DDQNConfig\.lr=0\.0 .*\(0, inf"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        DDQNConfig(**settings)


def test_fewer_than_two_choices_are_refused():
    with pytest.raises(ValueError, match=r"num_actions=1 is out of range\. Allowed: a whole number, 2 or more"):
        make_ddqn(3, 1)
