import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import ant_maze
from jaxplore import METHODS, Replay, Seen, Transition, dynamics


@pytest.fixture(scope="module")
def oracles():
    """Its methods leave with it."""
    before = set(METHODS)
    from benchmarks import oracles

    yield oracles
    for name in set(METHODS) - before:
        del METHODS[name]


def at(*places: tuple[float, float]) -> jnp.ndarray:
    obs = np.zeros((len(places), len(ant_maze.SPEC.obs_names)), np.float32)
    obs[:, list(ant_maze.POSITION)] = places
    return jnp.asarray(obs)


def test_along_the_corridor_cells_lie_two_metres_apart(oracles):
    centres = [(2.0 * i, 2.0 * j) for i, j in ant_maze.FREE]
    np.testing.assert_allclose(oracles.along(at(*centres)), 2.0 * np.arange(7))


def test_rarity_counts_the_rows_held(oracles):
    # three rows end in one square, one in another; the last row is not held
    next_obs = at((0.1, 0.1), (0.2, 0.4), (0.4, 0.2), (4.0, 4.0), (0.1, 0.1))
    num, flag = len(next_obs), jnp.zeros(5, bool)
    rows = Transition(jnp.zeros_like(next_obs), jnp.zeros((num, 8)), jnp.zeros(num), next_obs, flag, flag)
    visits = oracles.visits(Replay(rows, jnp.int32(4), jnp.int32(4)))
    reward = oracles.rarity(visits, Seen(rows, None, None, dynamics.init_normalizers(next_obs.shape[1], 8)))
    np.testing.assert_allclose(reward[:4], [3**-0.5] * 3 + [1.0], rtol=1e-6)


def test_squares_cover_the_maze(oracles):
    corners = at((-1, -1), (4.99, 4.99), (-3, 9))
    assert jax.device_get(oracles.square_of(corners)).tolist() == [0, 143, 11]


def test_the_simulator_is_the_environment(oracles):
    # from any state of a random walk, observed in float32
    env = envs.make("acrobot")
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    state = reset(jax.random.key(0))
    before, actions, after = [], [], []
    for i in range(60):
        action = jax.random.uniform(jax.random.key(i), (1,), minval=-1.0, maxval=1.0)
        before.append(state.obs)
        state, _ = step(state, action)
        actions.append(action)
        after.append(state.obs)
    got = jax.jit(oracles.step_acrobot)(jnp.stack(before), jnp.stack(actions))
    np.testing.assert_allclose(got, np.stack(after), atol=1e-4)
    assert np.ptp(np.stack(after)[:, 0]) > 0.01, "it moved"
