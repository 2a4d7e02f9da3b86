"""A run: environments step, the explorer learns, everything is logged; on one or several seeds side by side.

The explorer is one jitted program over all seeds. Environments on the device are stepped by another; for those on the
host all seeds act in one. All randomness follows from the seed and the step, so a run that is resumed is the run
that was never interrupted.
"""

import dataclasses
import inspect
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

import envs
from envs import coverage
from envs.base import Environment
from envs.functional import all_finite
from envs.wrappers import Collect, make_collect, make_collect_all, reset_all
from envs.wrappers import CollectAll as HostCollect
from experiments.checkpoint import Checkpoints
from experiments.config import RunConfig, from_json
from experiments.errors import RunError, disk_error
from experiments.log import MetricsLog, Progress, Row, TensorBoardLog
from jaxplore.exploration import Explorer, ExplorerState, make_explorer
from jaxplore.methods import Sizes, get_method
from jaxplore.types import Array, Key, Metrics, Transition

INIT, RESET, COLLECT, LEARN = range(4)
"""What a key is for; folded into the seed's key before the step."""

WALK = "walk.npz"
"""Where each step began: `positions [S, steps, 2]` [m] and `episode_steps [S, steps]`."""


@struct.dataclass
class RunState:
    """All that a run carries; saved as it is. Leading axis `S` throughout."""

    explorer: ExplorerState
    env: Any
    """Compiled environments: one `EnvState` with a leading axis. Others: a tuple of states."""
    visited: np.ndarray
    """Coverage cells seen, bool `[S, cells]`."""
    positions: np.ndarray
    """Where each step began, from above, `[S, steps, 2]` [m]; `[S, 0, 2]` without a floor plan."""
    episode_steps: np.ndarray
    """The step of its episode that each step was, int32 `[S, steps]`."""


class Programs(NamedTuple):
    """The functions a run calls, jitted but for the environment on a host."""

    init: Callable[[], RunState]
    collect: Callable[[RunState, int, int, bool], tuple[Any, Transition, Array]]
    """`collect(state, step, num_steps, uniform) -> (env, transitions [S, T], valid [S, T])`."""
    absorb: Callable[..., ExplorerState]
    """Take transitions in; nothing is learned yet."""
    learn: Callable[..., tuple[ExplorerState, Metrics, dict[str, Array]]]
    """`learn(step, state, transitions, valid, obs, num_data) -> (state, metrics, finite)`: assess transitions, take
    them in, and improve. `finite` says of each metric and each part of the state whether it is, `[S]`; where one is
    not, the state is as it was, of all seeds."""
    mark: Callable[[np.ndarray, Array, Array], Array]
    """`mark(visited [S, cells], obs [S, T, O], valid [S, T]) -> visited`."""


def make_environment(config: RunConfig) -> Environment:
    """The environment that a configuration names.

    One that draws something of its own once and for all, such as the chain's flip-states, draws it from the run's first
    seed: seeds carried side by side share it.
    """
    own = {"seed": config.seed} if "seed" in inspect.signature(envs.find_factory(config.env)).parameters else {}
    env = envs.make(config.env, backend=config.backend, obs_noise=config.obs_noise, **own)
    if config.coverage_dims:
        env = dataclasses.replace(env, coverage=coverage.make_entries_coverage(env.spec, config.coverage_dims))
    return env


def on_host(config: RunConfig, env: Environment) -> Environment:
    """The same environment with its physics on the host, where it has the choice: there nothing is compiled."""
    if env.backend != "mjx" or config.env not in envs.FACTORIES:
        return env
    return make_environment(dataclasses.replace(config, backend="mujoco"))


def make_run_explorer(config: RunConfig, env: Environment) -> Explorer:
    """The explorer that a configuration names, for its environment."""
    return make_explorer(get_method(config.method), sizes_of(env), config.explorer)


def sizes_of(env: Environment) -> Sizes:
    """What a method must know of an environment."""
    spec = env.spec
    return Sizes(spec.obs_size, spec.action_size, spec.discrete, spec.one_hot_obs, spec.has_reward)


