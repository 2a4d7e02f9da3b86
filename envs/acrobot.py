"""The acrobot with a continuous torque: two links that hang from a pivot, driven at the joint between them.

The dynamics and numbers are those of Gymnasium's `Acrobot-v1` (Sutton 1996, equations of the book): links of 1 m and
1 kg, centres of mass half-way, moments of inertia of 1 kg m^2, 9.8 m/s^2, and one step of the classic Runge-Kutta rule
of 0.2 s. theta1 is the first link's angle from hanging straight down, theta2 the second link's from the first; both
grow to the right, towards +x. Changed after Ratzlaff et al. (2020), who say no more than this: the torque is any number
in [-1, 1] N m instead of one of -1, 0 and 1, and reaching the goal ends nothing. An episode is 500 steps, as in
`Acrobot-v1`; the reward is its reward, -1 for each step but 0 for one that ends with the tip more than 1 m above the
pivot.

The metric is the number of steps until the acrobot has been seen horizontal to both sides: coverage has 2 cells, one to
the right and one to the left. How horizontal is enough is not in the paper: see `HORIZONTAL`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Coverage, Environment, EnvSpec, EnvState, View
from envs.functional import BACKEND, Rules, make_environment
from envs.views import make_sketch_view
from jaxplore import validate
from jaxplore.types import Array, Key

DT = 0.2
LENGTH = 1.0
"""Of each link, m."""
CENTRE = 0.5
"""Distance of a link's centre of mass from its upper end, m."""
MASS = 1.0
"""Of each link, kg."""
INERTIA = 1.0
"""Of each link about its centre of mass, kg m^2."""
GRAVITY = 9.8
MAX_SPEED_1 = 4 * np.pi
"""Bound on the first link's angular velocity, rad/s. Beyond it, the step is cut to the bound."""
MAX_SPEED_2 = 9 * np.pi
RESET_SCALE = 0.1
GOAL_HEIGHT = 1.0
HORIZONTAL = 0.95
"""Sine of the angle from hanging that both links must reach to count as horizontal to the right: within 18.2 degrees of
it. Minus this or less is to the left."""

SPEC = EnvSpec(
    name="acrobot",
    obs_names=(
        *("cos theta1", "sin theta1", "cos theta2", "sin theta2"),
        *("theta1 velocity [rad/s]", "theta2 velocity [rad/s]"),
    ),
    action_names=("torque at the joint between the links [1 N m]",),
    episode_steps=500,
    dt=DT,
    has_reward=True,
)


def start(key: Key) -> Array:
    """Hanging down, shaken a little: U(-0.1, 0.1) on both angles [rad] and both velocities [rad/s], `[4]`."""
    return jax.random.uniform(key, (4,), minval=-RESET_SCALE, maxval=RESET_SCALE)


def start_in(key: Key, cell: int) -> Array:
    """`start`, held out to the right (cell 0) or to the left (cell 1) instead of down."""
    return start(key).at[0].add(jnp.where(cell == 0, 0.5, -0.5) * jnp.pi)


def derivative(state: Array, torque: Array) -> Array:
    """Velocities and accelerations `[4]` of angles and velocities `[4]` under a torque [N m] at the second joint."""
    theta1, theta2, speed1, speed2 = state
    sin2, cos2 = jnp.sin(theta2), jnp.cos(theta2)
    # The mass matrix is [[d1, d2], [d2, d3]].
    d3 = MASS * CENTRE**2 + INERTIA
    d2 = d3 + MASS * LENGTH * CENTRE * cos2
    d1 = MASS * CENTRE**2 + INERTIA + d3 + MASS * (LENGTH**2 + 2 * LENGTH * CENTRE * cos2)
    swing = MASS * LENGTH * CENTRE * sin2
    pull2 = MASS * CENTRE * GRAVITY * jnp.sin(theta1 + theta2)
    pull1 = MASS * (CENTRE + LENGTH) * GRAVITY * jnp.sin(theta1) + pull2
    rest1 = pull1 - swing * (speed2**2 + 2 * speed2 * speed1)
    rest2 = pull2 + swing * speed1**2
    acceleration2 = (torque - rest2 + d2 / d1 * rest1) / (d3 - d2**2 / d1)
    acceleration1 = -(d2 * acceleration2 + rest1) / d1
    return jnp.stack([speed1, speed2, acceleration1, acceleration2])


