"""The U-shaped ant maze of MAX (nnaisense/max, `envs/ant.py` and `ant_maze.xml`): sparse, continuous exploration.

Gymnasium's ant in a corridor 2 m wide. Seen from above, with y upwards, `#` wall, `0` to `6` the free cells in the
order of their index; cell centres lie 2 m apart, the start cell's at (0, 0):

    #####
    #654#
    ###3#
    #012#
    #####

300 steps of 0.05 s, never terminated by the task. There is no reward: the maze is for coverage (`envs.coverage`).
"""
# pyright: reportAttributeAccessIssue=false
# mujoco ships no stubs.

from importlib import resources
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Environment, EnvSpec, FloorPlan, Task, choose_engine
from envs.coverage import make_box_coverage
from envs.views import light_gymnasium_floor
from jaxplore.types import Array, Key

FRAME_SKIP = 5
TIMESTEP = 0.01
DT = FRAME_SKIP * TIMESTEP
GEAR = 150.0
FRICTION = (1.0, 0.5, 0.5)
"""Sliding, torsional, rolling."""
TORSO_HEIGHT = 0.75
RESET_SCALE = 0.1
WALL_HEIGHT = 6.0
DRAWN_HEIGHT = 0.25
"""Of the walls in pictures, which are cut there: higher ones would hide the ant."""
MAX_CONTACTS = 24
"""Contacts that MJX solves for, the deepest of the 150 that it looks for. The ant was never seen with more than 7."""
PITCH = 2.0
FREE = ((0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2))
"""Column and row of the free cells, in the order of their index."""

CELLS = tuple((PITCH * i - 1, PITCH * j - 1, PITCH * i + 1, PITCH * j + 1) for i, j in FREE)
WALLS = (
    (-3.0, -3.0, -1.0, 7.0),  # left
    (5.0, -3.0, 7.0, 7.0),  # right
    (-1.0, -3.0, 5.0, -1.0),  # bottom
    (-1.0, 5.0, 5.0, 7.0),  # top
    (-1.0, 1.0, 3.0, 3.0),  # between the arms
)
"""MAX's 18 wall blocks merged into 5 boxes `(x_min, y_min, x_max, y_max)` [m]."""

INNER_WALL = "wall_4"
"""The last of them, between the arms of the U: the only box that the ant can touch."""

SIDES = (((-1, 0, 0), (1, 0, 0)), ((5, 0, 0), (-1, 0, 0)), ((0, -1, 0), (0, 1, 0)), ((0, 5, 0), (0, -1, 0)))
"""Position and normal of the planes that the first four walls turn to the maze."""

JOINTS = tuple(f"{joint}_{leg}" for leg in (1, 2, 3, 4) for joint in ("hip", "ankle"))
ACTUATORS = tuple(f"{joint}_{leg}" for leg in (4, 1, 2, 3) for joint in ("hip", "ankle"))

SPEC = EnvSpec(
    name="ant_maze",
    obs_names=(
        *("mean x velocity over the step [m/s]", "mean y velocity over the step [m/s]"),
        *("x [m]", "y [m]", "z [m]", "quaternion w", "quaternion x", "quaternion y", "quaternion z"),
        *(f"{joint} angle [rad]" for joint in JOINTS),
        *(f"{axis} velocity [m/s]" for axis in "xyz"),
        *(f"angular velocity about the torso's {axis} [rad/s]" for axis in "xyz"),
        *(f"{joint} velocity [rad/s]" for joint in JOINTS),
    ),
    action_names=tuple(f"{joint} torque [{GEAR:g} N m]" for joint in ACTUATORS),
    episode_steps=300,
    dt=DT,
)
POSITION = (2, 3)


def make_model() -> mujoco.MjModel:
    """The ant in its maze: gymnasium's `ant.xml` with MAX's numbers, the walls, and cameras "overview" and "track".

    Walls touch every part of the ant, as the floor does; the ant's own parts do not touch each other. The four outer
    walls are boxes to the eye only: what the ant meets are planes in their inner faces, cheaper in MJX, the same in
    both engines, and never tunnelled through. What pictures show of all five are sites, cut low.
    """
    spec = mujoco.MjSpec.from_file(str(resources.files("gymnasium") / "envs" / "mujoco" / "assets" / "ant.xml"))
    spec.modelname = SPEC.name
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    # C MuJoCo gives the same bits as with the default 100 and 50; MJX, batched, always pays for all of them.
    spec.option.iterations, spec.option.ls_iterations = 16, 10
    for actuator in spec.actuators:
        actuator.name, actuator.gear[0] = actuator.target, GEAR
    ant = [geom.name for geom in spec.geoms if geom.name != "floor"]
    for index, (x_min, y_min, x_max, y_max) in enumerate(WALLS):
        spec.worldbody.add_geom(
            name=f"wall_{index}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=((x_min + x_max) / 2, (y_min + y_max) / 2, WALL_HEIGHT / 2),
            size=((x_max - x_min) / 2, (y_max - y_min) / 2, WALL_HEIGHT / 2),
            contype=0,
            conaffinity=0,
        )
    for index, (pos, normal) in enumerate(SIDES):
        spec.worldbody.add_geom(
            name=f"side_{index}",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            pos=pos,
            zaxis=normal,
            size=(10, 10, 1),
            contype=1,  # As the floor; the ant has 1 and 0.
            conaffinity=1,
        )
    for geom in spec.geoms:
        geom.density, geom.friction, geom.condim = 5.0, FRICTION, 3
        # MuJoCo adds the margins of two geoms; in MAX's day it took the larger, 0.01 m.
        geom.margin = 0.01 if geom.name in ant else 0.0
    for name in ant:
        # A pair can have margin 0, a geom that meets the ant cannot; MJX knows no margin between capsule and box.
        spec.add_pair(
            geomname1=name, geomname2=INNER_WALL, condim=3, friction=np.repeat(FRICTION, (2, 1, 2)), margin=0.0
        )
    spec.delete(spec.numeric("init_qpos"))  # MAX has no use for it, and MJX finds its own number only if it is first.
    spec.add_numeric(name="max_contact_points", data=[MAX_CONTACTS])
    _light(spec)
    return spec.compile()