def make_programs(config: RunConfig, env: Environment, explorer: Explorer) -> Programs:
    """Build the functions of a run. Nothing is compiled yet."""
    capacity = config.explorer.steps_per_round
    seeds = jnp.arange(config.seed, config.seed + config.num_seeds)
    seed_keys = jax.vmap(jax.random.key)(seeds)

    def act(key: Key, actor: Any, obs: Array, uniform: Array) -> Array:
        return jnp.where(uniform, explorer.act_uniformly(key, obs), explorer.act(key, actor, obs))

    @jax.jit
    def keys(purpose: int, step: int) -> Key:
        return jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, purpose), step))(seed_keys)

    def init() -> RunState:
        reset_keys = keys(RESET, 0)
        env_state = jax.jit(jax.vmap(env.reset))(reset_keys) if env.compiled else reset_all(env, reset_keys)
        steps = config.steps if env.floor_plan else 0
        return RunState(
            explorer=jax.jit(jax.vmap(explorer.init))(keys(INIT, 0)),
            env=env_state,
            visited=np.zeros((config.num_seeds, env.coverage.num_cells), bool),
            positions=np.zeros((config.num_seeds, steps, 2), np.float32),
            episode_steps=np.zeros((config.num_seeds, steps), np.int32),
        )

    actors = jax.jit(jax.vmap(explorer.actor))

    if env.compiled:
        collect_all = _collect_on_device(make_collect(env, capacity), act)
    else:
        collect_all = _collect_on_host(make_collect_all(env, capacity), act)

    def collect(state: RunState, step: int, num_steps: int, uniform: bool) -> tuple[Any, Transition, Array]:
        return collect_all(keys(COLLECT, step), state.env, actors(state.explorer), num_steps, uniform)

    def learn(key: Key, state: ExplorerState, transitions: Transition, valid: Array, obs: Array, num_data: Array):
        assess_key, improve_key = jax.random.split(key)
        seen = explorer.assess(assess_key, state, transitions, valid)
        after, metrics = explorer.improve(improve_key, explorer.observe(state, transitions, valid), obs, num_data)
        # The state too: what the last update of a round broke would show in the next round's metrics only.
        parts = {"belief": after.belief, "behaviour": after.behaviour, "normalizers": after.normalizers}
        finite = {name: jnp.isfinite(value) for name, value in metrics.items()}
        finite |= {f"the state of the {name}": all_finite(part) for name, part in parts.items()}
        return after, {**seen, **metrics}, finite

    def learn_all(keys: Key, state: ExplorerState, transitions: Transition, valid: Array, obs: Array, num_data: Array):
        one = jax.vmap(learn, in_axes=(0, 0, 0, 0, 0, None))
        after, metrics, finite = one(keys, state, transitions, valid, obs, num_data)
        good = jnp.all(jnp.stack(list(finite.values())))
        return jax.tree.map(lambda new, old: jnp.where(good, new, old), after, state), metrics, finite

    learn_all = jax.jit(learn_all, donate_argnums=1)

    def mark_one(visited: Array, obs: Array, valid: Array) -> Array:
        return coverage.update(visited, jnp.where(valid, jax.vmap(env.coverage.cell)(obs), -1))

    return Programs(
        init=init,
        collect=collect,
        absorb=jax.jit(jax.vmap(explorer.observe), donate_argnums=0),
        learn=lambda step, *args: learn_all(keys(LEARN, step), *args),
        mark=jax.jit(jax.vmap(mark_one)),
    )


CollectAll: TypeAlias = Callable[[Key, Any, Any, int, bool], tuple[Any, Transition, Array]]
"""`(keys [S], env_state, actors [S], num_steps, uniform) -> (env_state, transitions [S, T], valid [S, T])`."""


def _collect_on_device(collect: Collect, act: Callable[..., Array]) -> CollectAll:
    """All seeds at once, in one program whatever `num_steps` and `uniform` are."""

    @jax.jit
    def collect_all(keys: Key, env_state: Any, actors: Any, num_steps: int, uniform: bool):
        def one(key: Key, env_state: Any, actor: Any):
            return collect(key, env_state, lambda k, obs: act(k, actor, obs, uniform), num_steps)

        return jax.vmap(one)(keys, env_state, actors)

    return collect_all


def _collect_on_host(collect: HostCollect, act: Callable[..., Array]) -> CollectAll:
    """All seeds act in one program a step; the environments are stepped in Python."""

    @jax.jit
    def act_all(actors: Any, uniform: bool, keys: Key, obs: Array) -> tuple[Key, Array, Key]:
        def one(args: tuple[Any, Key, Array]) -> tuple[Key, Array, Key]:
            actor, key, obs = args
            key, act_key, reset_key = jax.random.split(key, 3)
            return key, act(act_key, actor, obs, uniform), reset_key

        # Not vmap: a product of a batch of matrices rounds otherwise than that of one, and a seed's run beside others
        # is to be its run alone.
        return jax.lax.map(one, (actors, keys, obs))

    def collect_all(keys: Key, env_state: Any, actors: Any, num_steps: int, uniform: bool):
        return collect(keys, env_state, lambda keys, obs: act_all(actors, uniform, keys, obs), num_steps)

    return collect_all


