"""MJX: MuJoCo's physics in pure JAX. `jit`, `vmap` and `scan` as you like; the engine for accelerators.

The state holds what the next step depends on and no more, as C MuJoCo's integration state does. MJX's `Data` is large
(it holds every contact's Jacobian) and is built again within each step, so states are cheap to keep, select and store.

In float64 MJX agrees with C MuJoCo of the same version to rounding, but for two things. Where a capsule meets a plane
at more than 60 degrees, C MuJoCo turns the friction pyramid along the capsule and MJX does not. And MJX has no contact
of capsule and box before they touch: give such pairs margin 0.
"""
# pyright: reportAttributeAccessIssue=false
# mujoco ships no stubs.

import contextlib
import io

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from envs import functional
from envs.base import Environment, Physics, Task
from envs.views import make_mujoco_view
from jaxplore.types import Array

with contextlib.redirect_stdout(io.StringIO()):  # It prints that the optional Warp engine is absent.
    from mujoco import mjx

BACKEND = "mjx"


@struct.dataclass
class MjxState:
    """What one step of MJX depends on, beside the control."""

    time: Array
    """Seconds of the episode so far."""
    qpos: Array
    """Positions, `[nq]`, metres and radians."""
    qvel: Array
    """Velocities, `[nv]`, per second."""
    act: Array
    """Actuator activations, `[na]`."""
    qacc_warmstart: Array
    """Where the constraint solver starts, `[nv]`."""


def make_physics(model: mujoco.MjModel, frame_skip: int) -> Physics:
    """MJX as a `Physics`: `frame_skip` substeps of `model.opt.timestep` seconds a step."""
    # MJX commits arrays to a device; then so were every state, which compiles twice and cannot be sharded.
    device_model, blank = jax.tree.map(
        lambda leaf: jnp.asarray(np.asarray(leaf)), (mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax"))
    )

    def init(qpos: Array, qvel: Array) -> MjxState:
        dtype = blank.qpos.dtype
        return MjxState(blank.time, qpos.astype(dtype), qvel.astype(dtype), blank.act, blank.qacc_warmstart)

    def step(state: MjxState, ctrl: Array) -> MjxState:
        def substep(_: int, state: MjxState) -> MjxState:
            data = blank.replace(**vars(state), ctrl=ctrl.astype(state.qpos.dtype))
            data = mjx.step(device_model, data)
            return MjxState(**{name: getattr(data, name) for name in vars(state)})

        # MJX relies on the first. The second: NVIDIA GPUs would multiply with 10 bits of mantissa, and physics drift.
        with jax.numpy_rank_promotion("allow"), jax.default_matmul_precision("highest"):
            return jax.lax.fori_loop(0, frame_skip, substep, state)

    return Physics(init, step, qpos=lambda state: state.qpos, qvel=lambda state: state.qvel)


def make_environment(task: Task, obs_noise: float = 0.0) -> Environment:
    """`task` on MJX. See `envs.base` for the contract and `envs.functional` for what holds beside it.

    Args:
        task: what to run.
        obs_noise: standard deviation of Gaussian noise added to every observation entry, in raw units. The physics
            does not see it.

    Raises:
        FieldError: `obs_noise` is negative or not finite.
        ValueError: from `step`, when traced: the action is not of shape `[A]`.
    """
    physics, start_in = make_physics(task.model, task.frame_skip), task.start_in

    def known(state: MjxState) -> tuple[Array, Array]:
        return physics.qpos(state), physics.qvel(state)

    rules = functional.Rules(
        spec=task.spec,
        start=lambda key: physics.init(*task.start(key)),
        advance=lambda key, state, action: physics.step(state, task.control(jnp, action)),
        observe=lambda before, after: task.observe(jnp, physics.qpos(before), *known(after)),
        reward=lambda before, action, after: task.reward(jnp, action, physics.qpos(before), *known(after)),
        coverage=task.coverage,
        floor_plan=task.floor_plan,
        view=make_mujoco_view(task.model, lambda state: physics.qpos(state.physics), task.cameras),
        start_in=start_in and (lambda key, cell: physics.init(*start_in(key, cell))),
    )
    return functional.make_environment(rules, obs_noise, BACKEND)
