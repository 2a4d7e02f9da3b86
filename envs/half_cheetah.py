"""Gymnasium's half cheetah: MAX's form for exploration, Gymnasium's own for the task of running, and one between.

A planar two-legged body of 14 kg on a floor, six hinges, 0.05 s a step. All forms have one model and one reset, and
are never terminated by the task.

- `half_cheetah` (nnaisense/max, MagellanHalfCheetah): 100 steps, 19 numbers, no reward. Its coverage is counted on the
  two that MAX's tasks reward: the velocity along x ("running") and the pitch rate ("flipping"), in cells of 0.5 m/s and
  1 rad/s. The grid is ours; faster than 5 m/s or 10 rad/s counts as in the last cell.
- `half_cheetah_task` (Gymnasium's HalfCheetah-v5): 1,000 steps, 17 numbers, reward: mean velocity along x over the step
  [m/s] minus 0.1 times the sum of the squared actions.
- `half_cheetah_transfer`: that task in MAX's form, 19 numbers and 1,000 steps, as the paper's authors transfer.
  Gymnasium's pitch is an angle that no bound holds: two somersaults later the same posture is another state, new to
  whoever looks for new states and strange to what has learned of the first. Here it is seen by its sine and cosine.
"""
# pyright: reportAttributeAccessIssue=false
# mujoco ships no stubs.

import dataclasses
from importlib import resources
from types import ModuleType
from typing import Any

import jax
import mujoco

from envs.base import Environment, EnvSpec, Task, choose_engine
from envs.coverage import make_grid_coverage
from envs.views import light_gymnasium_floor
from jaxplore.types import Array, Key

FRAME_SKIP = 5
TIMESTEP = 0.01
DT = FRAME_SKIP * TIMESTEP
MASS = 14.0
RESET_SCALE = 0.1
CONTROL_COST = 0.1
MAX_CONTACTS = 8
"""Contacts that MJX solves for, the deepest of the 16 that it looks for. More than 5 were never seen."""

JOINTS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
GEARS = (120, 90, 60, 120, 60, 30)

JOINT_ANGLES = tuple(f"{joint} angle [rad]" for joint in JOINTS)
VELOCITIES = (
    *("x velocity [m/s]", "z velocity [m/s]", "pitch rate [rad/s]"),
    *(f"{joint} velocity [rad/s]" for joint in JOINTS),
)
ACTIONS = tuple(f"{joint} torque [{gear} N m]" for joint, gear in zip(JOINTS, GEARS, strict=True))

SPEC = EnvSpec(
    name="half_cheetah",
    obs_names=(
        *("mean x velocity over the step [m/s]", "z above the start [m]", "sine of pitch", "cosine of pitch"),
        *(*JOINT_ANGLES, *VELOCITIES),
    ),
    action_names=ACTIONS,
    episode_steps=100,
    dt=DT,
)
TASK_SPEC = EnvSpec(
    name="half_cheetah_task",
    obs_names=("z above the start [m]", "pitch [rad]", *JOINT_ANGLES, *VELOCITIES),
    action_names=ACTIONS,
    episode_steps=1_000,
    dt=DT,
    has_reward=True,
)
TRANSFER_SPEC = dataclasses.replace(SPEC, name="half_cheetah_transfer", episode_steps=1_000, has_reward=True)

FASTEST = (5.0, 10.0)
"""Ends of the coverage grid on both sides of 0: m/s along x, rad/s of pitch."""
BINS = 20


def make_model() -> mujoco.MjModel:
    """Gymnasium's `half_cheetah.xml`, with cameras "track" (beside it) and "side" (at rest, from afar)."""
    assets = resources.files("gymnasium") / "envs" / "mujoco" / "assets"
    spec = mujoco.MjSpec.from_file(str(assets / "half_cheetah.xml"))
    spec.modelname = SPEC.name
    # C MuJoCo gives the same bits as with the default 100 and 50; MJX, batched, always pays for all of them.
    spec.option.iterations, spec.option.ls_iterations = 10, 10
    spec.add_numeric(name="max_contact_points", data=[MAX_CONTACTS])
    _light(spec)
    # The file asks for its total mass in a way that this MuJoCo warns of and the next one will refuse.
    spec.compiler.settotalmass = -1
    model = spec.compile()
    mujoco.mj_setTotalmass(model, MASS)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _light(spec: mujoco.MjSpec) -> None:
    """What only pictures need: colours, lights and two cameras. Physics does not see it."""
    light_gymnasium_floor(spec)
    for light in spec.lights:
        light.castshadow = False  # It is too low: its shadows end in midair.
    sky = spec.textures[0]
    sky.rgb1, sky.rgb2 = (0.96, 0.97, 0.98), (0.75, 0.79, 0.84)
    track = spec.camera("track")
    track.pos, track.alt.xyaxes = (0, -3, 0.8), (1, 0, 0, 0, 0.26, 0.97)
    spec.worldbody.add_camera(name="side", pos=(0, -8, 1.9), xyaxes=(1, 0, 0, 0, 0.2, 0.98), fovy=40)


