"""Imagination with discrete actions on observations that are numbers: double DQN in place of SAC."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, networks, replay, rewards
from jaxplore.behaviours import Experience, ImaginationConfig, make_imagination
from jaxplore.beliefs import make_no_belief
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import Prediction
from jaxplore.exploration import make_explorer
from jaxplore.learners.ddqn import DDQNConfig, make_ddqn
from jaxplore.methods import METHODS
from jaxplore.signals import Reward, make_belief_signal
from jaxplore.types import Transition
from tests.jaxplore import programs

NORMALIZERS = dynamics.init_normalizers(1, 2)
CONFIG = ImaginationConfig(
    num_actors=32,
    horizon=10,
    num_rollouts=15,
    num_random_rollouts=1,
    updates_per_rollout=100,
    real_updates=0,
    current_fraction=0.5,
    mover="mean",
    replay_capacity=4800,
)
DDQN = DDQNConfig(
    hidden=(32, 32), lr=3e-3, batch_size=64, discount=0.5, target_every=20, epsilon_start=0.5, epsilon_end=0.5
)


def predict(models, inputs):
    """A step leads from x to -x, whatever the choice. Two models: they are 1 from their mean where the choice is the
    second and x > 0, or the first and x < 0, and agree elsewhere.
    """
    x, choice = inputs[:, 0], inputs[:, 2] - inputs[:, 1]
    apart = jnp.where(x * choice > 0, 1.0, 0.0)
    return Prediction(jnp.stack([-2 * x + apart, -2 * x - apart])[..., None])


def learned(config, learner):
    """The behaviour and its state after a round, from past states -1 and 1, as NumPy arrays."""
    belief = make_no_belief()._replace(predict=predict)
    reward = Reward(lambda prediction, delta, normalizers: rewards.variance(prediction), "its own")
    behaviour = make_imagination(make_belief_signal(belief, reward), learner, 1, 2, config, discrete=True)
    obs, flag = jnp.array([[-1.0], [1.0]]), jnp.zeros(2, bool)
    rows = Transition(obs, jnp.eye(2), jnp.zeros(2), -obs, flag, flag)
    data = replay.add(replay.init(jax.tree.map(lambda leaf: leaf[0], rows), 2), rows)
    experience = Experience(jnp.zeros((2, 1)), data, jnp.int32(2), NORMALIZERS, jnp.ones(1))

    @programs.compiled
    def run(key):
        return behaviour.improve(key, behaviour.init(key), experience)[0]

    return behaviour, jax.device_get(run(jax.random.key(0)))


@pytest.fixture(scope="module")
def round_of_ddqn():
    return learned(CONFIG, make_ddqn(1, 2, DDQN))


def test_values_of_imagined_choices(round_of_ddqn):
    # by hand: the choice that models differ on is worth 1 now, and half of as much as ever after: 1 + 2 / 2 = 2; the
    # other 0 + 2 / 2 = 1
    behaviour, state = round_of_ddqn
    value = networks.MLP((32, 32), 2, "tanh")
    obs = np.array([[-1.0], [1.0]], np.float32)
    np.testing.assert_allclose(networks.apply(value, state.learner.params, obs), [[2, 1], [1, 2]], atol=0.1)
    greedy = behaviour.act_greedily(jax.random.key(1), behaviour.actor(state), NORMALIZERS, obs)
    np.testing.assert_array_equal(greedy, [[1, 0], [0, 1]])


def test_imagined_choices_are_one_hot(round_of_ddqn):
    # in random rollouts and in those of the policy, which is uniform half of the time and so chooses the best in 3 of 4
    rows = round_of_ddqn[1].imagined.rows
    assert np.array_equal(np.sort(rows.action, axis=1), np.tile([0.0, 1.0], (4800, 1)))
    np.testing.assert_array_equal(rows.next_obs, -rows.obs)
    best = (rows.action[:, 1] > 0) == (rows.obs[:, 0] > 0)
    np.testing.assert_array_equal(rows.reward, best)
    assert abs(np.mean(best[:320]) - 0.5) < 5 * 0.5 / np.sqrt(320)
    assert abs(np.mean(best[-1600:]) - 0.75) < 5 * 0.5 / np.sqrt(1600)


SMALL = ExplorationConfig(
    data_capacity=20,
    steps_per_round=5,
    dynamics=dynamics.DynamicsConfig(hidden=(4,)),
    ddqn=DDQNConfig(hidden=(4,), batch_size=4),
)


@pytest.mark.parametrize("name", [name for name, row in METHODS.items() if row.actions == "any"])
def test_methods_run_a_round_where_actions_are_choices(name):
    # as far as shapes tell
    method, sizes = METHODS[name], Sizes(4, 3, discrete=True)
    explorer = make_explorer(method, sizes, method.settings(SMALL))
    obs, flags = jnp.zeros((5, 4)), jnp.zeros(5, bool)
    rows = Transition(obs, jnp.eye(3)[jnp.arange(5) % 3], jnp.zeros(5), obs, flags, flags)

    def one_round(key):
        first = explorer.init(key)
        state = explorer.observe(first, rows, ~flags)
        state, _ = explorer.improve(key, state, obs[0], jnp.int32(5))
        return first, state, explorer.assess(key, state, rows, ~flags), explorer.act(key, explorer.actor(state), obs)

    first, state, _, action = jax.eval_shape(one_round, jax.random.key(0))
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), first) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), state
    )
    assert action.shape == (5, 3)
