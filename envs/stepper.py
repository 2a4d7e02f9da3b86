"""Acting: some steps of an environment, episode after episode, alone or with several seeds side by side.

The only place that asks whether an environment is compiled. What a run needs is a `Stepper`; what acts with one
environment outside of runs needs `make_walk` or `prepared`.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment, EnvState
from envs.errors import EnvironmentFault, raised, shape_of
from jaxplore import validate
from jaxplore.types import Array, Key, Transition
from jaxplore.validate import FieldError

Act: TypeAlias = Callable[[Key, Array], Array]
"""`act(key, obs [O]) -> action [A]`."""

Collect: TypeAlias = Callable[[Key, EnvState, Act, int], tuple[EnvState, Transition, Array]]
"""`collect(key, env_state, act, num_steps) -> (env_state, transitions [capacity], valid [capacity])`."""


def make_collect(env: Environment, capacity: int) -> Collect:
    """A function that steps `env` and resets it after each episode, when `terminated` or `truncated` is set.

    A reset is never a transition: the last `next_obs` of an episode is its true successor, and the next transition's
    `obs` is the first observation of the new episode. The state that comes back is ready to be stepped.

    For a compiled environment `collect` is pure: `jit` it with `act` static, `vmap` it over keys and states;
    `num_steps` may be traced, so that one program serves rounds of any length. For one on the host it is a Python loop
    and returns NumPy arrays. Both use the key alike: each step splits it in three, one to continue with, one for `act`
    and one for the reset that may follow.

    Args:
        env: the environment.
        capacity: rows that `collect` returns; `num_steps` of them are steps, the others zeros.

    Returns:
        `collect`. `valid` marks the rows that are steps with finite observations and rewards: physics that diverges
        leaves a row that is none. On the host `collect` raises `FieldError` for `num_steps` outside 1 to `capacity`.

    Raises:
        FieldError: `capacity` below 1.
    """
    validate.at_least("capacity", capacity, 1)
    return functools.partial(_collect_compiled if env.compiled else _collect_host, env, capacity)


def _collect_compiled(
    env: Environment, capacity: int, key: Key, env_state: EnvState, act: Act, num_steps: int | Array
) -> tuple[EnvState, Transition, Array]:
    def one_step(t: Array, carry: tuple[Key, EnvState, Transition]) -> tuple[Key, EnvState, Transition]:
        key, state, rows = carry
        key, act_key, reset_key = jax.random.split(key, 3)
        after, transition = env.step(state, act(act_key, state.obs))
        done = transition.terminated | transition.truncated
        state = jax.lax.cond(done, lambda: env.reset(reset_key), lambda: after)
        return key, state, jax.tree.map(lambda buffer, leaf: buffer.at[t].set(leaf), rows, transition)

    shapes = jax.eval_shape(lambda: env.step(env_state, act(key, env_state.obs))[1])
    rows = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), shapes)
    _, env_state, rows = jax.lax.fori_loop(0, num_steps, one_step, (key, env_state, rows))
    finite = jnp.all(jnp.isfinite(rows.obs) & jnp.isfinite(rows.next_obs), axis=-1) & jnp.isfinite(rows.reward)
    return env_state, rows, finite & (jnp.arange(capacity) < num_steps)


def _collect_host(
    env: Environment, capacity: int, key: Key, env_state: EnvState, act: Act, num_steps: int
) -> tuple[EnvState, Transition, Array]:
    def act_all(key: Key, obs: np.ndarray) -> tuple[Key, Array, Key]:
        key, act_key, reset_key = _split(key)
        return key, act(act_key, obs[0])[None], reset_key[None]

    states, rows, valid = make_collect_all(env, capacity)(key, (env_state,), act_all, num_steps)
    return states[0], jax.tree.map(lambda leaf: leaf[0], rows), valid[0]


@jax.jit
def _split(key: Key) -> tuple[Key, Key, Key]:
    key, act_key, reset_key = jax.random.split(key, 3)
    return key, act_key, reset_key


ActAll: TypeAlias = Callable[[Key, np.ndarray], tuple[Key, Array, Key]]
"""`act_all(keys [S], obs [S, O]) -> (keys [S], actions [S, A], reset_keys [S])`: each key is split in three, one to
continue with, one for `act` and one for the reset that may follow."""

CollectAll: TypeAlias = Callable[[Key, tuple[EnvState, ...], ActAll, int], tuple[tuple[EnvState, ...], Transition, Any]]
"""`collect(keys [S], states, act_all, num_steps) -> (states, transitions [S, capacity], valid [S, capacity])`."""


def make_collect_all(env: Environment, capacity: int) -> CollectAll:
    """`make_collect` on the host for several seeds side by side: each step is one call of `act_all` and one of the
    environment's `step_all`, if it has that. Each seed's numbers are those of `make_collect` with its key alone.

    Args:
        env: an environment that is not compiled.
        capacity: rows that `collect` returns; `num_steps` of them are steps, the others zeros.

    Returns:
        `collect`. It raises `FieldError` for `num_steps` outside 1 to `capacity`.

    Raises:
        FieldError: `capacity` below 1.
    """
    validate.at_least("capacity", capacity, 1)
    return functools.partial(_collect_side_by_side, env, capacity)


def _collect_side_by_side(
    env: Environment, capacity: int, keys: Key, states: tuple[EnvState, ...], act_all: ActAll, num_steps: int
) -> tuple[tuple[EnvState, ...], Transition, Any]:
    if not 1 <= num_steps <= capacity:
        raise FieldError("num_steps", num_steps, f"1 to {capacity}", "is out of range")
    transitions = []
    for _ in range(num_steps):
        keys, actions, reset_keys = act_all(keys, _stack_obs(states))
        states, transition = step_all(env, states, jax.device_get(actions))
        transitions.append(transition)
        done = np.flatnonzero(transition.terminated | transition.truncated).tolist()
        if done:
            fresh = dict(zip(done, reset_all(env, reset_keys[np.array(done)]), strict=True))
            states = tuple(fresh.get(i, state) for i, state in enumerate(states))
    transitions += [jax.tree.map(np.zeros_like, transitions[-1])] * (capacity - num_steps)
    rows = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *transitions)
    finite = np.all(np.isfinite(rows.obs) & np.isfinite(rows.next_obs), axis=-1) & np.isfinite(rows.reward)
    return states, rows, finite & (np.arange(capacity) < num_steps)


def _stack_obs(states: tuple[EnvState, ...]) -> np.ndarray:
    return np.stack([state.obs for state in states])


def reset_all(env: Environment, keys: Key) -> tuple[EnvState, ...]:
    """`env.reset` of each key in `keys` `[S]`, of an environment on the host."""
    return env.reset_all(keys) if env.reset_all else tuple(env.reset(key) for key in keys)


def step_all(
    env: Environment, states: tuple[EnvState, ...], actions: np.ndarray
) -> tuple[tuple[EnvState, ...], Transition]:
    """`env.step` of each state with its row of `actions` `[S, A]`, of an environment on the host."""
    if env.step_all:
        return env.step_all(states, actions)
    after, transitions = zip(*map(env.step, states, actions), strict=True)
    return after, jax.tree.map(lambda *leaves: np.stack(leaves), *transitions)


def make_walk(env: Environment, capacity: int) -> Collect:
    """`make_collect`, ready to be called: jitted where `env` is compiled, one program for each `act` and `num_steps`.

    For acting with one environment outside of runs. Arguments and errors are those of `make_collect`.
    """
    collect = make_collect(env, capacity)
    return jax.jit(collect, static_argnums=(2, 3)) if env.compiled else collect


def prepared(env: Environment) -> Environment:
    """The same environment, ready to be called from Python: `reset` and `step` are jitted where it is compiled."""
    return dataclasses.replace(env, reset=jax.jit(env.reset), step=jax.jit(env.step)) if env.compiled else env


ActAs: TypeAlias = Callable[[Key, Any, Array], Array]
"""`act(key, actor, obs [O]) -> action [A]`; the actor says how it acts."""


Spread: TypeAlias = Callable[..., Callable[..., Any]]
"""`spread(function, shared=()) -> function`: the same, with arguments `[S, ...]` but for those in the places `shared`,
computed where the caller wants it."""


class Stepper(NamedTuple):
    """Copies of one environment, `S` of them, stepped side by side by an actor each."""

    init: Callable[[Key], Any]
    """`init(keys [S]) -> env_state`: on the device one `EnvState` with a leading axis, on the host a tuple of them."""
    collect: Callable[[Key, Any, Any, int], tuple[Any, Transition, Array]]
    """`collect(keys [S], env_state, actors [S], num_steps) -> (env_state, transitions [S, capacity], valid [S,
    capacity])`, of each what `make_collect` gives."""
    obs: Callable[[Any], Array | np.ndarray]
    """`obs(env_state) -> [S, O]`: what the agents see now."""
    episode_step: Callable[[Any], np.ndarray]
    """`episode_step(env_state) -> [S]`: the step of its episode, from 0, that each agent's next step is."""
    compiles: bool
    """Whether the first `collect` compiles a program of the environment's own."""
    abstract: Callable[[Callable[[], Any]], Any]
    """`abstract(init) -> state`: what to restore a saved `init()` into, without computing it where that is possible."""


