"""What limits coverage in the Ant maze once the belief is good? Methods that know what no agent does, for comparison:

    python -m experiments.run --import=benchmarks.oracles --env=ant_maze --method=oracle_counts
    python -m experiments.run --import=benchmarks.oracles --env=ant_maze --method=oracle_distance

`oracle_counts` is given the novelty that a belief's uncertainty stands for: a real transition is worth
1 / sqrt(visits) of the square of 0.5 m that it leads to. `oracle_distance` is paid for each metre along the corridor,
so that it shows how soon this ant can be at the end of it at all. Both train SAC on real transitions, with the settings
of `icm` (`--reactive.*`, `--sac.*`), and model nothing.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from envs import ant_maze
from jaxplore import METHODS, Behaviour, ExplorationConfig, Method, Sizes, Transition
from jaxplore.behaviours import Experience
from jaxplore.behaviours.real_data import make_relabelled
from jaxplore.parts import make_learner, no_belief, no_reward, reads
from jaxplore.replay import Replay
from jaxplore.types import Array

SQUARE = 0.5
"""Side of a square whose visits are counted [m]."""
LOW, HIGH = -1.0, 5.0
"""The maze's extent in x and y [m]."""
NUM = round((HIGH - LOW) / SQUARE)

Rule = Callable[[Replay[Transition]], Array]
"""`rule(data) -> reward` of each row of a buffer, `[capacity]`."""


def square_of(obs: Array) -> Array:
    """Index of the square that an observation `[..., O]` is in, int32 `[...]`."""
    place = jnp.clip((obs[..., list(ant_maze.POSITION)] - LOW) / SQUARE, 0, NUM - 1).astype(jnp.int32)
    return place[..., 0] * NUM + place[..., 1]


def rarity(data: Replay[Transition]) -> Array:
    """1 / sqrt(visits) of the square that each transition leads to."""
    square = square_of(data.rows.next_obs)
    held = jnp.arange(square.shape[0]) < data.size
    visits = jnp.zeros(NUM * NUM).at[square].add(held.astype(jnp.float32))
    return jax.lax.rsqrt(jnp.maximum(visits[square], 1.0))


def along(obs: Array) -> Array:
    """How far along the corridor observations `[..., O]` are [m]: 0 in the middle of the first cell, 12 of the last."""
    x, y = (obs[..., i] for i in ant_maze.POSITION)
    first, middle, last = jnp.minimum(x, 4.0), 4.0 + y, 12.0 - x
    return jnp.where(y > 3.0, last, jnp.where((x > 3.0) & (y > 0.0), middle, first))


def progress(data: Replay[Transition]) -> Array:
    """Metres along the corridor that each transition made."""
    return along(data.rows.next_obs) - along(data.rows.obs)


@reads("reactive", "sac")
def on_real_data(sizes: Sizes, config: ExplorationConfig, belief: object, score: object, *, rule: Rule) -> Behaviour:
    """SAC on real transitions with a reward by rule, otherwise as `make_reactive`."""
    del belief, score

    def relabel(experience: Experience) -> Replay[Transition]:
        rows = experience.data.rows._replace(reward=rule(experience.data))
        return dataclasses.replace(experience.data, rows=rows)

    return make_relabelled(relabel, make_learner(sizes, config), sizes.obs, sizes.action, config.reactive)


def _behaviour(rule: Rule) -> Callable[..., Behaviour]:
    made = functools.partial(on_real_data, rule=rule)
    made.reads = on_real_data.reads  # pyright: ignore[reportAttributeAccessIssue, reportFunctionMemberAccess]
    return made


METHODS["oracle_counts"] = Method(
    "true visits of squares of 0.5 m as the reward, SAC on real transitions",
    no_belief,
    no_reward,
    _behaviour(rarity),
    actions="continuous",
)
METHODS["oracle_distance"] = Method(
    "metres along the corridor as the reward, SAC on real transitions",
    no_belief,
    no_reward,
    _behaviour(progress),
    actions="continuous",
)
