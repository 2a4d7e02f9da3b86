"""Environments that can be put into a cell: a start lies in it, follows from its key, and is stepped like any other."""

import jax
import numpy as np
import pytest

import envs

MOST_CELLS = 100
"""Looked at, spread evenly where there are more."""


def starts(env, cells, keys):
    """Coverage cells and observations of a start in each of `cells` with each of `keys`, `[cells, keys, ...]`."""
    if env.compiled:
        states = jax.jit(jax.vmap(jax.vmap(env.reset_in, (0, None)), (None, 0)))(keys, cells)
        obs, num_steps = states.obs, states.num_steps
    else:
        states = [[env.reset_in(key, int(cell)) for key in keys] for cell in cells]
        obs = np.stack([[state.obs for state in row] for row in states])
        num_steps = np.array([[state.num_steps for state in row] for row in states])
    assert not np.any(num_steps)
    return jax.device_get((jax.jit(jax.vmap(jax.vmap(env.coverage.cell)))(obs), obs))


@pytest.mark.parametrize("name", envs.FACTORIES)
def test_every_cell_can_be_started_in_or_none(name: str):
    backends = envs.backends(name)
    try:
        first = envs.make(name, backend=backends[-1])
    except ImportError as error:
        pytest.skip(str(error))
    if first.reset_in is None:
        return
    keys = jax.random.split(jax.random.key(0), 3)
    for env in (first, *(envs.make(name, backend=backend) for backend in backends[:-1])):
        count = env.coverage.num_cells
        cells = np.linspace(0, count - 1, min(count, MOST_CELLS)).round().astype(np.int32)
        reached, obs = starts(env, cells, keys)
        np.testing.assert_array_equal(reached, np.repeat(cells[:, None], 3, axis=1))
        cell = int(cells[-1])
        again, twin, other = (env.reset_in(keys[i], cell) for i in (2, 2, 0))
        jax.tree.map(np.testing.assert_array_equal, again.physics, twin.physics)
        np.testing.assert_allclose(again.obs, obs[-1, 2], rtol=0, atol=1e-6)
        # One-hot states are all there is; elsewhere another key is another start.
        assert env.spec.one_hot_obs == np.array_equal(again.obs, other.obs)


def test_which_of_them_can():
    for name, can in (
        ("acrobot", True),
        ("ant_maze", True),
        ("mountain_car", True),
        ("nchain", True),
        ("half_cheetah", False),
    ):
        assert (envs.make(name).reset_in is not None) == can


def test_an_ant_in_its_own_cell_starts_as_ever():
    env = envs.make("ant_maze", backend="mujoco")
    key = jax.random.key(3)
    np.testing.assert_array_equal(env.reset_in(key, 0).physics, env.reset(key).physics)
    far = env.reset_in(key, 6)
    np.testing.assert_allclose(far.obs[2:4] - env.reset(key).obs[2:4], (0.0, 4.0), atol=1e-6)
    np.testing.assert_array_equal(far.obs[4:], env.reset(key).obs[4:])
    after, transition = env.step(far, np.zeros(8, np.float32))
    np.testing.assert_array_equal(transition.obs, far.obs)
    assert after.num_steps == 1 and not transition.terminated