def _light(spec: mujoco.MjSpec) -> None:
    """What only pictures need: cut walls, colours, lights and two cameras. Physics does not see it."""
    light_gymnasium_floor(spec)
    for index, (x_min, y_min, x_max, y_max) in enumerate(WALLS):
        spec.geom(f"wall_{index}").rgba = (0.0, 0.0, 0.0, 0.0)
        spec.worldbody.add_site(
            name=f"wall_{index}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=((x_min + x_max) / 2, (y_min + y_max) / 2, DRAWN_HEIGHT / 2),
            size=((x_max - x_min) / 2, (y_max - y_min) / 2, DRAWN_HEIGHT / 2),
            rgba=(0.34, 0.44, 0.60, 1.0),
        )
    for index in range(len(SIDES)):
        spec.geom(f"side_{index}").rgba = (0.0, 0.0, 0.0, 0.0)
    spec.worldbody.add_camera(name="overview", pos=(2, 2, 46), fovy=15)
    track = spec.camera("track")
    track.pos, track.alt.xyaxes = (0, -1.8, 5.8), (1, 0, 0, 0, 0.955, 0.296)


def start(key: Key) -> tuple[Array, Array]:
    """Where an episode begins: at rest in the start cell, joints at 0, shaken a little.

    U(-0.1, 0.1) on every position (m, rad, quaternion entries) and N(0, 0.1^2) on every velocity (m/s, rad/s). The
    quaternion is then normalised, as the MuJoCo of MAX's day did with it.

    Returns qpos `[15]` and qvel `[14]`.
    """
    qpos_key, qvel_key = jax.random.split(key)
    rest = jnp.zeros(15).at[2].set(TORSO_HEIGHT).at[3].set(1.0)
    qpos = rest + jax.random.uniform(qpos_key, (15,), minval=-RESET_SCALE, maxval=RESET_SCALE)
    qpos = qpos.at[3:7].divide(jnp.linalg.norm(qpos[3:7]))
    return qpos, RESET_SCALE * jax.random.normal(qvel_key, (14,))


def start_in(key: Key, cell: int) -> tuple[Array, Array]:
    """`start`, at the centre of a cell."""
    qpos, qvel = start(key)
    return qpos.at[:2].add(PITCH * jnp.array(FREE, qpos.dtype)[cell]), qvel


def observe(xp: ModuleType, qpos_before: Any, qpos: Any, qvel: Any) -> Any:
    """The observation `[31]`: torso velocity in x and y over the step [m/s], qpos `[15]`, qvel `[14]`."""
    return xp.concatenate([(qpos[:2] - qpos_before[:2]) / DT, qpos, qvel])


def make_ant_maze(backend: str = "auto", obs_noise: float = 0.0) -> Environment:
    """The ant maze. Observations `[31]`, actions `[8]` in [-1, 1] (others are clipped), reward 0.

    The same key gives the same start on both engines. An episode is truncated at step 300 and terminated only where
    the physics diverges.

    Args:
        backend: `"mjx"` (JAX), `"mujoco"` (C, on the host) or `"auto"`: `"mujoco"` where JAX runs on a CPU.
        obs_noise: standard deviation of Gaussian noise on every observation entry, in its own unit; MAX's commands
            use 0.02. The simulation does not see it.

    Raises:
        FieldError: an unknown `backend`, or an `obs_noise` that is negative or not finite.
    """
    task = Task(
        spec=SPEC,
        model=make_model(),
        frame_skip=FRAME_SKIP,
        start=start,
        observe=observe,
        reward=lambda xp, action, qpos_before, qpos, qvel: 0.0,
        coverage=make_box_coverage(POSITION, CELLS, "maze cells"),
        cameras=("track", "overview"),
        floor_plan=FloorPlan(POSITION, WALLS, CELLS),
        start_in=start_in,
    )
    return choose_engine(backend).make_environment(task, obs_noise)
