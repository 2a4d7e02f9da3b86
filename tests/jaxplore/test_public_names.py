"""What `jaxplore` exports suffices: a belief is trained, sampled, imagined in and turned into behaviour by it alone."""

import ast
import functools
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxplore as jx

NUM, NUM_MODELS, NUM_ACTORS, HORIZON = 256, 8, 4, 5


def test_a_belief_is_trained_sampled_and_imagined_in_by_exported_names():
    # a point whose place moves by a tenth of the push: the models learn that, and the policy is trained in them
    belief: jx.Belief = jx.make_generator_belief(
        *(2, 2),
        jx.DynamicsConfig(hidden=(16,)),
        jx.GeneratorConfig(hidden=(16,), noise_size=4),
        jx.SVGDConfig(num_particles=NUM_MODELS, temperature=0.02, tempering="per_datum"),
        jx.FitConfig(lr=3e-3, batch_size=64),
    )
    disagreement = jx.Reward(
        lambda prediction, delta, normalizers: jx.rewards.variance(prediction), "normalised delta, squared"
    )
    signal: jx.Signal = jx.make_belief_signal(belief, disagreement)
    sac: jx.Learner = jx.make_sac(2, 2, jx.SACConfig(hidden=(8,), batch_size=16))
    config = jx.ImaginationConfig(
        num_actors=8,
        horizon=3,
        num_rollouts=2,
        num_random_rollouts=1,
        updates_per_rollout=2,
        real_updates=0,
        replay_capacity=64,
    )
    behaviour: jx.Behaviour = jx.make_imagination(signal, sac, 2, 2, config)

    @jax.jit
    def fit(key):
        """The belief's state, the data, their statistics, and the models' error on them before and after the fit."""
        obs_key, action_key, init_key, steps_key, models_key = jax.random.split(key, 5)
        obs = jax.random.normal(obs_key, (NUM, 2))
        action = jax.random.uniform(action_key, (NUM, 2), minval=-1.0, maxval=1.0)
        zero, flag = jnp.zeros(NUM), jnp.zeros(NUM, bool)
        transitions = jx.Transition(obs, action, zero, obs + 0.1 * action, flag, flag)
        data = jx.replay.add(jx.replay.init(jax.tree.map(lambda leaf: leaf[0], transitions), NUM), transitions)
        normalizers = jx.dynamics.update_normalizers(jx.dynamics.init_normalizers(2, 2), transitions, ~flag)

        def error(state):
            models = belief.sample(models_key, state, belief.num_models)
            prediction, target = belief.judge(models, normalizers, transitions)
            return jnp.mean((jnp.mean(prediction.mean, axis=0) - target) ** 2)

        def update(i, state):
            return belief.update(jax.random.fold_in(steps_key, i), state, data, normalizers)[0]

        start = belief.init(init_key)
        state = jax.lax.fori_loop(0, 300, update, start)
        return state, data, normalizers, error(start), error(state)

    state, data, normalizers, before, after = fit(jax.random.key(0))
    assert after < 0.2 * before

    @jax.jit
    def explore(key):
        """What a rollout of a fixed push meets; and the policy before and after a round, its state and its actions."""
        models_key, rollout_key, init_key, improve_key, act_key = jax.random.split(key, 5)
        models = belief.sample(models_key, state, belief.num_models)
        world = jx.World(belief, models, normalizers, functools.partial(signal.score, ()))
        push = lambda key, obs: jnp.ones((obs.shape[0], 2))  # noqa: E731
        imagined = jx.rollout(rollout_key, push, world, jnp.zeros((NUM_ACTORS, 2)), HORIZON)
        experience = jx.Experience(models, data, jnp.int32(NUM), normalizers, data.rows.obs[0])
        first = behaviour.init(init_key)
        last, metrics = behaviour.improve(improve_key, first, experience)
        actors = behaviour.actor(first), behaviour.actor(last)
        return imagined, actors, last, metrics, behaviour.act(act_key, actors[1], normalizers, data.rows.obs)

    imagined, (untrained, trained), last, metrics, action = jax.device_get(explore(jax.random.key(1)))
    assert imagined.next_obs.shape == (HORIZON, NUM_ACTORS, 2) and np.all(imagined.reward >= 0)
    assert np.any(imagined.reward > 0)
    # five pushes of a tenth lead half a metre away
    np.testing.assert_allclose(imagined.next_obs[-1], 0.5, atol=0.15)
    assert last.age == 1 and last.imagined.size == 2 * 8 * 3
    assert metrics["imagined_reward"] > 0 and metrics["invalid_imagined"] == 0
    assert any(np.any(a != b) for a, b in zip(jax.tree.leaves(untrained), jax.tree.leaves(trained), strict=True))
    assert action.shape == (NUM, 2) and np.max(np.abs(action)) <= 1


LATE = """
import sys, jaxplore as jx
late = {"distrax", "tensorflow_probability"}
assert not late & set(sys.modules)
import jax, jax.numpy as jnp
from jaxplore.networks import GaussianParams, sample_tanh_gaussian
for num in (1, 2):
    jax.eval_shape(sample_tanh_gaussian, jax.random.key(0), GaussianParams(jnp.zeros(num), jnp.zeros(num)))
assert late <= set(sys.modules)
"""


def test_the_probability_library_comes_with_the_first_action():
    # it takes as long to import as JAX; and its import, in the middle of a trace, leaves nothing of the trace behind
    done = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_only_exported_names_are_used():
    # by this file, and nothing is imported from a module of the package
    nodes = list(ast.walk(ast.parse(pathlib.Path(__file__).read_text())))
    attributes = [node for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
    used = {node.attr for node in attributes if node.value.id == "jx"} - {"__all__"}
    assert {"make_imagination", "rollout"} <= used <= set(jx.__all__)
    assert not [node for node in nodes if isinstance(node, ast.ImportFrom)]
