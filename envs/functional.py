"""Environments in pure JAX from their rules: what a user's own environment needs, and what MJX's are made with.

`jit`, `vmap` and `scan` them as you like. Bookkeeping that is the same everywhere (episodes, observation noise, what
a bad action is, numbers that are not finite) is here; what the environment is, is its `Rules`.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Coverage, Environment, EnvSpec, EnvState, FloorPlan, View, check_noise
from jaxplore.types import Array, Key, Transition

BACKEND = "jax"


class Rules(NamedTuple):
    """All that an environment in pure JAX is. Unbatched; `physics` is any tree of arrays of your own."""

    spec: EnvSpec
    start: Callable[[Key], Any]
    """`start(key) -> physics`: the state an episode begins in."""
    advance: Callable[[Key, Any, Array], Any]
    """`advance(key, physics, action [A]) -> physics`: one step; `key` is for what happens by chance in it."""
    observe: Callable[[Any, Any], Array]
    """`observe(physics_before, physics) -> obs [O]`, before and after the step; equal at a reset."""
    coverage: Coverage
    reward: Callable[[Any, Array, Any], Array | float] = lambda before, action, after: 0.0
    """`reward(physics_before, action [A], physics) -> scalar`."""
    terminated: Callable[[Any], Array | bool] = lambda physics: False
    """`terminated(physics) -> bool`: whether the task ends here. A time limit is not this, but `spec.episode_steps`."""
    floor_plan: FloorPlan | None = None
    view: View | None = None
    start_in: Callable[[Key, int], Any] | None = None
    """`start_in(key, cell) -> physics`: as `start`, in a coverage cell; see `Environment.reset_in`."""


class Parts(NamedTuple):
    """The fixed parts of an environment in pure JAX."""

    rules: Rules
    obs_noise: float


def make_environment(rules: Rules, obs_noise: float = 0.0, backend: str = BACKEND) -> Environment:
    """The environment that `rules` describe.

    Actions are clipped to [-1, 1]; a discrete one is the choice with the largest entry. A state or an observation that
    is no longer finite ends the episode as `terminated`; `next_obs` is then what was computed.

    Args:
        rules: what happens.
        obs_noise: standard deviation of Gaussian noise added to every observation entry, in raw units. The rules do
            not see it.
        backend: what to call the engine.

    Raises:
        FieldError: `obs_noise` is negative or not finite.
        ValueError: from `step`, when traced: the action is not of shape `[A]`.

    Example:
        A walk on a line, seen when it is right of 1:

        >>> import jax, jax.numpy as jnp
        >>> walk = make_environment(Rules(
        ...     spec=EnvSpec("walk", ("x [m]",), ("push",), episode_steps=10, dt=0.1),
        ...     start=lambda key: jax.random.uniform(key, (1,)),
        ...     advance=lambda key, x, action: x + 0.1 * action,
        ...     observe=lambda before, x: x,
        ...     coverage=Coverage(2, lambda obs: (obs[0] > 1).astype(jnp.int32), "sides")))
        >>> state, transition = walk.step(walk.reset(jax.random.key(0)), jnp.ones(1))
        >>> float(transition.next_obs[0] - transition.obs[0])
        0.09999...
    """
    parts = Parts(rules, check_noise(obs_noise))
    return Environment(
        rules.spec,
        functools.partial(reset_to, parts, rules.start),
        functools.partial(step, parts),
        rules.coverage,
        backend,
        True,
        rules.floor_plan,
        rules.view,
        reset_in=rules.start_in and functools.partial(reset_to, parts, rules.start_in),
    )


def reset_to(parts: Parts, start: Callable[..., Any], key: Key, *cell: int) -> EnvState:
    """A new episode that begins in `start(key, *cell)`."""
    start_key, key = jax.random.split(key)
    physics = start(start_key, *cell)
    key, obs = _observe(parts, key, physics, physics)
    return EnvState(physics, obs, jnp.int32(0), key)


def step(parts: Parts, state: EnvState, action: Array) -> tuple[EnvState, Transition]:
    """A step; see `Environment.step`."""
    rules, spec, action_shape = parts.rules, parts.rules.spec, (parts.rules.spec.action_size,)
    if jnp.shape(action) != action_shape:
        raise ValueError(f"action has shape {jnp.shape(action)}. Allowed: {action_shape}.")
    action = jnp.asarray(action, jnp.float32)
    choice = jax.nn.one_hot(jnp.argmax(action), spec.action_size)
    action = choice if spec.discrete else jnp.clip(action, -1.0, 1.0)
    num_steps = state.num_steps + 1
    # Folded in, not split off: the noise is then the same whether or not the rules have use for this key. From 2 on,
    # because splitting in two is the same as folding 0 and 1 in.
    after = rules.advance(jax.random.fold_in(state.key, num_steps + 1), state.physics, action)
    key, obs = _observe(parts, state.key, state.physics, after)
    transition = Transition(
        obs=state.obs,
        action=action,
        reward=jnp.asarray(rules.reward(state.physics, action, after), jnp.float32),
        next_obs=obs,
        terminated=jnp.asarray(rules.terminated(after)) | ~all_finite((after, obs)),
        truncated=num_steps >= spec.episode_steps,
    )
    return EnvState(after, obs, num_steps, key), transition


def _observe(parts: Parts, key: Key, before: Any, after: Any) -> tuple[Key, Array]:
    obs = jnp.asarray(parts.rules.observe(before, after), jnp.float32)
    if parts.obs_noise == 0:
        return key, obs
    key, noise_key = jax.random.split(key)
    return key, obs + parts.obs_noise * jax.random.normal(noise_key, obs.shape, obs.dtype)


def all_finite(tree: Any) -> Array:
    """Whether every floating-point number in a tree is finite, bool."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return jnp.all(
        jnp.array([jnp.isfinite(x).all() for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)] or [True])
    )
