"""The bonus of random network distillation: by hand, and that what is seen stops being new and what is not stays so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore.signals.distillation import RNDConfig, init_scale, make_rnd, update_scale
from tests.jaxplore import distillation

SMALL = RNDConfig(hidden=(16,), features=8, lr=3e-3)


def test_the_bonus_is_the_mean_squared_error_over_features():
    # against both networks written out: leaky ReLU with slope 0.01, two more layers in the predictor, clip at 5
    rnd = make_rnd(3, SMALL)
    state = jax.device_get(jax.jit(rnd.init)(jax.random.key(0)))
    obs = np.array([[0.5, -1.0, 2.0], [0.5, -9.0, 7.0]], np.float32)
    assert [len(state.target), len(state.predictor)] == [2, 4]
    want = distillation.error(state, obs)
    one, both = jax.jit(lambda obs: (rnd.error(state, obs[1]), rnd.error(state, obs)))(obs)
    np.testing.assert_allclose(both, want, rtol=1e-5)
    np.testing.assert_allclose(one, want[1], rtol=1e-5)
    # orthogonal, gain sqrt 2
    kernel = state.target["output"]["kernel"]
    np.testing.assert_allclose(kernel.T @ kernel, 2 * np.eye(8), atol=1e-5)


def test_the_error_falls_on_what_is_seen_and_not_on_what_is_not():
    # 400 steps on a cloud around (1, 0, 0); one around (-1, 1, 0) is never shown, nor one whose weights are 0
    rnd = make_rnd(3, SMALL)

    @jax.jit
    def train(key, cloud_key):
        centres = jnp.array([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0]])
        clouds = centres[:, None] + 0.2 * jax.random.normal(cloud_key, (2, 64, 3))
        weights = jnp.concatenate([jnp.ones(64), jnp.zeros(64)])

        def step(state, _):
            return rnd.update(state, clouds.reshape(128, 3), weights)[0], None

        first = rnd.init(key)
        last = jax.lax.scan(step, first, length=400)[0]
        return first, last, [jnp.mean(rnd.error(last, c)) / jnp.mean(rnd.error(first, c)) for c in clouds]

    first, last, (seen, unseen) = train(jax.random.key(0), jax.random.key(1))
    assert seen < 0.02
    assert unseen > 10 * seen
    jax.tree.map(np.testing.assert_array_equal, last.target, first.target)


def test_rewards_are_scaled_by_the_spread_of_their_discounted_sum_in_time():
    # rewards come in several calls, some left out; the sums run forward in time and are not centred
    rng = np.random.default_rng(0)
    rewards, valid = rng.uniform(size=50), rng.uniform(size=50) < 0.7
    scale, update = init_scale(), jax.jit(update_scale)
    assert float(scale.std) == 1.0
    for part in (slice(0, 20), slice(20, 50)):
        scale = update(scale, rewards[part].astype(np.float32), valid[part], 0.9)
    running, sums = 0.0, []
    for reward in rewards[valid]:
        running = 0.9 * running + reward
        sums.append(running)
    assert float(scale.running) == pytest.approx(running, rel=1e-5)
    assert float(scale.std) == pytest.approx(np.std(sums), rel=1e-4)
