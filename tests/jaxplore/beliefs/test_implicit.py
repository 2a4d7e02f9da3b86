"""What a generator's networks have added to them and never train: the random function of z that is their prior."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, replay
from jaxplore.beliefs import FitConfig, GeneratorConfig, SVGDConfig, make_generator_belief
from jaxplore.types import Transition

OBS, ACTION, SCALE = 3, 2, 0.7
NETWORK = dynamics.DynamicsConfig(hidden=(32, 16))
PLAIN = GeneratorConfig(noise_size=4, hidden=(8,), activation="tanh", num_generators=2)


def make(generator, num=512):
    return make_generator_belief(OBS, ACTION, NETWORK, generator, SVGDConfig(num_particles=num), FitConfig(lr=1e-2))


def functions(belief, state, inputs, num=512):
    """Values `[num, N, O]` of networks drawn with one key."""
    models = jax.jit(belief.sample, static_argnums=2)(jax.random.key(2), state, num)
    return np.asarray(jax.jit(belief.predict)(models, inputs).mean, float)


@pytest.mark.parametrize("noise", ["shared", "per_layer"])
def test_the_prior_is_a_function_of_the_stated_size(noise):
    # what networks of the same eta and z differ by with and without: mean 0, the scale's standard deviation over z,
    # inputs and outputs (2,048 products of a frozen map, some 5 % of chance), another function for each z
    config = dataclasses.replace(PLAIN, noise=noise)
    with_prior, plain = make(dataclasses.replace(config, prior_scale=SCALE)), make(config)
    inputs = np.random.default_rng(0).normal(size=(256, OBS + ACTION)).astype(np.float32)
    state = jax.jit(plain.init)(jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, state.eta, jax.jit(with_prior.init)(jax.random.key(0)).eta)
    prior = functions(with_prior, state, inputs) - functions(plain, state, inputs)
    assert np.std(prior) == pytest.approx(SCALE, rel=0.2)
    assert np.mean(prior.mean(axis=0) ** 2) < 0.02 * SCALE**2
    # linear in z: as many independent functions as z has numbers
    sizes = np.linalg.svd(prior.reshape(512, -1), compute_uv=False)
    count = 4 if noise == "shared" else 4 * 3
    assert sizes[count] < 1e-4 * sizes[0] < sizes[count - 1]


def test_training_moves_the_networks_and_not_the_prior():
    # after updates: what is added is what it was, and the sum fits data that the prior alone is far from
    config = dataclasses.replace(PLAIN, prior_scale=SCALE)
    belief, plain = make(config, 16), make(PLAIN, 16)
    rng = np.random.default_rng(0)
    obs, action = rng.normal(size=(60, OBS)).astype(np.float32), rng.uniform(-1, 1, (60, ACTION)).astype(np.float32)
    flags = np.zeros(60, bool)
    rows = Transition(obs, action, np.zeros(60, np.float32), obs + action[:, :1], flags, flags)
    rows = jax.tree.map(jnp.asarray, rows)
    normalizers = dynamics.update_normalizers(dynamics.init_normalizers(OBS, ACTION), rows, jnp.ones(60, bool))
    data = replay.add(replay.init(jax.tree.map(lambda leaf: leaf[0], rows), 60), rows)

    @jax.jit
    def train(state):
        step = lambda i, state: belief.update(jax.random.key(i), state, data, normalizers)[0]  # noqa: E731
        return jax.lax.fori_loop(0, 300, step, state)

    state = jax.jit(belief.init)(jax.random.key(0))
    trained, inputs = train(state), dynamics.model_inputs(normalizers, rows.obs, rows.action)
    before, after = (functions(belief, one, inputs, 16) - functions(plain, one, inputs, 16) for one in (state, trained))
    np.testing.assert_allclose(after, before, atol=1e-4)
    targets = np.asarray(dynamics.model_targets(normalizers, rows.obs, rows.next_obs), float)
    errors = [np.mean((functions(belief, one, inputs, 16).mean(axis=0) - targets) ** 2) for one in (state, trained)]
    assert errors[1] < 0.2 * errors[0]


def test_a_negative_scale_is_refused():
    with pytest.raises(ValueError, match=r"GeneratorConfig\.prior_scale=-1\.0 .*\[0, inf"):
        GeneratorConfig(prior_scale=-1.0)
    with pytest.raises(ValueError, match=r"GeneratorConfig\.bootstrap_std=0\.0 .*\(0, 1\]"):
        GeneratorConfig(bootstrap_std=0.0)
