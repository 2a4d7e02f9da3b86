"""The functions that a run calls: jitted, over all its seeds side by side, spread over the devices that there are.

All randomness follows from the seed, the purpose and the step, so a run that is resumed is the run that was never
interrupted.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs import coverage
from envs.base import Coverage, Environment
from envs.functional import all_finite
from envs.stepper import Stepper, make_stepper
from experiments.runs.codec import Allowances
from experiments.runs.config import RunConfig
from experiments.training.placement import Placement, place
from jaxplore.exploration import Actor, Explorer, ExplorerState
from jaxplore.types import Array, Key, Metrics, Transition

INIT, RESET, COLLECT, LEARN, EVALUATE = range(5)
"""What a key is for; folded into the seed's key before the step."""

OLDER = Allowances(
    {"alive": True, "episode_return": 0.0, "episode_length": 0, "explorer.frozen": False},
    ("positions", "episode_steps", *(f"explorer.data.rows.{name}" for name in Transition._fields)),
)
"""In what the `RunState` of an older checkpoint, or of a shorter run, differs."""


@struct.dataclass
class RunState:
    """All that a run carries; saved as it is. Leading axis `S` throughout."""

    explorer: ExplorerState
    env: Any
    """As the stepper has it."""
    visited: np.ndarray
    """Coverage cells seen, bool `[S, cells]`."""
    positions: np.ndarray
    """Where each step began, from above, `[S, steps, 2]` [m]; `[S, 0, 2]` without a floor plan."""
    episode_steps: np.ndarray
    """The step of its episode that each step was, int32 `[S, steps]`."""
    alive: np.ndarray
    """Whether a seed's numbers have been finite so far, bool `[S]`. One that is not alive stays as it was."""
    episode_return: np.ndarray
    """Rewards of the episode that is under way, float64 `[S]`."""
    episode_length: np.ndarray
    """Its steps, int32 `[S]`."""


class Programs(NamedTuple):
    """The functions of a run."""

    init: Callable[[], RunState]
    actors: Callable[[ExplorerState, bool], Actor]
    """`actors(explorer state, uniform) -> actors [S]`."""
    collect: Callable[[int, Any, Actor, int], tuple[Any, Transition, Array]]
    """`collect(step, env state, actors, num_steps) -> (env state, transitions [S, T], valid [S, T])`."""
    absorb: Callable[[ExplorerState, Transition, Array], ExplorerState]
    """Take transitions in; nothing is learned yet."""
    learn: Callable[..., tuple[ExplorerState, Metrics, dict[str, Array]]]
    """`learn(step, state, transitions, valid, obs, num_data, alive) -> (state, metrics, finite)`: assess transitions,
    take them in, and improve. `finite` says of each metric and each part of the state whether it is, `[S]`; a seed
    where one is not, or which is not alive, has the state that it had."""
    trace_init: Callable[[], ExplorerState]
    """The explorers' part of the first state, as shapes."""
    trace_learn: Callable[..., Any]
    """`trace_learn(state, (transitions, valid), obs, num_data, alive) -> jax.stages.Traced` of `learn`, which is then
    not traced again; shapes do."""
    mark: Callable[[np.ndarray, Array, Array], Array]
    """`mark(visited [S, cells], obs [S, T, O], valid [S, T]) -> visited`."""
    keys: Callable[[int, int], Key]
    """`keys(purpose, step) -> keys [S]`."""
    stepper: Stepper
    learning: Placement
    """Where the seeds learn."""
    stepping: Placement
    """Where they act and environments step: the same devices, or one if the environment is on the host."""


def make_programs(config: RunConfig, env: Environment, explorer: Explorer) -> Programs:
    """Build the functions of a run. Nothing is compiled yet."""
    seed_keys = jax.vmap(jax.random.key)(jnp.arange(config.seed, config.seed + config.num_seeds))
    keys = jax.jit(functools.partial(derive_keys, seed_keys))
    learning = place(config.num_seeds)
    stepping = learning if env.compiled else Placement()
    stepper = make_stepper(env, config.explorer.steps_per_round, explorer.act, stepping.spread)
    init_all = jax.jit(learning.spread(jax.vmap(explorer.init)))
    actors = jax.jit(learning.spread(jax.vmap(explorer.actor, in_axes=(0, None)), shared=(1,)))
    learn_spread = learning.spread(functools.partial(learn_side_by_side, explorer), shared=(4,))
    learn_all = jax.jit(learn_spread, donate_argnums=1)
    return Programs(
        init=functools.partial(init_state, config, env, init_all, stepper, keys),
        actors=actors if env.compiled else lambda *args: learning.gather(actors(*args)),
        collect=lambda step, *args: stepper.collect(keys(COLLECT, step), *args),
        absorb=jax.jit(learning.spread(jax.vmap(explorer.observe)), donate_argnums=0),
        learn=lambda step, state, transitions, valid, *rest: learn_all(
            keys(LEARN, step), state, (transitions, valid), *rest
        ),
        trace_init=lambda: jax.eval_shape(init_all, jax.eval_shape(keys, INIT, 0)),
        trace_learn=lambda *args: learn_all.trace(jax.eval_shape(keys, LEARN, 0), *args),
        mark=jax.jit(jax.vmap(functools.partial(mark_cells, env.coverage))),
        keys=keys,
        stepper=stepper,
        learning=learning,
        stepping=stepping,
    )


