"""Environments that can be put into a cell: a start lies in it, follows from its key, and is stepped like any other."""

import jax
import numpy as np
import pytest

import envs

PLACED = (
    ("acrobot", "auto"),
    ("ant_maze", "mujoco"),
    ("ant_maze", "mjx"),
    ("mountain_car", "auto"),
    ("nchain", "auto"),
)


@pytest.mark.parametrize(("name", "backend"), PLACED)
def test_every_cell_can_be_started_in(name: str, backend: str):
    env = envs.make(name, backend=backend)
    assert env.reset_in is not None
    keys = jax.random.split(jax.random.key(0), 3)
    for cell in range(env.coverage.num_cells):
        states = [env.reset_in(key, cell) for key in keys]
        assert {int(env.coverage.cell(state.obs)) for state in states} == {cell}
        assert all(state.num_steps == 0 for state in states)
    again, other = env.reset_in(keys[2], cell), states[0]
    jax.tree.map(np.testing.assert_array_equal, again.physics, states[2].physics)
    # a chain's states are all there is; elsewhere another key is another start
    assert (name == "nchain") == np.array_equal(again.obs, other.obs)


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


def test_others_say_that_they_cannot():
    assert envs.make("half_cheetah", backend="mujoco").reset_in is None
