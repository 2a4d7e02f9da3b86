"""Every row of the methods table fits the loop, as far as shapes tell."""

import jax
import jax.numpy as jnp
import pytest

from jaxplore import behaviours, beliefs, dynamics
from jaxplore.behaviours.gradient import GradientPolicyConfig
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.exploration import make_explorer
from jaxplore.learners import sac
from jaxplore.learners.ddpg import DDPGConfig
from jaxplore.learners.ppo import PPOConfig
from jaxplore.methods import METHODS
from jaxplore.signals.distillation import RNDConfig
from jaxplore.types import Transition

NUM_SEEDS, ROWS = 2, 5
CONFIG = ExplorationConfig(
    steps_per_round=ROWS,
    data_capacity=50,
    dynamics=dynamics.DynamicsConfig(hidden=(4,)),
    fit=beliefs.FitConfig(batch_size=4, epochs=0, steps=2),
    imagination=behaviours.ImaginationConfig(num_actors=3, horizon=2, num_rollouts=2),
    sac=sac.SACConfig(hidden=(4,), batch_size=4),
    task_sac=sac.SACConfig(hidden=(4,), batch_size=4),
    ddpg=DDPGConfig(hidden=(4,), batch_size=4),
    gradient=GradientPolicyConfig(hidden=(4,), batch_size=4, horizon=2),
    ppo=PPOConfig(hidden=(4,), rollout_steps=8, minibatch_size=4),
    rnd=RNDConfig(hidden=(4,), features=4),
)


@pytest.mark.parametrize("name", sorted(METHODS))
def test_a_round_keeps_the_shapes_of_the_state(name):
    # under vmap over seeds, with the count of steps shared, as the loop runs it; nothing is compiled. A carried state
    # whose shape or type changed would be compiled anew each round, or refused by a scan
    method = METHODS[name]
    sizes = Sizes(3, 2, discrete=method.actions == "discrete", has_reward=True)
    explorer = make_explorer(method, sizes, method.settings(CONFIG))

    def both(key):
        keys = jax.random.split(key, NUM_SEEDS)
        first = jax.vmap(explorer.init)(keys)
        obs, flags = jnp.zeros((NUM_SEEDS, ROWS, 3)), jnp.zeros((NUM_SEEDS, ROWS), bool)
        rows = Transition(obs, jnp.zeros((NUM_SEEDS, ROWS, 2)), jnp.zeros((NUM_SEEDS, ROWS)), obs, flags, flags)
        state = jax.vmap(explorer.observe)(first, rows, ~flags)
        state, metrics = jax.vmap(explorer.improve, in_axes=(0, 0, 0, None))(keys, state, obs[:, 0], jnp.int32(ROWS))
        action = jax.vmap(lambda key, one, seen: explorer.act(key, explorer.actor(one), seen))(keys, state, obs)
        return first, state, metrics, action

    first, state, metrics, action = jax.eval_shape(both, jax.random.key(0))
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), first) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), state
    )
    assert action.shape == (NUM_SEEDS, ROWS, 2)
    for metric, value in metrics.items():
        assert value.shape == (NUM_SEEDS,) and jnp.issubdtype(value.dtype, jnp.floating), metric
