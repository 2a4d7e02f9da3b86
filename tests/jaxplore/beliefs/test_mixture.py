"""Several generators within one belief: each is a generator of its own, and their networks stand side by side."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, replay
from jaxplore.beliefs import FitConfig, GeneratorConfig, SVGDConfig, make_generator_belief
from jaxplore.beliefs.ensemble import bootstrap_weights
from jaxplore.types import Transition

OBS, ACTION, M, K = 3, 2, 8, 4
GENERATOR = GeneratorConfig(noise_size=4, hidden=(8,), num_generators=K)
NETWORK = dynamics.DynamicsConfig(hidden=(8,))
FIT = FitConfig(batch_size=8, lr=1e-2)


def make(generator: GeneratorConfig = GENERATOR, particles: int = M):
    return make_generator_belief(OBS, ACTION, NETWORK, generator, SVGDConfig(num_particles=particles), FIT)


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    obs, action = rng.normal(size=(50, OBS)).astype(np.float32), rng.uniform(-1, 1, (50, ACTION)).astype(np.float32)
    flags = np.zeros(50, bool)
    rows = Transition(obs, action, np.zeros(50, np.float32), obs + 0.1 * np.sum(action, 1)[:, None], flags, flags)
    normalizers = dynamics.update_normalizers(
        dynamics.init_normalizers(OBS, ACTION), jax.tree.map(jnp.asarray, rows), jnp.ones(50, bool)
    )
    return replay.add(replay.init(jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), rows), 50), rows), normalizers


def test_each_is_updated_on_a_batch_of_its_own_as_if_alone(data):
    belief, alone = make(), make(dataclasses.replace(GENERATOR, num_generators=1), M // K)
    assert (belief.num_models, alone.num_models) == (M, M // K)
    assert (belief.num_groups, alone.num_groups) == (K, 1)
    assert (belief.has_groups, alone.has_groups, belief._replace(num_models=K).has_groups) == (True, False, False)
    init_key, key = jax.random.split(jax.random.key(0))
    state = jax.jit(belief.init)(init_key)
    after, metrics = jax.jit(belief.update)(key, state, *data)
    keys, found = jax.random.split(key, K), []
    for k in range(K):
        own = jax.tree.map(lambda leaf, k=k: leaf[k], state)
        want, own_metrics = jax.jit(alone.update)(keys[k], own, *data)
        found.append(own_metrics)
        for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(want), strict=True):
            if not jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
                np.testing.assert_allclose(a[k], b, rtol=1e-4, atol=1e-6)
    for name, value in metrics.items():
        assert float(value) == pytest.approx(np.mean([float(one[name]) for one in found]), rel=1e-4), name
    assert 0.0 <= float(metrics["dead_features"]) <= 1.0


@pytest.mark.parametrize(("activation", "dead"), [("tanh", 0.0), ("relu", 1.0)])
def test_a_feature_is_judged_on_draws_of_its_own_where_a_step_has_one_of_each(data, activation: str, dead: float):
    generator = dataclasses.replace(GENERATOR, activation=activation)
    belief = make_generator_belief(OBS, ACTION, NETWORK, generator, SVGDConfig(num_particles=K, batches="own"), FIT)
    state = jax.jit(belief.init)(jax.random.key(0))
    # Far below zero, where ReLU is 0 whatever z is, and tanh nearly but not quite one number.
    low = jax.tree_util.tree_map_with_path(
        lambda path, leaf: leaf - 2.0 if "features" in str(path) and "bias" in str(path) else leaf, state.eta
    )
    _, metrics = jax.jit(belief.update)(jax.random.key(1), state.replace(eta=low), *data)
    _, started = jax.jit(belief.update)(jax.random.key(1), state, *data)
    assert float(started["dead_features"]) < 0.2
    assert float(metrics["dead_features"]) <= dead
    assert (float(metrics["dead_features"]) > 0.0) == (dead > 0.0)


def test_networks_are_as_many_from_each():
    belief, alone = make(), make(dataclasses.replace(GENERATOR, num_generators=1), M // K)
    state, key = jax.jit(belief.init)(jax.random.key(0)), jax.random.key(1)
    networks = jax.jit(belief.sample, static_argnums=2)(key, state, M)
    keys = jax.random.split(key, K)
    for k in range(K):
        own = alone.sample(keys[k], jax.tree.map(lambda leaf, k=k: leaf[k], state), M // K)
        for a, b in zip(jax.tree.leaves(networks), jax.tree.leaves(own), strict=True):
            np.testing.assert_allclose(a[M // K * k : M // K * (k + 1)], b, rtol=1e-5, atol=1e-6)
    assert belief.predict is not None
    assert belief.predict(networks, jnp.zeros((5, OBS + ACTION))).mean.shape == (M, 5, OBS)
    with pytest.raises(ValueError, match=r"num=6 are not as many from each generator\. Allowed: a multiple of num_gen"):
        belief.sample(key, state, 6)


def test_each_resamples_the_data_as_a_member_would(data):
    # a generator moves once a transition is held that it gives a weight above 0, and not before
    generator = dataclasses.replace(GENERATOR, bootstrap="poisson")
    svgd = SVGDConfig(num_particles=M, batches="own")
    belief = make_generator_belief(OBS, ACTION, NETWORK, generator, svgd, dataclasses.replace(FIT, weight_decay=0.0))
    state, update = jax.jit(belief.init)(jax.random.key(0)), jax.jit(belief.update)
    held, normalizers = data
    weights = np.asarray(bootstrap_weights("poisson", K, jnp.tile(jnp.arange(3)[None], (K, 1))))
    seen = set()
    for size in (1, 2, 3):
        after, _ = update(jax.random.key(1), state, held.replace(size=jnp.int32(size)), normalizers)
        pairs = zip(jax.tree.leaves(after.eta), jax.tree.leaves(state.eta), strict=True)
        moved = np.any([np.any(np.asarray(a != b).reshape(K, -1), axis=1) for a, b in pairs], axis=0)
        np.testing.assert_array_equal(moved, np.any(weights[:, :size] > 0, axis=1))
        seen |= set(moved)
    assert seen == {True, False}


def test_a_number_that_does_not_divide_is_refused():
    expected = r"GeneratorConfig\.num_generators=3 shares the networks unequally\. Allowed: a divisor of svgd\.num_part"
    with pytest.raises(ValueError, match=expected):
        make(dataclasses.replace(GENERATOR, num_generators=3))
    with pytest.raises(ValueError, match=r"GeneratorConfig\.num_generators=0"):
        GeneratorConfig(num_generators=0)
    with pytest.raises(ValueError, match=r"GeneratorConfig\.activation='tanhh' .*Did you mean 'tanh'"):
        GeneratorConfig(activation="tanhh")
    with pytest.raises(ValueError, match=r"GeneratorConfig\.bootstrap='poison' .*Did you mean 'poisson'"):
        GeneratorConfig(bootstrap="poison")  # pyright: ignore[reportArgumentType]
    with pytest.raises(
        ValueError, match=r"GeneratorConfig\.bootstrap='poisson' tells generators apart.*num_generators"
    ):
        GeneratorConfig(bootstrap="poisson")
    with pytest.raises(ValueError, match=r"GeneratorConfig\.normalize=True leaves nothing of one feature.*2 or more"):
        GeneratorConfig(hidden=(8, 1), normalize=True)
