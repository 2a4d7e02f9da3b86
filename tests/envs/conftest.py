"""A bead on a rail: the smallest thing that both physics engines can run, with a closed form to check them against."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import pytest

from envs.base import Coverage, EnvSpec, Task, choose_engine

# A mass of 2 kg, pushed by up to 10 N along x; substeps of 0.01 s, two a step.
BEAD = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body><joint name="x" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="2"/></body>
  </worldbody>
  <actuator><motor joint="x" gear="10" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="session")
def make_bead():
    """`make_bead(backend, obs_noise=0, episode_steps=7) -> Environment`. It starts at its key's own place, at rest.

    The same arguments give the same environment, whose programs are compiled once.
    """

    @functools.cache
    def make(backend, obs_noise, episode_steps):
        task = Task(
            spec=EnvSpec("bead", ("x [m]", "velocity [m/s]"), ("push [10 N]",), episode_steps, 0.02),
            model=mujoco.MjModel.from_xml_string(BEAD),
            frame_skip=2,
            start=lambda key: (jax.random.uniform(key, (1,)), jnp.zeros(1)),
            observe=lambda xp, qpos_before, qpos, qvel: xp.concatenate([qpos, qvel]),
            reward=lambda xp, action, qpos_before, qpos, qvel: qvel[0] - 0.5 * action[0],
            coverage=Coverage(1, lambda obs: jnp.int32(0), "rails"),
            cameras=(),
        )
        return choose_engine(backend).make_environment(task, obs_noise)

    return lambda backend, obs_noise=0.0, episode_steps=7: make(backend, obs_noise, episode_steps)
