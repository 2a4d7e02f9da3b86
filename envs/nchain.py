"""The chain: a long row of states, where half of them exchange the two actions (Ratzlaff et al. 2020, section 4).

An agent starts near one end and must take 38 steps in one direction to see the other, within an episode of 49. In each
*flip-state* forward and backward are exchanged, so only trying shows which action leads on: a walk that does
not know it is a fair random walk.

The paper changes Gymnasium's old NChain, whose backward action jumps to the first state and whose actions slip.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Coverage, Environment, EnvSpec, EnvState
from envs.functional import BACKEND, Rules, make_environment
from envs.views import make_sketch_view
from jaxplore import validate
from jaxplore.types import Array, Key
from jaxplore.validate import FieldError

START = 1
EXTRA_STEPS = 9
"""An episode has this many steps more than there are states."""
NEAR_REWARD, FAR_REWARD = 0.01, 1.0
"""Of a step that ends in the first state, and in the last."""
LINKS_PER_ROW = 10
"""Of the picture."""


def flip_states(num_states: int, seed: int) -> np.ndarray:
    """Which states exchange the two actions, each with probability 1/2: bool `[num_states]`, the same for one seed."""
    return np.array(jax.device_get(jax.random.bernoulli(jax.random.key(seed), 0.5, (num_states,))))


def make_nchain(backend: str = "auto", obs_noise: float = 0.0, num_states: int = 40, seed: int = 0) -> Environment:
    """A chain of states with a step forward or backward, and flip-states in which the two are exchanged.

    Observation: which state the agent is in, as a one-hot vector `[num_states]`. Actions: `forward` (to the next
    higher state) and `backward`, as a one-hot vector `[2]`; in a flip-state each does what the other says. At both ends
    a step outwards stays where it is. There is no chance in it.

    An episode begins in state 1 and is truncated after `num_states + 9` steps; it never terminates. Reward: 0.01 for a
    step that ends in state 0, 1 for one that ends in the last state, 0 elsewhere; exploration does not use it.

    Coverage: the states, `num_states` cells.

    Args:
        backend: `"jax"`, or `"auto"`, which is the same.
        obs_noise: 0; a one-hot vector has no noise.
        num_states: N. Paper: 40.
        seed: of the flip-states, drawn once: they are the same in every episode.

    Raises:
        FieldError: another `backend`, `obs_noise` other than 0, `num_states` below 3, or a negative `seed`.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> chain = make_nchain(num_states=5)
        >>> state, transition = chain.step(chain.reset(jax.random.key(0)), jnp.array([1.0, 0.0]))
        >>> transition.obs
        Array([0., 1., 0., 0., 0.], dtype=float32)
    """
    validate.one_of("backend", backend, ("auto", BACKEND))
    if obs_noise != 0:
        raise FieldError("obs_noise", obs_noise, "0", "does not fit one-hot observations")
    validate.at_least("num_states", num_states, 3)
    validate.at_least("seed", seed, 0)
    flips = flip_states(num_states, seed)
    last = num_states - 1

    def advance(key: Key, state: Array, action: Array) -> Array:
        forward = (action[0] > action[1]) ^ jnp.asarray(flips)[state]
        return jnp.clip(state + jnp.where(forward, 1, -1), 0, last)

    def reward(before: Array, action: Array, after: Array) -> Array:
        return jnp.where(after == last, FAR_REWARD, jnp.where(after == 0, NEAR_REWARD, 0.0))

    spec = EnvSpec(
        name="nchain",
        obs_names=tuple(f"in state {i}" for i in range(num_states)),
        action_names=("forward", "backward"),
        episode_steps=num_states + EXTRA_STEPS,
        dt=1.0,
        discrete=True,
        one_hot_obs=True,
        has_reward=True,
    )
    num_rows = -(-num_states // LINKS_PER_ROW)
    rules = Rules(
        spec=spec,
        start=lambda key: jnp.int32(START),
        advance=advance,
        observe=lambda before, state: jax.nn.one_hot(state, num_states),
        coverage=Coverage(num_states, lambda obs: jnp.argmax(obs).astype(jnp.int32), "states"),
        reward=reward,
        view=make_sketch_view(
            (-1.0, min(num_states, LINKS_PER_ROW), -num_rows, 1.0), lambda axes, state: _draw(axes, state, flips)
        ),
        start_in=lambda key, cell: jnp.int32(cell),
    )
    return make_environment(rules)


def _place(state: int) -> tuple[int, int]:
    """Where a state is drawn: rows run to and fro, so that neighbours are side by side."""
    row, column = divmod(state, LINKS_PER_ROW)
    return (column if row % 2 == 0 else LINKS_PER_ROW - 1 - column), -row


def _draw(axes: Any, state: EnvState, flips: np.ndarray) -> None:
    """Links as circles, flip-states grey, the agent red."""
    from matplotlib.patches import Circle

    places = [_place(i) for i in range(len(flips))]
    axes.plot(*zip(*places, strict=True), color="0.5", zorder=0)
    for i, (place, flip) in enumerate(zip(places, flips, strict=True)):
        here = i == int(state.physics)
        colour = "tab:red" if here else "0.75" if flip else "white"
        axes.add_patch(Circle(place, 0.36, facecolor=colour, edgecolor="0.2", hatch="//" if flip else None))
        axes.text(*place, str(i), ha="center", va="center", fontsize=9, color="white" if here else "black")
