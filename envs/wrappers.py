"""The loop that acts: some steps of one environment, episode after episode."""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment, EnvState
from jaxplore.types import Array, Key, Transition

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
    and returns NumPy arrays. Both use the key alike: each step splits it in three, one to go on with, one for `act`
    and one for the reset that may follow.

    Args:
        env: the environment.
        capacity: rows that `collect` returns; `num_steps` of them are steps, the others zeros.

    Returns:
        `collect`. `valid` marks the rows that are steps with finite observations: physics that diverges leaves a row
        that is none. On the host `collect` raises `ValueError` for `num_steps` outside 1 to `capacity`.

    Raises:
        ValueError: `capacity` below 1.
    """
    if capacity < 1:
        raise ValueError(f"capacity is {capacity}. Allowed: 1 or more.")
    collect = _collect_compiled if env.compiled else _collect_host
    return lambda key, env_state, act, num_steps: collect(env, capacity, key, env_state, act, num_steps)


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
    finite = jnp.all(jnp.isfinite(rows.obs) & jnp.isfinite(rows.next_obs), axis=-1)
    return env_state, rows, finite & (jnp.arange(capacity) < num_steps)


def _collect_host(
    env: Environment, capacity: int, key: Key, env_state: EnvState, act: Act, num_steps: int
) -> tuple[EnvState, Transition, Array]:
    def act_all(keys: Key, obs: np.ndarray) -> tuple[Key, Array, Key]:
        key, act_key, reset_key = _split(keys)
        return key, act(act_key, obs[0])[None], reset_key[None]

    states, rows, valid = make_collect_all(env, capacity)(key, (env_state,), act_all, num_steps)
    return states[0], jax.tree.map(lambda leaf: leaf[0], rows), valid[0]


@jax.jit
def _split(key: Key) -> tuple[Key, Key, Key]:
    key, act_key, reset_key = jax.random.split(key, 3)
    return key, act_key, reset_key


ActAll: TypeAlias = Callable[[Key, np.ndarray], tuple[Key, Array, Key]]
"""`act_all(keys [S], obs [S, O]) -> (keys [S], actions [S, A], reset_keys [S])`: each key is split in three, one to go
on with, one for `act` and one for the reset that may follow."""

CollectAll: TypeAlias = Callable[[Key, tuple[EnvState, ...], ActAll, int], tuple[tuple[EnvState, ...], Transition, Any]]
"""`collect(keys [S], states, act_all, num_steps) -> (states, transitions [S, capacity], valid [S, capacity])`."""


def make_collect_all(env: Environment, capacity: int) -> CollectAll:
    """`make_collect` on the host for several seeds side by side: each step is one call of `act_all` and one of the
    environment's `step_all`, if it has that. Each seed's numbers are those of `make_collect` with its key alone.

    Args:
        env: an environment that is not compiled.
        capacity: rows that `collect` returns; `num_steps` of them are steps, the others zeros.

    Returns:
        `collect`. It raises `ValueError` for `num_steps` outside 1 to `capacity`.
    """

    def collect(
        keys: Key, states: tuple[EnvState, ...], act_all: ActAll, num_steps: int
    ) -> tuple[tuple[EnvState, ...], Transition, Any]:
        if not 1 <= num_steps <= capacity:
            raise ValueError(f"num_steps is {num_steps}. Allowed: 1 to {capacity}.")
        transitions = []
        for _ in range(num_steps):
            keys, actions, reset_keys = act_all(keys, np.stack([state.obs for state in states]))
            states, transition = step_all(env, states, jax.device_get(actions))
            transitions.append(transition)
            done = np.flatnonzero(transition.terminated | transition.truncated).tolist()
            if done:
                fresh = dict(zip(done, reset_all(env, reset_keys[np.array(done)]), strict=True))
                states = tuple(fresh.get(i, state) for i, state in enumerate(states))
        transitions += [jax.tree.map(np.zeros_like, transitions[-1])] * (capacity - num_steps)
        rows = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *transitions)
        finite = np.all(np.isfinite(rows.obs) & np.isfinite(rows.next_obs), axis=-1)
        return states, rows, finite & (np.arange(capacity) < num_steps)

    return collect


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
