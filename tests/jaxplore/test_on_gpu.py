"""What a GPU must get right: numbers as on a CPU, up to its own choice of precision."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxplore as jx
from jaxplore.beliefs.svgd import squared_distances

pytestmark = pytest.mark.gpu
OBS, ACTION, NUM = 31, 8, 512


@pytest.fixture(scope="module")
def belief():
    return jx.make_generator_belief(
        *(OBS, ACTION),
        jx.DynamicsConfig(hidden=(128, 128)),
        jx.GeneratorConfig(),
        jx.SVGDConfig(num_particles=32),
        jx.FitConfig(batch_size=256),
    )


def update(belief, device, precision):
    """First moments and metrics of one update on a device."""
    with jax.default_device(device), jax.default_matmul_precision(precision):
        obs, next_obs = jax.random.normal(jax.random.key(3), (2, NUM, OBS))
        action, flag = jax.random.uniform(jax.random.key(4), (NUM, ACTION)), jnp.zeros(NUM, bool)
        rows = jx.Transition(obs, action, jnp.zeros(NUM), next_obs, flag, flag)
        data = jx.replay.add(jx.replay.init(jax.tree.map(lambda leaf: leaf[0], rows), NUM), rows)
        normalizers = jx.dynamics.update_normalizers(jx.dynamics.init_normalizers(OBS, ACTION), rows, ~flag)
        state, metrics = jax.jit(belief.update)(
            jax.random.key(1), jax.jit(belief.init)(jax.random.key(0)), data, normalizers
        )
        assert jax.tree.leaves(state)[0].devices() == {device}
        return jax.device_get((optax.tree.get(state.opt_state, "mu"), metrics))


def distance(one, other):
    """The largest difference of two trees, relative to the largest number of the leaf that it is in."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return max(float(np.max(np.abs(a - b)) / max(np.max(np.abs(b)), 1e-6)) for a, b in pairs)


def test_a_step_of_svgd_is_that_of_a_cpu_in_float32_and_near_it_in_a_gpus_own_precision(belief):
    expected = update(belief, jax.devices("cpu")[0], "highest")
    exact = update(belief, jax.devices()[0], "highest")
    fast = update(belief, jax.devices()[0], "default")
    errors = distance(exact, expected), distance(fast, expected)
    print("relative errors of an SVGD step, float32 and default:", errors)
    assert errors[0] < 1e-3
    assert errors[1] < 5e-2  # 10 bits of mantissa are 1e-3 in each product


def test_networks_that_are_nearly_one_are_told_apart():
    # a spread of 1e-3 around 3, in a GPU's own precision
    values = 3.0 + 1e-3 * np.random.default_rng(0).normal(size=(32, 2048))
    centred = values.astype(np.float32).astype(np.float64)
    expected = np.mean((centred[:, None] - centred[None]) ** 2, axis=-1)
    found = np.asarray(jax.jit(squared_distances)(jnp.asarray(values, jnp.float32)))
    pairs = np.triu_indices(32, 1)
    np.testing.assert_allclose(found[pairs], expected[pairs], rtol=2e-2)


def test_the_same_update_twice_is_the_same_to_the_bit(belief):
    first, second = (update(belief, jax.devices()[0], "default") for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, second)
