"""A corridor whose only reward lies at its far end: uniform actions do not get there, and neither does SAC."""

import jax
import jax.numpy as jnp

from envs.base import Environment, EnvSpec
from envs.coverage import make_box_coverage
from envs.functional import Rules, make_environment
from jaxplore import Method, Reward
from jaxplore.parts import read_off, sac_in_imagination, static_belief
from jaxplore.types import Array, Key

LENGTH, GOAL, SPEED, WIND, STEPS = 10.0, 6.0, 0.5, 0.25, 50
LEGS = (1.0, -1.0, 1.0, 1.0, -1.0, -1.0)
STRETCHES = tuple((float(x), -1.0, x + 1.0, 1.0) for x in range(int(LENGTH)))


def make_corridor(backend: str = "auto", obs_noise: float = 0.0) -> Environment:
    """A point that walks on six legs against the wind; 1 for each step beyond `GOAL`.

    Each leg has its own direction, and unless all six work nearly as one the wind blows it back. So uniform actions get
    nowhere, nor does a policy that has drifted to any other corner of what it can do. Whoever only walks on has a
    reward in the last 25 of 50 steps.
    """
    spec = EnvSpec(
        "corridor", ("position [m]", "step [m]"), tuple(f"leg {i}" for i in range(6)), STEPS, 1.0, has_reward=True
    )

    def advance(key: Key, position: Array, action: Array) -> Array:
        return jnp.clip(position + SPEED * jnp.mean(action * jnp.array(LEGS)) - WIND, -LENGTH, LENGTH)

    def observe(before: Array, position: Array) -> Array:
        return jnp.concatenate([position, position - before])

    def reward(before: Array, action: Array, position: Array) -> Array:
        return jnp.float32(position[0] > GOAL)

    start = lambda key: 0.1 * jax.random.uniform(key, (1,))  # noqa: E731
    coverage = make_box_coverage((0, 1), STRETCHES, "stretches")
    return make_environment(Rules(spec, start, advance, observe, coverage, reward=reward), obs_noise)


def walks_on(prediction, delta, normalizers) -> Array:
    """How far the models expect the next step to lead, normalised."""
    return jnp.mean(prediction.mean[..., 0], axis=0)


ONWARDS = Method(
    "static networks, the way that they expect to be covered, SAC in imagination",
    read_off(static_belief, lambda config: Reward(walks_on, "normalised delta")),
    sac_in_imagination,
    actions="continuous",
)
"""An explorer that never sees the task's reward and is never done with the corridor. One that seeks disagreement comes
to such an end, too, but moves on when it knows it."""
