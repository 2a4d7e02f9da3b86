"""What a round of each method costs, with the Ant maze's sizes and the laptop's settings."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.kernels import ACTION, OBS, random_data
from benchmarks.result import Result, make_result
from benchmarks.timing import measure_chain
from experiments.runs.presets import preset_config
from jaxplore import METHODS, Sizes, make_explorer

ROUNDS = 6
"""Rounds of 25 steps timed in one: PPO learns once in 128 steps, so not in each."""


def methods() -> Iterator[Result]:
    """What a round of each method costs."""
    for name in METHODS:
        yield method_round(name)


def method_round(name: str, num_data: int = 2_560) -> Result:
    """A laptop round of one method with `num_data` transitions held: take 25 in, fit, imagine, improve."""
    method, config = METHODS[name], preset_config("laptop", method=name).explorer
    sizes = Sizes(OBS, ACTION, discrete=method.actions == "discrete", has_reward=True)
    explorer = make_explorer(method, sizes, config)
    data = random_data(num_data, num_data).rows
    chunk = jax.tree.map(lambda leaf: leaf[: config.steps_per_round], data)
    obs, came, held = jnp.zeros((1, OBS)), jnp.ones(config.steps_per_round, bool), jnp.ones(num_data, bool)

    def one(key: jax.Array, state: Any, obs: jax.Array) -> Any:
        return explorer.improve(key, explorer.observe(state, chunk, came), obs, jnp.int32(num_data))[0]

    # One seed under vmap and each round waited for, as a run does it.
    learn = jax.jit(jax.vmap(one), donate_argnums=1)

    def rounds(state: Any) -> Any:
        for i in range(ROUNDS):
            state = jax.block_until_ready(learn(jax.random.split(jax.random.key(i), 1), state, obs))
        return state

    def begin(key: jax.Array) -> Any:
        return explorer.observe(explorer.init(key), data, held)

    start = jax.block_until_ready(jax.jit(jax.vmap(begin))(jax.random.split(jax.random.key(0), 1)))
    timing = measure_chain(rounds, start, inner=ROUNDS, repeats=2)
    return make_result(f"round, {name}", f"laptop, N = {num_data:,}", timing)
