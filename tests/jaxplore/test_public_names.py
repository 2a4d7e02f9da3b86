"""What `jaxplore` exports suffices: a belief is trained, sampled, imagined in and turned into behaviour by it alone."""

import jax
import jax.numpy as jnp

import jaxplore as jx


def test_a_belief_is_trained_sampled_and_imagined_in_by_exported_names():
    # a point whose place moves by a tenth of the push: the models learn that, and the policy is trained in them
    key = jax.random.key(0)
    obs = jax.random.normal(key, (512, 2))
    action = jax.random.uniform(jax.random.key(1), (512, 2), minval=-1.0, maxval=1.0)
    zero, flag = jnp.zeros(512), jnp.zeros(512, bool)
    transitions = jx.Transition(obs, action, zero, obs + 0.1 * action, flag, flag)
    data = jx.replay.add(jx.replay.init(jax.tree.map(lambda leaf: leaf[0], transitions), 512), transitions)
    normalizers = jx.dynamics.update_normalizers(jx.dynamics.init_normalizers(2, 2), transitions, ~flag)

    belief = jx.make_generator_belief(
        *(2, 2),
        jx.DynamicsConfig(hidden=(16,)),
        jx.GeneratorConfig(hidden=(16,), noise_size=4),
        jx.SVGDConfig(num_particles=8, temperature=0.02, tempering="per_datum"),
        jx.FitConfig(lr=3e-3, batch_size=64),
    )
    state = belief.init(jax.random.key(2))

    def error(state) -> float:
        models = belief.sample(jax.random.key(3), state, belief.num_models)
        prediction, target = belief.judge(models, normalizers, transitions)
        return float(jnp.mean((prediction.mean.mean(axis=0) - target) ** 2))

    start = error(state)
    update = jax.jit(lambda key, state: belief.update(key, state, data, normalizers)[0])
    for i in range(300):
        state = update(jax.random.fold_in(key, i), state)
    assert error(state) < 0.2 * start

    models = belief.sample(jax.random.key(4), state, belief.num_models)

    def score(prediction: jx.Prediction, delta: jax.Array, normalizers: jx.Normalizers) -> jax.Array:
        return jx.rewards.variance(prediction)

    world = jx.World(belief, models, normalizers, score)
    imagined = jx.rollout(
        jax.random.key(5), lambda key, obs: jnp.ones((obs.shape[0], 2)), world, jnp.zeros((4, 2)), horizon=5
    )
    assert imagined.next_obs.shape == (5, 4, 2) and bool((imagined.reward >= 0).all())
    # five pushes of a tenth lead half a metre away
    assert jnp.allclose(imagined.next_obs[-1], 0.5, atol=0.15)

    sac = jx.make_sac(2, 2, jx.SACConfig(hidden=(8,), batch_size=16))
    config = jx.ImaginationConfig(
        num_actors=8, horizon=3, num_rollouts=2, num_random_rollouts=1, updates_per_rollout=2, real_updates=0
    )
    behaviour: jx.Behaviour = jx.make_imagination(belief, score, sac, 2, 2, config)
    experience = jx.Experience(models, data, jnp.int32(512), normalizers, obs[0])
    before = behaviour.init(jax.random.key(6))
    after, metrics = jax.jit(behaviour.improve)(jax.random.key(7), before, experience)
    assert int(after.age) == 1 and int(after.imagined.size) == 2 * 8 * 3
    assert float(metrics["imagined_reward"]) > 0
    assert behaviour.act(jax.random.key(8), behaviour.actor(after), normalizers, obs).shape == (512, 2)
