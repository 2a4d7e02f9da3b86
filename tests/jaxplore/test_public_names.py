"""An example that uses only what `import jaxplore` offers: a belief, imagination and a policy, from random data."""

import ast
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

import jaxplore

NUM, OBS, ACTION = 64, 2, 1
NUM_MODELS, NUM_ACTORS, HORIZON = 4, 3, 2


def transitions():
    """Random steps of a point that is pushed: the change is the action and a little of where it is."""
    rng = np.random.default_rng(0)
    obs, action = rng.normal(size=(NUM, OBS)), rng.uniform(-1, 1, size=(NUM, ACTION))
    next_obs = obs + action + 0.3 * obs[:, ::-1]
    rows = (np.asarray(leaf, np.float32) for leaf in (obs, action, np.zeros(NUM), next_obs))
    return jaxplore.Transition(*rows, np.zeros(NUM, bool), np.zeros(NUM, bool))


def test_the_parts_work_together():
    # the generator's models come to predict the data, disagree everywhere at first and nowhere below 0, and a policy is
    # trained for a round in what they imagine
    belief = jaxplore.make_generator_belief(
        OBS,
        ACTION,
        jaxplore.DynamicsConfig(hidden=(16,)),
        jaxplore.GeneratorConfig(noise_size=4, hidden=(8,)),
        jaxplore.SVGDConfig(num_particles=NUM_MODELS),
        jaxplore.FitConfig(lr=1e-2, batch_size=16),
    )
    disagreement = jaxplore.Reward(
        lambda prediction, delta, normalizers: jaxplore.rewards.variance(prediction), "normalised delta, squared"
    )
    sac = jaxplore.make_sac(OBS, ACTION, jaxplore.SACConfig(hidden=(8,), batch_size=8))
    config = jaxplore.ImaginationConfig(
        num_actors=NUM_ACTORS,
        horizon=HORIZON,
        num_rollouts=2,
        num_random_rollouts=1,
        updates_per_rollout=2,
        real_updates=0,
        replay_capacity=32,
    )
    behaviour = jaxplore.make_imagination(belief, disagreement.score, sac, OBS, ACTION, config)
    assert isinstance(belief, jaxplore.Belief) and isinstance(behaviour, jaxplore.Behaviour)
    assert belief.num_models == NUM_MODELS

    @jax.jit
    def fit(key, rows):
        """`(state, data, normalizers, mean squared error of the models' mean at the start and at the end)`."""
        data = jaxplore.replay.add(jaxplore.replay.init(jax.tree.map(lambda leaf: leaf[0], rows), NUM), rows)
        normalizers = jaxplore.dynamics.update_normalizers(
            jaxplore.dynamics.init_normalizers(OBS, ACTION), rows, jnp.ones(NUM, bool)
        )
        init_key, steps_key, models_key = jax.random.split(key, 3)
        first = belief.init(init_key)
        last = jax.lax.fori_loop(
            0, 300, lambda i, s: belief.update(jax.random.fold_in(steps_key, i), s, data, normalizers)[0], first
        )

        def error(state):
            judgement = belief.judge(belief.sample(models_key, state, NUM_MODELS), normalizers, rows)
            return jnp.mean((jnp.mean(judgement.prediction.mean, axis=0) - judgement.target) ** 2)

        return last, data, normalizers, jnp.stack([error(first), error(last)])

    rows = transitions()
    state, data, normalizers, (before, after) = fit(jax.random.key(0), rows)
    assert after < 0.3 < 0.7 < before

    @jax.jit
    def explore(key):
        models_key, rollout_key, init_key, improve_key, act_key = jax.random.split(key, 5)
        models = belief.sample(models_key, state, NUM_MODELS)
        world = jaxplore.World(belief, models, normalizers, disagreement.score)
        uniform = lambda key, obs: jax.random.uniform(key, (obs.shape[0], ACTION), minval=-1.0)  # noqa: E731
        imagined = jaxplore.rollout(rollout_key, uniform, world, jnp.asarray(rows.obs[:NUM_ACTORS]), HORIZON)
        experience = jaxplore.Experience(models, data, jnp.int32(NUM), normalizers, jnp.asarray(rows.obs[0]))
        first = behaviour.init(init_key)
        improved, metrics = behaviour.improve(improve_key, first, experience)
        actor = behaviour.actor(improved)
        action = behaviour.act(act_key, actor, normalizers, jnp.asarray(rows.obs))
        return imagined, (behaviour.actor(first), actor), metrics, action

    imagined, (untrained, trained), metrics, action = jax.device_get(explore(jax.random.key(1)))
    assert isinstance(imagined, jaxplore.Transition)
    assert imagined.obs.shape == imagined.next_obs.shape == (HORIZON, NUM_ACTORS, OBS)
    assert (
        imagined.reward.shape == (HORIZON, NUM_ACTORS) and np.all(imagined.reward >= 0) and np.any(imagined.reward > 0)
    )
    np.testing.assert_array_equal(imagined.obs[1], imagined.next_obs[0])
    assert metrics["imagined_reward"] > 0 and metrics["invalid_imagined"] == 0
    assert any(np.any(a != b) for a, b in zip(jax.tree.leaves(untrained), jax.tree.leaves(trained), strict=True))
    assert action.shape == (NUM, ACTION) and np.max(np.abs(action)) <= 1


def test_only_public_names_are_used():
    # by this file, of the package; and none is imported from a module of it
    nodes = list(ast.walk(ast.parse(pathlib.Path(__file__).read_text())))
    attributes = [node for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
    used = {node.attr for node in attributes if node.value.id == "jaxplore"} - {"__all__"}
    assert "make_imagination" in used and used <= set(jaxplore.__all__)
    assert not [node for node in nodes if isinstance(node, ast.ImportFrom)]