def nowhere_else(function: Callable[..., Any], shared: Collection[int] = ()) -> Callable[..., Any]:
    """`Spread` on one device: the function itself."""
    return function


def make_stepper(env: Environment, capacity: int, act: ActAs, spread: Spread = nowhere_else) -> Stepper:
    """What a run needs of its environment, on the device or on the host. Nothing is compiled yet.

    On the device, all steps of all agents are one program, whatever `num_steps` is. On the host, all agents act in one
    program a step, and the environments are stepped in Python.

    Args:
        env: the environment.
        capacity: rows that `collect` returns; `num_steps` of them are steps, the others zeros.
        act: how an actor chooses its action.
        spread: how programs on the device are spread over several of them.

    Returns:
        A `Stepper`. Each agent's numbers are those that it would have alone, but on the device for rounding: there a
        product of a batch of matrices may round otherwise than that of one.

    Raises:
        FieldError: `capacity` below 1.
    """
    env = _checked(env)
    if env.compiled:
        return Stepper(
            init=jax.jit(spread(jax.vmap(env.reset))),
            collect=jax.jit(
                spread(functools.partial(_collect_on_device, make_collect(env, capacity), act), shared=(3,))
            ),
            obs=lambda env_state: env_state.obs,
            episode_step=lambda env_state: jax.device_get(env_state.num_steps),
            compiles=True,
            abstract=jax.eval_shape,
        )
    act_all = jax.jit(functools.partial(_act_all, act))
    return Stepper(
        init=functools.partial(reset_all, env),
        collect=functools.partial(_collect_on_host, make_collect_all(env, capacity), act_all),
        obs=_stack_obs,
        episode_step=lambda env_state: np.array([state.num_steps for state in env_state]),
        compiles=False,
        abstract=lambda init: init(),
    )


