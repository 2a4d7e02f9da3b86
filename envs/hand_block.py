"""A Shadow hand with a block on its palm: HandManipulateBlock of gymnasium-robotics, without a goal.

The forearm is held with the palm up; 20 position servos tilt the wrist and bend the fingers. The block, 5 cm wide and
71 g, can be turned in the palm and can fall off it, and then stays where it lies. 300 steps of 0.04 s, never terminated
by the task, no reward: it is for coverage of the block's orientations (`make_rotation_coverage`).

The model is built from the files that the `gymnasium-robotics` package brings; none of its code is run.

**What is left out** of its `manipulate_block.xml`, in both engines alike, so that MJX can run it, and hundreds of it:

- the block that shows the goal, which falls for ever and touches nothing, and the sensors, which nothing reads;
- 40 of the 44 tendons: their limits lie beyond the limits of the joints that they pull. The four that couple the last
  two joints of a finger stay;
- contact of the hand with the floor, which it cannot reach within its joints' limits;
- contact with the two 2 mm cubes that mark joints inside the thumb;
- the forearm's mesh: the block meets a capsule of its size there. Everything else that can touch, touches as before:
  block with palm, wrist, forearm, all fingers and floor, and fingers with fingers and palm.
"""
# pyright: reportAttributeAccessIssue=false
# mujoco ships no stubs.

import functools
import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Coverage, Environment, EnvSpec, Task, choose_engine
from jaxplore.types import Array, Key

PACKAGE = "gymnasium_robotics"
FRAME_SKIP = 20
TIMESTEP = 0.002
DT = FRAME_SKIP * TIMESTEP
NUM_JOINTS = 24
MAX_CONTACTS = 16
"""Contacts that MJX solves for, the deepest of the block's and as many of the fingers' with each other."""

NUM_STARTS = 100
DROP = (1.0, 0.87, 0.2)
DROP_SCALE = 0.005
SETTLING_STEPS = 10
ON_PALM = 0.04
"""Height [m] that the block's centre is above when it has not fallen off the hand."""

JOINTS = (
    *("WRJ1", "WRJ0"),
    *(f"{finger}J{index}" for finger in ("FF", "MF", "RF") for index in (3, 2, 1, 0)),
    *(f"LFJ{index}" for index in (4, 3, 2, 1, 0)),
    *(f"THJ{index}" for index in (4, 3, 2, 1, 0)),
)
"""The hand's joints: wrist, first, middle, ring and little finger, thumb."""
COUPLED = ("FFJ0", "MFJ0", "RFJ0", "LFJ0")
"""Joints without a servo: a tendon couples them to the joint before."""

SPEC = EnvSpec(
    name="hand_block",
    obs_names=(
        *(f"{joint} angle [rad]" for joint in JOINTS),
        *(f"{joint} velocity [rad/s]" for joint in JOINTS),
        *(f"block {axis} velocity [m/s]" for axis in "xyz"),
        *(f"block angular velocity about its {axis} [rad/s]" for axis in "xyz"),
        *(f"block {axis} [m]" for axis in "xyz"),
        *(f"block quaternion {part}" for part in "wxyz"),
    ),
    action_names=tuple(f"{joint} target, of its range" for joint in JOINTS if joint not in COUPLED),
    episode_steps=300,
    dt=DT,
)


def find_asset() -> Path:
    """Where gymnasium-robotics has `manipulate_block.xml`.

    Raises:
        ImportError: the package is not installed; says how to install it.
    """
    spec = importlib.util.find_spec(PACKAGE)  # Not imported: its import registers environments that fail here.
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(
            "hand_block needs the Shadow hand of gymnasium-robotics, which is not installed. "
            'What to do: pip install -e ".[robotics]".'
        )
    return Path(spec.submodule_search_locations[0], "envs", "assets", "hand", "manipulate_block.xml")