def derive_keys(seed_keys: Key, purpose: int, step: int) -> Key:
    """A key for each seed, `[S]`, that follows from the seed, the purpose and the step."""
    return jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, purpose), step))(seed_keys)


def init_state(
    config: RunConfig,
    env: Environment,
    init_all: Callable[[Key], ExplorerState],
    stepper: Stepper,
    keys: Callable[[int, int], Key],
) -> RunState:
    """The state that a run starts from."""
    num_seeds, steps = config.num_seeds, config.steps if env.floor_plan else 0
    return RunState(
        env=stepper.init(keys(RESET, 0)),
        explorer=init_all(keys(INIT, 0)),
        visited=np.zeros((num_seeds, env.coverage.num_cells), bool),
        positions=np.zeros((num_seeds, steps, 2), np.float32),
        episode_steps=np.zeros((num_seeds, steps), np.int32),
        alive=np.ones(num_seeds, bool),
        episode_return=np.zeros(num_seeds, np.float64),
        episode_length=np.zeros(num_seeds, np.int32),
    )


def learn_round(
    explorer: Explorer,
    key: Key,
    state: ExplorerState,
    rows: tuple[Transition, Array],
    obs: Array,
    num_data: Array,
    alive: Array,
) -> tuple[ExplorerState, Metrics, dict[str, Array]]:
    """One seed's round: assess its transitions and their validity (`rows`), take them in, improve. If it does not come
    out finite, or is not alive, it keeps the state that it had.
    """
    assess_key, improve_key = jax.random.split(key)
    seen = explorer.assess(assess_key, state, *rows)
    after, metrics = explorer.improve(improve_key, explorer.observe(state, *rows), obs, num_data)
    # The state too: what the last update of a round broke would show in the next round's metrics only.
    parts = {name: getattr(after, name) for name in ("belief", "signal", "behaviour", "normalizers")}
    finite = {name: jnp.isfinite(value) for name, value in metrics.items()}
    finite |= {f"the state of the {name}": all_finite(part) for name, part in parts.items()}
    good = jnp.all(jnp.stack(list(finite.values()))) & alive
    # Of the replay only how far it reaches: to choose between its rows would be to copy all of them in each round, and
    # what it does not hold nobody reads. It holds all steps of a run, so that none was written over.
    chosen = jax.tree.map(lambda new, old: jnp.where(good, new, old), _without_rows(after), _without_rows(state))
    data = dataclasses.replace(chosen.data, rows=after.data.rows)
    return dataclasses.replace(chosen, data=data), {**seen, **metrics}, finite


def _without_rows(state: ExplorerState) -> ExplorerState:
    return dataclasses.replace(state, data=dataclasses.replace(state.data, rows=None))


def learn_side_by_side(
    explorer: Explorer,
    keys: Key,
    state: ExplorerState,
    rows: tuple[Transition, Array],
    obs: Array,
    num_data: Array,
    alive: Array,
) -> tuple[ExplorerState, Metrics, dict[str, Array]]:
    """`learn_round` of each seed."""
    learn = functools.partial(learn_round, explorer)
    if alive.shape[0] == 1:
        # Not under `vmap`: with an axis more, if only of 1, XLA on CPUs turns matrices that could lie as they are.
        own_key, own_state, own_rows, own_obs, own_alive = jax.tree.map(
            lambda leaf: leaf[0], (keys, state, rows, obs, alive)
        )
        only = learn(own_key, own_state, own_rows, own_obs, num_data, own_alive)
        return jax.tree.map(lambda leaf: leaf[None], only)
    return jax.vmap(learn, in_axes=(0, 0, 0, 0, None, 0))(keys, state, rows, obs, num_data, alive)


def mark_cells(cells: Coverage, visited: Array, obs: Array, valid: Array) -> Array:
    """`visited [cells]` with the cells of the observations `[T, O]` marked where `valid [T]` is set."""
    return coverage.update(visited, jnp.where(valid, jax.vmap(cells.cell)(obs), -1))
