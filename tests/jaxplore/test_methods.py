"""Every row of the methods table fits the loop, as far as shapes tell, and reads the settings that it says."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import behaviours, beliefs, dynamics
from jaxplore.behaviours.gradient import GradientPolicyConfig
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.exploration import make_explorer
from jaxplore.learners import sac
from jaxplore.learners.ddpg import DDPGConfig
from jaxplore.learners.ddqn import DDQNConfig
from jaxplore.learners.ppo import PPOConfig
from jaxplore.methods import METHODS, SHARED
from jaxplore.signals.distillation import UNIT, RNDConfig
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


class Recorder:
    """A configuration that notes which of its fields are read."""

    def __init__(self, config):
        self._config, self.seen = config, set()

    def __getattr__(self, name):
        self.seen.add(name)
        return getattr(self._config, name)


CHAIN = dataclasses.replace(CONFIG, planner="mcts", dynamics=dynamics.DynamicsConfig(hidden=(4,), target="one_hot"))
FINITE = tuple(name for name, row in METHODS.items() if row.fits(Sizes(3, 2, discrete=True, one_hot_obs=True)))


@pytest.mark.parametrize(
    ("name", "config", "sizes"),
    [
        *((name, CONFIG, Sizes(3, 2)) for name, row in METHODS.items() if row.actions != "discrete"),
        *((name, CONFIG, Sizes(3, 2, True)) for name, row in METHODS.items() if row.actions != "continuous"),
        *((name, CHAIN, Sizes(3, 2, True, True)) for name in FINITE),
    ],
)
def test_a_method_reads_the_settings_that_it_declares(name, config, sizes):
    # no more, so that what a user sets is refused where it does nothing; and no fewer, so that it is not refused where
    # it does something. Read while signal and behaviour are made; what all methods share counts for none
    method = METHODS[name]
    config = method.settings(config)
    recorder = Recorder(config)
    signal = method.signal(sizes, recorder)
    method.behaviour(sizes, recorder, signal)
    declared = method.reads(config, sizes) - set(SHARED)
    assert declared == method.reads(recorder, sizes) - set(SHARED)
    if signal.belief.predict is None:
        assert recorder.seen - set(SHARED) == declared
    else:
        # Of every belief the divergence is reported, too.
        assert recorder.seen - set(SHARED) | {"renyi_decay"} == declared
    assert set(SHARED) <= method.reads(config, sizes)
    assert declared <= {field.name for field in dataclasses.fields(ExplorationConfig)}


def test_the_chain_has_every_method_of_its_figure_and_those_on_real_transitions():
    """The paper's are `implicit`, `max`, `icm` and `disagreement`, beside double DQN, which needs a task."""
    assert {"implicit", "max", "icm", "disagreement", "random", "prediction_error", "rnd_sac"} <= set(FINITE)
    assert not {"icm_active", "max_trajectory", "rnd_active", "ddqn", "sac", "rnd"} & set(FINITE)


def test_a_policy_on_real_transitions_sees_one_hot_states_as_they_are():
    """Normalised, the state that was seen least would be the largest number."""
    sizes = Sizes(3, 2, discrete=True, one_hot_obs=True)
    row = METHODS["icm"]
    behaviour = row.behaviour(sizes, CHAIN, row.signal(sizes, CHAIN))
    state = behaviour.init(jax.random.key(0))
    actor, obs, key = behaviour.actor(state), jnp.eye(3), jax.random.key(1)
    plain = dynamics.init_normalizers(3, 2)
    odd = dataclasses.replace(plain, obs=dataclasses.replace(plain.obs, mean=jnp.array([5.0, -9.0, 2.0])))
    assert behaviour.act_greedily is not None
    acted = [behaviour.act_greedily(key, actor, normalizers, obs) for normalizers in (plain, odd)]
    np.testing.assert_array_equal(*acted)
    sizes = Sizes(3, 2, discrete=True)
    behaviour = row.behaviour(sizes, CONFIG, row.signal(sizes, CONFIG))
    assert behaviour.act_greedily is not None
    normalized = [behaviour.act_greedily(key, actor, normalizers, obs) for normalizers in (plain, odd)]
    assert not np.array_equal(*normalized)


def test_planners_read_their_own_settings():
    # and not the other's
    assert {"sac", "imagination"} <= METHODS["implicit"].reads(CONFIG) and "mcts" not in METHODS["implicit"].reads(
        CONFIG
    )
    assert "mcts" in METHODS["implicit"].reads(CHAIN) and not {"sac", "imagination"} & METHODS["implicit"].reads(CHAIN)


def test_the_learner_that_is_read_hangs_on_the_actions():
    # and where they are not known on what departs from the defaults, so that a run's identity has it
    numbers, choices = Sizes(3, 2), Sizes(3, 2, discrete=True)
    changed = dataclasses.replace(CONFIG, ddqn=DDQNConfig(batch_size=8))
    for name in ("implicit", "icm", "icm_active", "rnd_sac", "rnd_active"):
        reads = METHODS[name].reads
        assert "sac" in reads(changed, numbers) and "ddqn" not in reads(changed, numbers)
        assert "ddqn" in reads(CONFIG, choices) and "sac" not in reads(CONFIG, choices)
        assert reads(CONFIG) == reads(CONFIG, numbers)
        assert reads(changed) == reads(changed, numbers) | {"ddqn"}
    assert METHODS["implicit_grad"].reads(changed) == METHODS["implicit_grad"].reads(CONFIG)
    assert METHODS["ddqn"].reads(changed) == METHODS["ddqn"].reads(CONFIG, choices)


DELTA, RAW, OF_OBS = "normalised delta, squared", "raw units, squared", "std of the observation, squared"


@pytest.mark.parametrize(
    ("name", "settings", "unit"),
    [
        ("implicit", {}, DELTA),
        ("implicit", {"reward_units": "raw"}, RAW),
        ("implicit", {"planner": "mcts", "dynamics": CHAIN.dynamics}, "probability, squared"),
        ("max", {}, "nats"),
        ("max_trajectory", {}, "normalised delta"),
        ("icm", {}, OF_OBS),
        ("icm", {"error_units": "delta"}, DELTA),
        ("rnd", {}, UNIT),
        ("rnd_sac", {}, UNIT),
        ("rnd_active", {}, UNIT),
    ],
)
def test_the_intrinsic_reward_has_a_unit(name, settings, unit):
    # by the settings; labels of plots have it
    chain = "planner" in settings
    explorer = make_explorer(METHODS[name], Sizes(3, 2, chain, chain), dataclasses.replace(CONFIG, **settings))
    assert explorer.reward_unit == unit


@pytest.mark.parametrize("name", ["ddqn", "psne", "psne_no_norm", "sac", "sac_v2", "sac_explorer", "random"])
def test_methods_without_an_intrinsic_reward_report_none(name):
    # whatever the transitions are
    sizes = Sizes(3, 2, discrete=name == "ddqn", has_reward=True)
    explorer = make_explorer(METHODS[name], sizes, CONFIG)
    obs, flags = np.ones((ROWS, 3), np.float32), np.ones(ROWS, bool)
    rows = Transition(obs, obs[:, :2], obs[:, 0], obs, ~flags, ~flags)
    assert explorer.reward_unit is None
    state = jax.eval_shape(explorer.init, jax.random.key(0))
    assert jax.eval_shape(explorer.assess, jax.random.key(1), state, rows, flags) == {}
