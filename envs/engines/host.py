"""C MuJoCo on the host: NumPy in, NumPy out, one environment a call. The fast engine where there is no accelerator.

The state is MuJoCo's integration state, a float64 vector: time, positions, velocities, and the solver's warm start.
One `MjData` serves as scratch space and is set from that vector on every step, so stepping a saved state again gives
the same bits. As the scratch space is shared, one environment must not be stepped from two threads at once.
"""
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportReturnType=false
# mujoco ships no stubs, and NumPy arrays stand where the contract says Array.

import copy
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Environment, EnvState, Physics, Task, check_noise
from envs.views import make_mujoco_view
from jaxplore.types import Array, Key, Transition

BACKEND = "mujoco"
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def make_physics(model: mujoco.MjModel, frame_skip: int) -> Physics:
    """C MuJoCo as a `Physics`: `frame_skip` substeps of `model.opt.timestep` seconds a step.

    A diverged state stays as it is: MuJoCo's own reset of such states is off, and so is the log file it would write.
    """
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(model)
    # MuJoCo logs a warning of each kind to a file in the working directory, but only the first one.
    data.warning.number[:] = 1
    size, nq, nv = mujoco.mj_stateSize(model, STATE), model.nq, model.nv

    def save() -> np.ndarray:
        state = np.empty(size)
        mujoco.mj_getState(model, data, state, STATE)
        return state

    blank = save()

    def init(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        mujoco.mj_setState(model, data, blank, STATE)
        data.qpos[:], data.qvel[:] = qpos, qvel
        return save()

    def step(state: np.ndarray, ctrl: np.ndarray) -> np.ndarray:
        mujoco.mj_setState(model, data, state, STATE)
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, frame_skip)
        return save()

    return Physics(init, step, qpos=lambda state: state[1 : 1 + nq], qvel=lambda state: state[1 + nq : 1 + nq + nv])


class Host(NamedTuple):
    """The fixed parts of an environment on the host."""

    task: Task
    physics: Physics
    obs_noise: float


def make_environment(task: Task, obs_noise: float = 0.0) -> Environment:
    """`task` on C MuJoCo. See `envs.base` for the contract.

    `step` clips actions to [-1, 1] and raises `ValueError` for an action that is not finite or not of shape `[A]`. A
    state that is no longer finite ends the episode as `terminated`; `next_obs` is then what was computed.

    Args:
        task: what to run.
        obs_noise: standard deviation of Gaussian noise added to every observation entry, in raw units. The physics
            does not see it.

    Raises:
        FieldError: `obs_noise` is negative or not finite.
    """
    physics = make_physics(task.model, task.frame_skip)
    host = Host(task, physics, check_noise(obs_noise))
    return Environment(
        task.spec,
        functools.partial(reset_to, host, task.start),
        functools.partial(step, host),
        task.coverage,
        BACKEND,
        False,
        task.floor_plan,
        make_mujoco_view(task.model, lambda state: physics.qpos(state.physics), task.cameras),
        reset_in=task.start_in and functools.partial(reset_to, host, task.start_in),
    )


def reset_to(host: Host, start: Callable[..., tuple[Array, Array]], key: Key, *cell: int) -> EnvState:
    """A new episode that begins where `start(key, *cell)` says."""
    qpos, qvel, key = _draw_start(start, key, *cell)
    state = host.physics.init(*jax.device_get((qpos, qvel)))
    key, obs = _noisy(host, key, _observe(host, state, state))
    return EnvState(state, obs, np.int32(0), key)


def step(host: Host, state: EnvState, action: Any) -> tuple[EnvState, Transition]:
    """A step; see `Environment.step`."""
    spec, action_shape = host.task.spec, (host.task.spec.action_size,)
    # Not asarray: on an array still being computed NumPy waits with Python's lock held, and can hang.
    action = np.asarray(jax.device_get(action), np.float32)
    if action.shape != action_shape:
        raise ValueError(f"action has shape {action.shape}. Allowed: {action_shape}.")
    if not np.isfinite(action).all():
        raise ValueError(f"action is {action}. Allowed: finite numbers.")
    action = np.clip(action, -1.0, 1.0)
    after = host.physics.step(state.physics, host.task.control(np, action))
    clean = _observe(host, state.physics, after)
    key, obs = _noisy(host, state.key, clean)
    num_steps = np.int32(state.num_steps + 1)
    transition = Transition(
        obs=state.obs,
        action=action,
        reward=np.float32(_reward(host, action, state.physics, after)),
        next_obs=obs,
        terminated=np.bool_(not np.isfinite(after).all()),
        truncated=np.bool_(num_steps >= spec.episode_steps),
    )
    return EnvState(after, obs, num_steps, key), transition


@functools.partial(jax.jit, static_argnums=0)
def _draw_start(start: Callable[..., tuple[Array, Array]], key: Key, *cell: int) -> tuple[Array, Array, Key]:
    start_key, key = jax.random.split(key)
    return *start(start_key, *cell), key


@functools.partial(jax.jit, static_argnums=(0, 1))
def _draw_noise(obs_noise: float, obs_size: int, key: Key) -> tuple[Key, Array]:
    key, noise_key = jax.random.split(key)
    return key, obs_noise * jax.random.normal(noise_key, (obs_size,), jnp.float32)


def _noisy(host: Host, key: Key, obs: np.ndarray) -> tuple[Key, np.ndarray]:
    if host.obs_noise == 0:
        return key, obs
    key, noise = _draw_noise(host.obs_noise, host.task.spec.obs_size, key)
    return key, obs + jax.device_get(noise)


def _observe(host: Host, before: Any, after: Any) -> np.ndarray:
    physics = host.physics
    with np.errstate(over="ignore", invalid="ignore"):  # A diverged state is reported by `terminated`.
        obs = host.task.observe(np, physics.qpos(before), physics.qpos(after), physics.qvel(after))
        return obs.astype(np.float32)


def _reward(host: Host, action: np.ndarray, before: Any, after: Any) -> Any:
    physics = host.physics
    with np.errstate(over="ignore", invalid="ignore"):
        return host.task.reward(np, action, physics.qpos(before), physics.qpos(after), physics.qvel(after))