def start(key: Key) -> tuple[Array, Array]:
    """Where an episode begins: at rest at the origin, joints at 0, shaken a little, as Gymnasium does it.

    U(-0.1, 0.1) on every position (m, rad) and N(0, 0.1^2) on every velocity (m/s, rad/s).

    Returns qpos `[9]` and qvel `[9]`.
    """
    qpos_key, qvel_key = jax.random.split(key)
    qpos = jax.random.uniform(qpos_key, (9,), minval=-RESET_SCALE, maxval=RESET_SCALE)
    return qpos, RESET_SCALE * jax.random.normal(qvel_key, (9,))


def observe(xp: ModuleType, qpos_before: Any, qpos: Any, qvel: Any) -> Any:
    """MAX's observation `[19]`: mean x velocity in the step, z, sine and cosine of pitch, joints `[6]`, qvel `[9]`."""
    velocity = (qpos[:1] - qpos_before[:1]) / DT
    return xp.concatenate([velocity, qpos[1:2], xp.sin(qpos[2:3]), xp.cos(qpos[2:3]), qpos[3:], qvel])


def observe_task(xp: ModuleType, qpos_before: Any, qpos: Any, qvel: Any) -> Any:
    """Gymnasium's observation `[17]`: all positions but x, and all velocities."""
    return xp.concatenate([qpos[1:], qvel])


def forward_reward(xp: ModuleType, action: Any, qpos_before: Any, qpos: Any, qvel: Any) -> Any:
    """Gymnasium's reward: mean x velocity over the step [m/s] minus `CONTROL_COST` times the squared actions' sum."""
    return (qpos[0] - qpos_before[0]) / DT - CONTROL_COST * xp.sum(xp.square(action))


def make_half_cheetah(backend: str = "auto", obs_noise: float = 0.0) -> Environment:
    """The half cheetah of exploration. Observations `[19]`, actions `[6]` in [-1, 1] (others are clipped), reward 0.

    The same key gives the same start on both engines. An episode is truncated at step 100 and terminated only where
    the physics diverges. Coverage: cells of x velocity and pitch rate, 400.

    Args:
        backend: `"mjx"` (JAX), `"mujoco"` (C, on the host) or `"auto"`: `"mujoco"` where JAX runs on a CPU.
        obs_noise: standard deviation of Gaussian noise on every observation entry, in its own unit; MAX's commands
            use 0.02. The simulation does not see it.

    Raises:
        FieldError: an unknown `backend`, or an `obs_noise` that is negative or not finite.
    """
    return _make(SPEC, observe, lambda xp, action, qpos_before, qpos, qvel: 0.0, backend, obs_noise)


def make_half_cheetah_task(backend: str = "auto", obs_noise: float = 0.0) -> Environment:
    """Gymnasium's HalfCheetah-v5. Observations `[17]`, actions `[6]` in [-1, 1] (others are clipped), forward reward.

    An episode is truncated at step 1,000; else as `make_half_cheetah`, arguments and errors too.
    """
    return _make(TASK_SPEC, observe_task, forward_reward, backend, obs_noise)


def make_half_cheetah_transfer(backend: str = "auto", obs_noise: float = 0.0) -> Environment:
    """The task of `make_half_cheetah_task` in the form of `make_half_cheetah`: observations `[19]`, 1,000 steps.

    Arguments and errors as there.
    """
    return _make(TRANSFER_SPEC, observe, forward_reward, backend, obs_noise)


def _make(spec: EnvSpec, observe: Any, reward: Any, backend: str, obs_noise: float) -> Environment:
    # The mean velocity where there is one: it is what MAX's task rewards.
    velocity = spec.obs_names.index("x velocity [m/s]" if spec is TASK_SPEC else "mean x velocity over the step [m/s]")
    dims = (velocity, spec.obs_names.index("pitch rate [rad/s]"))
    task = Task(
        spec=spec,
        model=make_model(),
        frame_skip=FRAME_SKIP,
        start=start,
        observe=observe,
        reward=reward,
        coverage=make_grid_coverage(dims, tuple(-x for x in FASTEST), FASTEST, BINS, "cells of speed and pitch rate"),
        cameras=("track", "side"),
    )
    return choose_engine(backend).make_environment(task, obs_noise)
