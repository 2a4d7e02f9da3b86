"""The sparse continuous mountain car: a car in a valley, too weak to drive straight up to the flag.

The dynamics and numbers are those of Gymnasium's `MountainCarContinuous-v0`, whose units are its own: per step, not per
second. After the task of the MAX code base (nnaisense/max): an episode is 500 steps, and the reward is 100 for the step
that reaches position 0.45, which ends the episode, and 0 for every other step (Gymnasium also takes 0.1 action^2 from
each, and cuts at 999 steps).

Coverage is a grid of 10 x 10 cells of position and velocity.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment, EnvSpec, EnvState
from envs.coverage import make_grid_coverage
from envs.functional import BACKEND, Rules, make_environment
from envs.views import make_sketch_view
from jaxplore import validate
from jaxplore.types import Array, Key

MIN_POSITION, MAX_POSITION = -1.2, 0.6
"""The car stops dead at the first, and would stay at the second."""
MAX_SPEED = 0.07
POWER = 0.0015
"""What a full push adds to the velocity in a step."""
SLOPE = 0.0025
"""What the steepest slope takes from the velocity in a step."""
GOAL_POSITION = 0.45
GOAL_REWARD = 100.0
START = (-0.6, -0.4)
BINS = 10
REACHABLE = 90
"""Cells that some pushes lead to: a search over 21 pushes and 3,000 x 3,000 bins of states found no more, and all of
these within 83 steps of the start. In the others the car would be too fast near an end of the valley."""

SPEC = EnvSpec(
    name="mountain_car",
    obs_names=("position", "velocity [per step]"),
    action_names=("push to the right",),
    episode_steps=500,
    dt=1 / 30,  # A step has no duration; this is how fast Gymnasium shows it.
    has_reward=True,
)


def start(key: Key) -> Array:
    """At rest near the bottom of the valley: position U(-0.6, -0.4), velocity 0, `[2]`."""
    return jnp.stack([jax.random.uniform(key, minval=START[0], maxval=START[1]), jnp.float32(0)])


def start_in(key: Key, cell: int) -> Array:
    """Anywhere in a cell."""
    low = jnp.array([MIN_POSITION, -MAX_SPEED])
    size = (jnp.array([MAX_POSITION, MAX_SPEED]) - low) / BINS
    return low + size * (jnp.stack([cell // BINS, cell % BINS]) + jax.random.uniform(key, (2,)))


def advance(key: Key, state: Array, action: Array) -> Array:
    """Position and velocity `[2]` a step later. Nothing happens by chance."""
    position, velocity = state
    velocity = jnp.clip(velocity + (POWER * action[0] - SLOPE * jnp.cos(3 * position)), -MAX_SPEED, MAX_SPEED)
    position = jnp.clip(position + velocity, MIN_POSITION, MAX_POSITION)
    stopped = (position == MIN_POSITION) & (velocity < 0)
    return jnp.stack([position, jnp.where(stopped, 0.0, velocity)])


def reached(state: Array) -> Array:
    """Whether the car is at the flag and not rolling back, bool."""
    return (state[0] >= GOAL_POSITION) & (state[1] >= 0)


def hill(position: Any) -> Any:
    """Height of the ground at a position, in the same unit; for pictures only."""
    return 0.45 * np.sin(3 * position) + 0.55


def draw(axes: Any, state: EnvState) -> None:
    """The hill, the flag and the car."""
    from matplotlib.patches import Circle, Polygon

    # Beyond the ends of the road the ground is level, as far as any picture reaches.
    ground = np.linspace(-4.0, 3.4, 741)
    edges = (MIN_POSITION - 0.1, MAX_POSITION + 0.1)
    axes.fill_between(ground, -3.0, hill(np.clip(ground, *edges)), color="#c9d3de", linewidth=0)
    foot = hill(GOAL_POSITION)
    axes.plot([GOAL_POSITION, GOAL_POSITION], [foot, foot + 0.3], color="#22303f", linewidth=2)
    flag = [(GOAL_POSITION, foot + 0.3), (GOAL_POSITION + 0.14, foot + 0.245), (GOAL_POSITION, foot + 0.19)]
    axes.add_patch(Polygon(flag, color="#d9822b"))
    x = float(state.physics[0])
    angle = np.arctan(3 * 0.45 * np.cos(3 * x))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def place(points: Any) -> np.ndarray:
        return np.asarray(points) @ turn.T + (x, hill(x))

    body = place([(-0.1, 0.035), (0.1, 0.035), (0.1, 0.08), (0.05, 0.085), (0.025, 0.13), (-0.07, 0.13), (-0.1, 0.085)])
    axes.add_patch(Polygon(body, color="#335685"))
    for centre in place([(-0.055, 0.03), (0.055, 0.03)]):
        axes.add_patch(Circle(centre, 0.03, facecolor="#22303f", edgecolor="white", linewidth=1))


def make_mountain_car(backend: str = "auto", obs_noise: float = 0.0) -> Environment:
    """The mountain car. Observations `[2]`: position and velocity; actions `[1]` in [-1, 1] (others are clipped).

    An episode is terminated at the flag, and truncated at step 500.

    Args:
        backend: `"jax"`, or `"auto"` for the same.
        obs_noise: standard deviation of Gaussian noise on both observation entries, in their own unit. The simulation
            does not see it.

    Raises:
        FieldError: an unknown `backend`, or an `obs_noise` that is negative or not finite.
    """
    validate.one_of("backend", backend, ("auto", BACKEND))
    limits = (MIN_POSITION, -MAX_SPEED), (MAX_POSITION, MAX_SPEED)
    rules = Rules(
        spec=SPEC,
        start=start,
        advance=advance,
        observe=lambda before, state: state,
        coverage=make_grid_coverage((0, 1), *limits, BINS, "position x velocity cells", reachable=REACHABLE),
        reward=lambda before, action, after: jnp.where(reached(after), GOAL_REWARD, 0.0),
        terminated=reached,
        view=make_sketch_view((MIN_POSITION - 0.1, MAX_POSITION + 0.1, -0.05, 1.4), draw),
        start_in=start_in,
    )
    return make_environment(rules, obs_noise)