def integrate(state: Array, torque: Array, dt: float = DT) -> Array:
    """One step of the classic Runge-Kutta rule, `[4]`, before angles are wrapped and velocities bounded."""
    k1 = derivative(state, torque)
    k2 = derivative(state + dt / 2 * k1, torque)
    k3 = derivative(state + dt / 2 * k2, torque)
    k4 = derivative(state + dt * k3, torque)
    return state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def advance(key: Key, state: Array, action: Array) -> Array:
    """The state `[4]` a step later: angles in [-pi, pi), velocities within their bounds. Nothing happens by chance."""
    theta1, theta2, speed1, speed2 = integrate(state, action[0])
    wrapped = [angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi)) for angle in (theta1, theta2)]
    bounded = [jnp.clip(speed1, -MAX_SPEED_1, MAX_SPEED_1), jnp.clip(speed2, -MAX_SPEED_2, MAX_SPEED_2)]
    return jnp.stack([*wrapped, *bounded])


def observe(before: Array, state: Array) -> Array:
    """The observation `[6]`; see `SPEC`."""
    theta1, theta2, speed1, speed2 = state
    return jnp.stack([jnp.cos(theta1), jnp.sin(theta1), jnp.cos(theta2), jnp.sin(theta2), speed1, speed2])


def height(state: Array) -> Array:
    """How far the tip is above the pivot, m."""
    return -LENGTH * (jnp.cos(state[0]) + jnp.cos(state[0] + state[1]))


def make_horizontal_coverage(horizontal: float = HORIZONTAL) -> Coverage:
    """Cell 0: both links point to the right. Cell 1: both point to the left. Any other observation lies in neither.

    Args:
        horizontal: sine of the angle from hanging that both links must reach, above 0 and at most 1.

    Raises:
        FieldError: `horizontal` is out of range.
    """
    validate.in_range("horizontal", horizontal, 0.0, 1.0, open_low=True)

    def cell(obs: Array) -> Array:
        cos1, sin1, cos2, sin2 = obs[:4]
        sin_both = sin1 * cos2 + cos1 * sin2
        right = (sin1 >= horizontal) & (sin_both >= horizontal)
        left = (sin1 <= -horizontal) & (sin_both <= -horizontal)
        return jnp.where(right, 0, jnp.where(left, 1, -1)).astype(jnp.int32)

    return Coverage(2, cell, "horizontal poses")


def _make_view(horizontal: float) -> View:
    """The two links, and the two wedges in which both must point."""
    slack = np.degrees(np.arccos(horizontal))

    def draw(axes: Any, state: EnvState) -> None:
        from matplotlib.patches import Circle, Wedge

        theta1, theta2 = state.physics[:2]
        elbow = LENGTH * np.array([np.sin(theta1), -np.cos(theta1)])
        tip = elbow + LENGTH * np.array([np.sin(theta1 + theta2), -np.cos(theta1 + theta2)])
        for centre in (0.0, 180.0):
            axes.add_patch(Wedge((0, 0), 2 * LENGTH, centre - slack, centre + slack, color="#e8ecf2", zorder=0))
        axes.axhline(GOAL_HEIGHT, color="#b9c2cf", linewidth=1, linestyle=(0, (4, 4)), zorder=1)
        for (x, y), colour in (((0 * elbow, elbow), "#335685"), ((elbow, tip), "#d9822b")):
            axes.plot(*np.transpose([x, y]), color=colour, linewidth=14, solid_capstyle="round", zorder=2)
        for x, y in (0 * elbow, elbow):
            axes.add_patch(Circle((x, y), 0.05, facecolor="white", edgecolor="#22303f", linewidth=1.5, zorder=3))

    return make_sketch_view((-2.3, 2.3, -2.3, 2.3), draw)


def make_acrobot(backend: str = "auto", obs_noise: float = 0.0, horizontal: float = HORIZONTAL) -> Environment:
    """The acrobot. Observations `[6]`, actions `[1]` in [-1, 1] (others are clipped): the torque in N m.

    An episode is truncated at step 500 and terminated only where numbers stop being finite.

    Args:
        backend: `"jax"`, or `"auto"` for the same.
        obs_noise: standard deviation of Gaussian noise on every observation entry, in its own unit. The simulation
            does not see it.
        horizontal: how horizontal is enough; see `HORIZONTAL`.

    Raises:
        FieldError: an unknown `backend`, an `obs_noise` that is negative or not finite, or `horizontal` out of range.
    """
    validate.one_of("backend", backend, ("auto", BACKEND))
    rules = Rules(
        spec=SPEC,
        start=start,
        advance=advance,
        observe=observe,
        coverage=make_horizontal_coverage(horizontal),
        reward=lambda before, action, after: jnp.where(height(after) > GOAL_HEIGHT, 0.0, -1.0),
        view=_make_view(horizontal),
        start_in=start_in,
    )
    return make_environment(rules, obs_noise)