def _checked(env: Environment) -> Environment:
    """The same environment; what its functions raise, and shapes that are not its spec's, come as `EnvironmentFault`.

    On the device that happens when it is traced, and costs nothing when it is run. On the host, so do numbers that are
    not finite where nothing has diverged: at a reset, or as the reward of a step that is well.
    """
    reset, step = (functools.partial(function, env) for function in (_checked_reset, _checked_step))
    return dataclasses.replace(env, reset=reset, step=step)


def _checked_reset(env: Environment, key: Key) -> EnvState:
    state = _call(env, "reset", "an EnvState", env.reset, key)
    _check_shape(env, "reset", "an observation", getattr(state, "obs", None), env.spec.obs_size)
    if not env.compiled and not np.isfinite(jax.device_get(state.obs)).all():
        what = "returned an observation with numbers that are not finite"
        raise EnvironmentFault(env.spec.name, "reset", what, "finite numbers")
    return state


def _checked_step(env: Environment, state: EnvState, action: Array) -> tuple[EnvState, Transition]:
    expected = "an EnvState and a Transition"
    found = _call(env, "step", expected, env.step, state, action)
    if not isinstance(found, tuple) or len(found) != 2:
        what = f"{len(found)} values" if isinstance(found, tuple) else type(found).__name__
        raise EnvironmentFault(env.spec.name, "step", f"returned {what}", expected)
    after, transition = found
    if not isinstance(transition, Transition):
        what = f"{type(after).__name__} and {type(transition).__name__}"
        raise EnvironmentFault(env.spec.name, "step", f"returned {what}", expected)
    _check_shape(env, "step", "an observation", transition.next_obs, env.spec.obs_size)
    for name in ("reward", "terminated", "truncated"):
        _check_shape(env, "step", f"`{name}`", getattr(transition, name))
    if not env.compiled:
        _check_reward(env, transition)
    return after, transition