def make_model() -> mujoco.MjModel:
    """The hand and the block, cut down as the module's text says, with cameras "palm" and "side".

    Raises:
        ImportError: gymnasium-robotics is not installed.
    """
    spec = mujoco.MjSpec.from_file(str(find_asset()))
    spec.modelname = SPEC.name
    for element in (spec.body("target"), spec.geom("object_hidden"), *spec.sensors):
        spec.delete(element)
    for tendon in spec.tendons:
        if not tendon.name.endswith("J1c"):
            spec.delete(tendon)
    for name in ("robot0:V_thbase", "robot0:V_thhub"):
        spec.geom(name).contype = spec.geom(name).conaffinity = 0
    # A kind of contact of their own: the hand offers kind 1, which the floor no longer takes.
    spec.geom("floor0").conaffinity, spec.geom("object").contype = 2, 3
    forearm = spec.geom("robot0:C_forearm")
    forearm.type, forearm.meshname = mujoco.mjtGeom.mjGEOM_CAPSULE, ""
    forearm.pos, forearm.alt.euler, forearm.size = (0, 0.01, 0.154), (0, 0, 0), (0.0665, 0.0475, 0)
    forearm.quat = (1, 0, 0, 0)
    spec.add_numeric(name="max_contact_points", data=[MAX_CONTACTS])
    _light(spec)
    return spec.compile()


def _light(spec: mujoco.MjSpec) -> None:
    """What only pictures need: colours, lights and two cameras. Physics does not see it."""
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 1280
    spec.visual.headlight.ambient = (0.3, 0.3, 0.3)
    spec.visual.headlight.diffuse = (0.3, 0.3, 0.3)
    for light in spec.lights:
        light.ambient, light.diffuse = (0, 0, 0), (0.45, 0.45, 0.45)
    sky, floor = spec.textures[0], spec.material("floor_mat")
    sky.rgb1, sky.rgb2 = (0.96, 0.97, 0.98), (0.75, 0.79, 0.84)
    floor.rgba, floor.specular = (0.45, 0.50, 0.56, 1.0), 0.0
    spec.worldbody.add_camera(name="palm", pos=(0.80, 0.60, 0.48), xyaxes=(0.83, -0.56, 0, 0.38, 0.56, 0.74), fovy=32)
    spec.worldbody.add_camera(name="side", pos=(1.5, 0.9, 0.3), xyaxes=(0, 1, 0, -0.29, 0, 0.96), fovy=40)


@functools.cache
def settled_starts() -> tuple[np.ndarray, np.ndarray]:
    """States to begin an episode in, drawn once: qpos `[NUM_STARTS, 31]` and qvel `[NUM_STARTS, 30]`.

    Each is made as gymnasium-robotics makes its reset: hand stretched out, the block 6 cm above the palm, moved by
    N(0, 0.005^2) m along each axis and turned by an angle U(-pi, pi) about an axis with entries U(-1, 1); then 10 steps
    with all servos at the middle of their range, in which the block falls and the fingers half close on it. A block
    that misses the hand is drawn again.

    Raises:
        ImportError: gymnasium-robotics is not installed.
    """
    model, rng, starts = make_model(), np.random.default_rng(0), []
    data = mujoco.MjData(model)
    while len(starts) < NUM_STARTS:
        mujoco.mj_resetData(model, data)
        angle, axis = rng.uniform(-np.pi, np.pi), rng.uniform(-1, 1, 3)
        data.qpos[NUM_JOINTS : NUM_JOINTS + 3] = DROP + rng.normal(0, DROP_SCALE, 3)
        data.qpos[NUM_JOINTS + 3 :] = np.cos(angle / 2), *np.sin(angle / 2) * axis / np.linalg.norm(axis)
        data.ctrl[:] = model.actuator_ctrlrange.mean(axis=1)
        mujoco.mj_step(model, data, SETTLING_STEPS * FRAME_SKIP)
        if data.qpos[NUM_JOINTS + 2] > ON_PALM:
            starts.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = zip(*starts, strict=True)
    return np.stack(qpos), np.stack(qvel)


def start(key: Key) -> tuple[Array, Array]:
    """Where an episode begins: one of `settled_starts`, each as likely. Returns qpos `[31]` and qvel `[30]`."""
    index = jax.random.randint(key, (), 0, NUM_STARTS)
    qpos, qvel = (jnp.asarray(states, jnp.float32)[index] for states in settled_starts())
    return qpos, qvel


def observe(xp: ModuleType, qpos_before: Any, qpos: Any, qvel: Any) -> Any:
    """The observation `[61]`: joint angles `[24]`, all velocities `[30]`, position and quaternion of the block."""
    return xp.concatenate([qpos[:NUM_JOINTS], qvel, qpos[NUM_JOINTS:]])


