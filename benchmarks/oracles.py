"""What limits coverage in the Ant maze once the belief is good? Methods that know what no agent does, for comparison:

    python -m experiments.run --import=benchmarks.oracles --env=ant_maze --method=oracle_counts
    python -m experiments.run --import=benchmarks.oracles --env=ant_maze --method=oracle_distance
    python -m experiments.run --import=benchmarks.oracles --env=ant_maze --method=oracle_counts_imagined
    python -m experiments.run --import=benchmarks.oracles --env=acrobot --method=oracle_simulator

`oracle_counts` is given the novelty that a belief's uncertainty stands for: a real transition is worth
1 / sqrt(visits) of the square of 0.5 m that it leads to. `oracle_distance` is paid for each metre along the corridor,
so that it shows how soon this ant can be at the end of it at all. Both train SAC on real transitions (`--reactive.*`,
`--sac.*`; the preset's, not those that were chosen for one method), and model nothing. `oracle_counts_imagined` has the
same counts as a reward in what static networks imagine, and learns from nothing else.

`oracle_simulator` asks what the errors of models cost: it is `implicit` in imagination alone
(`--method=implicit --imagination.real-fraction=0`), but the acrobot's own equations move the actors.
"""

from typing import Any

import jax
import jax.numpy as jnp

from envs import acrobot, ant_maze
from jaxplore import (
    METHODS,
    Behaviour,
    ExplorationConfig,
    Method,
    Normalizers,
    Replay,
    Seen,
    Signal,
    Sizes,
    Transition,
    make_imagination,
    make_sac,
)
from jaxplore.methods import in_imagination_alone
from jaxplore.parts import (
    fields_read,
    generator_belief,
    read_off,
    reads,
    sac_in_imagination,
    sac_on_real_data,
    static_belief,
    variance_reward,
)
from jaxplore.types import Array, Metrics
from jaxplore.validate import FieldError

SQUARE = 0.5
"""Side of a square whose visits are counted [m]."""
LOW, HIGH = -1.0, 5.0
"""The maze's extent in x and y [m]."""
NUM = round((HIGH - LOW) / SQUARE)


def square_of(obs: Array) -> Array:
    """Index of the square that an observation `[..., O]` is in, int32 `[...]`."""
    place = jnp.clip((obs[..., list(ant_maze.POSITION)] - LOW) / SQUARE, 0, NUM - 1).astype(jnp.int32)
    return place[..., 0] * NUM + place[..., 1]


def visits(data: Replay[Transition]) -> Array:
    """How many of the transitions held lead to each square, `[NUM ** 2]`."""
    square = square_of(data.rows.next_obs)
    held = jnp.arange(square.shape[0]) < data.size
    return jnp.zeros(NUM * NUM).at[square].add(held.astype(jnp.float32))


def rarity(own: Array, seen: Seen) -> Array:
    """1 / sqrt(visits) of the square that each transition leads to."""
    return jax.lax.rsqrt(jnp.maximum(own[square_of(seen.transitions.next_obs)], 1.0))


def along(obs: Array) -> Array:
    """How far along the corridor observations `[..., O]` are [m]: 0 in the middle of the first cell, 12 of the last."""
    x, y = (obs[..., i] for i in ant_maze.POSITION)
    first, middle, last = jnp.minimum(x, 4.0), 4.0 + y, 12.0 - x
    return jnp.where(y > 3.0, last, jnp.where((x > 3.0) & (y > 0.0), middle, first))


@reads()
def counts(sizes: Sizes, config: ExplorationConfig) -> Signal:
    """A signal: true visits."""

    def fit(own: Array, data: Replay[Transition], normalizers: Normalizers) -> tuple[Array, Metrics]:
        return visits(data), {}

    return Signal(rarity, "visits ** -0.5", init=lambda key: jnp.zeros(NUM * NUM), fit=fit)


@reads(lambda config, discrete=False: fields_read(static_belief, config))
def counts_beside_models(sizes: Sizes, config: ExplorationConfig) -> Signal:
    """The same signal, with static networks that imagine."""
    return counts(sizes, config)._replace(belief=static_belief(sizes, config))


@reads()
def distance(sizes: Sizes, config: ExplorationConfig) -> Signal:
    """A signal: metres along the corridor that a transition made."""

    def progress(own: Any, seen: Seen) -> Array:
        return along(seen.transitions.next_obs) - along(seen.transitions.obs)

    return Signal(progress, "m")


def step_acrobot(obs: Array, action: Array) -> Array:
    """Observations `[N, 6]` a step after `obs` under `action [N, 1]`, by the environment's own equations."""

    def one(obs: Array, action: Array) -> Array:
        state = jnp.stack([jnp.arctan2(obs[1], obs[0]), jnp.arctan2(obs[3], obs[2]), obs[4], obs[5]])
        return acrobot.observe(state, acrobot.advance(jax.random.key(0), state, action))

    return jax.vmap(one)(obs, action)


@reads("imagination", "sac")
def sac_in_the_acrobot(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """A behaviour: SAC in rollouts of the true acrobot.

    Raises:
        FieldError: the environment has other observations or actions.
    """
    if (sizes.obs, sizes.action) != (len(acrobot.SPEC.obs_names), len(acrobot.SPEC.action_names)):
        raise FieldError("env", f"one of {sizes.obs} observation entries", "acrobot", "cannot be simulated here")
    sac = make_sac(sizes.obs, sizes.action, config.sac)
    return make_imagination(signal, sac, sizes.obs, sizes.action, config.imagination, step=step_acrobot)


METHODS["oracle_counts"] = Method(
    "true visits of squares of 0.5 m as the reward, SAC on real transitions",
    counts,
    sac_on_real_data,
    actions="continuous",
)
METHODS["oracle_distance"] = Method(
    "metres along the corridor as the reward, SAC on real transitions",
    distance,
    sac_on_real_data,
    actions="continuous",
)
METHODS["oracle_counts_imagined"] = Method(
    "true visits of squares of 0.5 m as the reward, SAC in what static networks imagine",
    counts_beside_models,
    sac_in_imagination,
    actions="continuous",
    settings=in_imagination_alone,
)
METHODS["oracle_simulator"] = Method(
    "generator of models, variance reward, SAC in rollouts of the true acrobot",
    read_off(generator_belief, variance_reward),
    sac_in_the_acrobot,
    actions="continuous",
    settings=in_imagination_alone,
)