def _call(env: Environment, when: str, expected: str, function: Callable[..., Any], *args: Any) -> Any:
    try:
        return function(*args)
    except (EnvironmentFault, FieldError):
        raise
    except Exception as error:  # A function of anybody's raises anything.
        raise EnvironmentFault(env.spec.name, when, raised(error), expected) from error


def _check_shape(env: Environment, when: str, what: str, value: Any, *shape: int) -> None:
    if np.shape(value) != shape:
        entries = "an entry for each of the spec's obs_names" if shape else "one number"
        expected = f"shape {shape}, {entries}"
        raise EnvironmentFault(env.spec.name, when, f"returned {what} of {shape_of(value)}", expected)


def _check_reward(env: Environment, transition: Transition) -> None:
    # device_get: NumPy itself would wait for an array with Python's lock held, and hang.
    reward = jax.device_get(transition.reward)
    if np.isfinite(reward) or jax.device_get(transition.terminated):
        return
    if np.isfinite(jax.device_get(transition.next_obs)).all():
        raise EnvironmentFault(env.spec.name, "step", f"returned the reward {float(reward)}", "a finite number")


def _collect_on_device(
    collect: Collect, act: ActAs, keys: Key, env_state: EnvState, actors: Any, num_steps: int
) -> tuple[EnvState, Transition, Array]:
    def one(key: Key, env_state: EnvState, actor: Any) -> tuple[EnvState, Transition, Array]:
        return collect(key, env_state, lambda act_key, obs: act(act_key, actor, obs), num_steps)

    return jax.vmap(one)(keys, env_state, actors)


def _collect_on_host(
    collect: CollectAll,
    act_all: Callable[[Any, Key, np.ndarray], tuple[Key, Array, Key]],
    keys: Key,
    env_state: tuple[EnvState, ...],
    actors: Any,
    num_steps: int,
) -> tuple[tuple[EnvState, ...], Transition, Any]:
    return collect(keys, env_state, functools.partial(act_all, actors), num_steps)


def _act_all(act: ActAs, actors: Any, keys: Key, obs: Array) -> tuple[Key, Array, Key]:
    # Not vmap: a product of a batch of matrices rounds otherwise than that of one, and a seed's run beside others is to
    # be its run alone.
    return jax.lax.map(functools.partial(_act_one, act), (actors, keys, obs))


def _act_one(act: ActAs, args: tuple[Any, Key, Array]) -> tuple[Key, Array, Key]:
    actor, key, obs = args
    key, act_key, reset_key = jax.random.split(key, 3)
    return key, act(act_key, actor, obs), reset_key