def euler_angles(quaternion: Array) -> Array:
    """Angles [degrees] about the fixed axes x, y, z, in this order, of a quaternion `(x, y, z, w)`.

    As `scipy.spatial.transform.Rotation.from_quat(quaternion).as_euler("xyz", degrees=True)`, by the formulas of
    Bernardes and Viollet (PLOS ONE, 2022). The quaternion need not be normalised. Where the second angle is 90 or -90
    the third is 0.

    Returns:
        `[3]`: the first and the third in [-180, 180], the second in [-90, 90].
    """
    x, y, z, w = quaternion
    middle = 2 * jnp.arctan2(jnp.hypot(y + w, z - x), jnp.hypot(w - y, x + z))
    half_sum, half_difference = jnp.arctan2(x + z, w - y), jnp.arctan2(z - x, y + w)
    first, third = half_sum - half_difference, half_sum + half_difference
    down, up = middle < LOCKED, middle > jnp.pi - LOCKED
    first = jnp.where(down, 2 * half_sum, jnp.where(up, -2 * half_difference, first))
    third = jnp.where(down | up, 0.0, third)
    angles = jnp.rad2deg(jnp.stack([first, middle - jnp.pi / 2, third]))
    return jnp.where(angles > 180, angles - 360, jnp.where(angles < -180, angles + 360, angles))


LOCKED = 1e-6
"""Radians from 90 degrees at which the first and the third angle turn about one axis."""
BINS = 8
BIN_WIDTH = 45


def make_rotation_coverage() -> Coverage:
    """The paper's cells of the block's orientation: 8 x 8 x 8 bins of 45 degrees of its Euler angles.

    As in the authors' code, the last four numbers of an observation are read as a quaternion `(x, y, z, w)`, although
    MuJoCo writes `(w, x, y, z)`: the cells are then others, but as many and as good. Each angle is cut to whole degrees
    towards 0, and its bin is that of 45 degrees, from -180 on, that it lies in.

    The middle angle reaches from -90 to 90 degrees, half of its bins, so 256 of the 512 cells can be reached, which is
    why no method sees more than half. Their code has no bin for exactly 180 degrees, and counts exactly 90 of the
    middle angle as in a fifth; here the one is -180 degrees, which is the same angle, and the other in the fourth bin.
    A quaternion of zeros, or one that is not finite, lies in no cell.
    """

    def cell(obs: Array) -> Array:
        quaternion = obs[-4:]
        norm = jnp.linalg.norm(quaternion)
        known = jnp.isfinite(norm) & (norm > 0)
        whole = jnp.trunc(euler_angles(jnp.where(known, quaternion, 1.0))).astype(jnp.int32)
        first, middle, third = (whole + 180) // BIN_WIDTH
        index = (first % BINS * BINS + jnp.minimum(middle, 5)) * BINS + third % BINS
        return jnp.where(known, index, -1).astype(jnp.int32)

    return Coverage(BINS**3, cell, "cells of 45 degrees", reachable=BINS**3 // 2)


def make_hand_block(backend: str = "auto", obs_noise: float = 0.0) -> Environment:
    """The hand and its block. Observations `[61]`, actions `[20]` in [-1, 1] (others are clipped), reward 0.

    An action says where each servo shall go: -1 to 1 is the whole range of its joint. The same key gives the same start
    on both engines; there are `NUM_STARTS` (`settled_starts`). An episode is truncated at step 300 and terminated only
    where the physics diverges: a block that has fallen stays fallen.

    Args:
        backend: `"mjx"` (JAX), `"mujoco"` (C, on the host) or `"auto"`: `"mujoco"`, also where JAX runs on a GPU,
            because MJX is faster only for hundreds of hands at once.
        obs_noise: standard deviation of Gaussian noise on every observation entry, in its own unit. The simulation
            does not see it.

    Raises:
        ImportError: gymnasium-robotics is not installed; says how to install it.
        FieldError: an unknown `backend`, or an `obs_noise` that is negative or not finite.
    """
    engine = choose_engine("mujoco" if backend == "auto" else backend)
    model = make_model()
    settled_starts()  # Here and not when `start` is first traced, which may be within a timed or compiled program.
    middle = model.actuator_ctrlrange.mean(axis=1)
    half_range = np.ptp(model.actuator_ctrlrange, axis=1) / 2
    task = Task(
        spec=SPEC,
        model=model,
        frame_skip=FRAME_SKIP,
        start=start,
        observe=observe,
        reward=lambda xp, action, qpos_before, qpos, qvel: 0.0,
        coverage=make_rotation_coverage(),
        cameras=("palm", "side"),
        control=lambda xp, action: middle + half_range * action,
    )
    return engine.make_environment(task, obs_noise)