def current_obs(env: Environment, env_state: Any) -> Array | np.ndarray:
    """What the agents see now, `[S, O]`."""
    return env_state.obs if env.compiled else np.stack([state.obs for state in env_state])


def rounds(config: RunConfig, start: int) -> Iterator[tuple[int, int]]:
    """The steps `(first, end)` of each round from `start` on: at most `steps_per_round` long, ending with the warm-up,
    then at each multiple of `steps_per_round`, and with the run.
    """
    length, warm_up = config.explorer.steps_per_round, config.explorer.warm_up_steps
    while start < config.steps:
        end = min(warm_up, start + length) if start < warm_up else (start // length + 1) * length
        end = min(end, config.steps)
        yield start, end
        start = end


def run(config: RunConfig, out: Path, *, env: Environment | None = None, resume: bool = False) -> RunState:
    """Carry out a run, from its latest checkpoint if `resume`, and write its metrics, checkpoints and walk to `out`.

    Args:
        config: what to run.
        out: the run's directory.
        env: the environment, if the caller has made it already.
        resume: whether to go on from the latest checkpoint; without one the run starts over.

    Returns:
        The last state.

    Raises:
        RunError: the disk fails, a checkpoint does not fit, or numbers stop being finite. The latest checkpoint is
            then whole.
    """
    env = env or make_environment(config)
    programs = make_programs(config, env, make_run_explorer(config, env))
    checkpoints = Checkpoints(out / "checkpoints")
    metrics = MetricsLog(out / "metrics.jsonl")
    state, step, earlier = programs.init(), 0, 0.0
    restored = checkpoints.restore_latest(state) if resume else None
    if restored is not None:
        step, state, earlier = restored.step, restored.state, restored.meta["wall_time"]
    last = step if restored is not None else -1
    metrics.truncate_after(last)
    board = TensorBoardLog(out / "tensorboard", num_seeds=config.num_seeds, after_step=last if resume else None)
    progress = Progress(config.steps, start_step=step, num_cells=env.coverage.num_cells)
    if resume:
        progress.say(f"Going on from step {step:,}" if restored else "There is no checkpoint yet: starting over")
    try:
        state = _carry_on(config, out, env, programs, state, step, earlier, checkpoints, metrics, board, progress)
    finally:
        progress.close()
        metrics.close()
        board.close()
    _write_walk(out, state)
    return state


def _write_walk(out: Path, state: RunState) -> None:
    """The last file of a run, whole or not at all: it being there says that the run is finished."""
    draft = out / f"{WALK}.tmp"
    try:
        with draft.open("wb") as file:
            np.savez_compressed(file, positions=state.positions, episode_steps=state.episode_steps)
        draft.replace(out / WALK)
    except OSError as error:
        raise disk_error("write the walk", out, error, "finish with --resume") from error


def read_config(out: Path) -> RunConfig:
    """The configuration of the run in `out`.

    Raises:
        RunError: there is no run.
        ValueError: its configuration is not one.
    """
    path = out / "config.json"
    try:
        return from_json(path.read_text(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RunError(f"{out} holds no run: cannot read {path} ({reason}).") from error


def last_state(
    out: Path, config: RunConfig, env: Environment, explorer: Explorer, until: int | None = None
) -> tuple[RunState, int]:
    """The state in the latest checkpoint of the run in `out`, up to the step `until` if that is given, and its step.

    Raises:
        RunError: there is no such checkpoint, or none that fits the configuration.
    """
    init, checkpoints = make_programs(config, env, explorer).init, Checkpoints(out / "checkpoints")
    restored = checkpoints.restore_latest(jax.eval_shape(init) if env.compiled else init(), until)
    if restored is None and checkpoints.steps():
        raise RunError(f"{out} has no checkpoint up to step {until}, only of {checkpoints.steps()}.")
    if restored is None:
        raise RunError(f"{out} has no checkpoint yet: let the run go on for {config.checkpoint_every:,} steps.")
    return restored.state, restored.step


def is_finished(out: Path) -> bool:
    """Whether the run in `out` has taken all its steps."""
    return (out / WALK).is_file()


def _carry_on(
    config: RunConfig,
    out: Path,
    env: Environment,
    programs: Programs,
    state: RunState,
    step: int,
    earlier: float,
    checkpoints: Checkpoints,
    metrics: MetricsLog,
    board: TensorBoardLog,
    progress: Progress,
) -> RunState:
    """The rounds from `step` on; `earlier` are the seconds already spent."""
    began = time.monotonic() - earlier
    told: set[str] = set()

    def tell(what: str) -> None:
        if what not in told:
            told.add(what)
            progress.say(f"Compiling the {what} step: up to a minute the first time, seconds from the cache later")

    # Positions are written in place; a restored array may be read-only.
    state = dataclasses.replace(
        state,
        visited=np.array(jax.device_get(state.visited)),
        positions=np.array(state.positions),
        episode_steps=np.array(state.episode_steps),
    )
    for first, end in rounds(config, step):
        round_began = time.monotonic()
        before = state.env
        if env.compiled:
            tell("environment")
        episode_step = _episode_step(env, before)
        env_state, transitions, valid = programs.collect(
            state, first, end - first, first < config.explorer.warm_up_steps
        )
        if end < config.explorer.warm_up_steps:
            told_metrics, finite = {}, {}
            learned = programs.absorb(state.explorer, transitions, valid)
        else:
            tell("learning")
            learned, told_metrics, finite = programs.learn(
                first, state.explorer, transitions, valid, current_obs(env, env_state), end
            )
        told_metrics, finite = jax.device_get((told_metrics, finite))
        if not all(map(np.all, finite.values())):
            metrics.sync()
            checkpoints.save(
                first, dataclasses.replace(state, explorer=learned), {"wall_time": time.monotonic() - began}
            )
            raise _diverged(finite, config, first, end, out)
        transitions, valid = jax.device_get((transitions, valid))
        _remember(env, programs, state, transitions, valid, episode_step, first, end)
        state = dataclasses.replace(state, explorer=learned, env=env_state)
        now = time.monotonic()
        dropped = end - first - valid.sum(axis=1)
        rows = _rows(config, state, told_metrics, dropped, end, now - began, (end - first) / (now - round_began))
        metrics.append(rows)
        board.append(rows)
        progress.update(end, rows)
        if end // config.checkpoint_every > first // config.checkpoint_every or end == config.steps:
            metrics.sync()
            checkpoints.save(end, state, {"wall_time": time.monotonic() - began})
    return state


def _episode_step(env: Environment, env_state: Any) -> np.ndarray:
    """The step of its episode that each seed's next step is, `[S]`."""
    return jax.device_get(env_state.num_steps) if env.compiled else np.array([state.num_steps for state in env_state])


def _remember(
    env: Environment,
    programs: Programs,
    state: RunState,
    transitions: Transition,
    valid: Array,
    episode_step: np.ndarray,
    first: int,
    end: int,
) -> None:
    """Note in `state`, in place, which cells the round saw and where it went."""
    count = end - first
    obs = transitions.obs[:, :count]
    # device_get, here and elsewhere: NumPy itself would wait for the result with Python's lock held, and hang.
    state.visited[:] = jax.device_get(programs.mark(state.visited, transitions.obs, valid))
    if env.floor_plan is None:
        return
    state.positions[:, first:end] = obs[..., list(env.floor_plan.position)]
    done = transitions.terminated | transitions.truncated
    for t in range(count):
        state.episode_steps[:, first + t] = episode_step
        episode_step = np.where(done[:, t], 0, episode_step + 1)


def _rows(
    config: RunConfig, state: RunState, metrics: Metrics, dropped: Array, step: int, wall_time: float, speed: float
) -> list[Row]:
    """The round's rows, one per seed; `dropped` `[S]` counts the steps whose physics diverged, which are no data."""
    rows = []
    for i in range(config.num_seeds):
        cells = int(np.sum(state.visited[i]))
        rows.append(
            {
                "step": step,
                "seed": config.seed + i,
                "coverage": cells / state.visited.shape[1],
                "cells": cells,
                "dropped": int(dropped[i]),
                **{name: values[i] for name, values in metrics.items()},
                "wall_time": round(wall_time, 3),
                "steps_per_second": round(speed, 3),
            }
        )
    return rows


def _diverged(finite: dict[str, Array], config: RunConfig, first: int, end: int, out: Path) -> RunError:
    """What to say of numbers that are not finite."""
    names = [name for name, values in finite.items() if not np.all(values)]
    seeds = [config.seed + i for i in range(config.num_seeds) if not all(values[i] for values in finite.values())]
    return RunError(
        f"the round of steps {first:,} to {end:,} came out with numbers that are not finite: {', '.join(names)} "
        f"(seed {', '.join(map(str, seeds))}). The state before it is saved in {out / 'checkpoints'}. What to do: "
        "--resume would repeat this round to the bit, so start again in a new --out with a smaller --fit.lr or "
        "--sac.lr, or with --imagination.bound set."
    )
