"""What Brax and MuJoCo Playground have in common: `reset(key)` and `step(state, action)` on one tree of arrays.

Their own resets and time limits are wrappers, which are left off: `next_obs` is the true successor, `done` becomes
`terminated`, and the time limit is ours.
"""
# pyright: reportAttributeAccessIssue=false
# mujoco ships no stubs.

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from envs import functional
from envs.base import Environment, EnvSpec
from envs.coverage import make_generic_coverage
from envs.views import make_mujoco_view
from jaxplore import validate
from jaxplore.types import Array, Key
from jaxplore.validate import FieldError

MAIN_OBS = "state"
"""Of a dictionary of observations, the one that a policy sees; the others are for critics."""


def make_environment(
    env: Any,
    name: str,
    backend: str,
    obs_noise: float,
    episode_steps: int,
    model: Any,
    qpos: Callable[[Any], Array],
) -> Environment:
    """`env` by our contract, in pure JAX.

    Args:
        env: has `reset`, `step`, `action_size` and `dt`.
        name: with its prefix.
        backend: what to call the engine.
        obs_noise: standard deviation of Gaussian noise added to every observation entry, in raw units.
        episode_steps: steps after which an episode is truncated.
        model: the `mujoco.MjModel` to draw it with; None for no pictures.
        qpos: `qpos(its state) -> [nq]`, for the pictures.

    Raises:
        FieldError: observations that are not one vector, or a bad `obs_noise` or `episode_steps`.
    """
    validate.at_least("episode_steps", episode_steps, 1)
    size = _obs_size(env, name)
    spec = EnvSpec(
        name=name,
        obs_names=tuple(f"obs[{i}]" for i in range(size)),
        action_names=tuple(f"action[{i}]" for i in range(env.action_size)),
        episode_steps=episode_steps,
        dt=float(env.dt),
        has_reward=True,
    )
    cameras = tuple(model.camera(i).name for i in range(model.ncam)) if model is not None else ()
    rules = functional.Rules(
        spec=spec,
        start=functools.partial(_reset, env),
        advance=functools.partial(_advance, env),
        observe=lambda before, after: _main(after.obs),
        coverage=make_generic_coverage(spec),
        reward=lambda before, action, after: after.reward,
        terminated=lambda state: state.done > 0,
        view=None if model is None else make_mujoco_view(model, lambda state: qpos(state.physics), cameras),
    )
    return functional.make_environment(rules, obs_noise, backend)


def _reset(env: Any, key: Key) -> Any:
    with jax.numpy_rank_promotion("allow"):  # Both rely on it, and take raw keys.
        return env.reset(jax.random.key_data(key))


def _advance(env: Any, key: Key, state: Any, action: Array) -> Any:
    with jax.numpy_rank_promotion("allow"):
        # In containers of its own: some change the state that they are given, its metrics above all.
        after = env.step(jax.tree.map(lambda leaf: leaf, state), action)
    # In the types of the state before, so that loops can carry it.
    return jax.tree.map(lambda new, old: jnp.asarray(new, jnp.asarray(old).dtype), after, state)


def _main(obs: Any) -> Any:
    return obs[MAIN_OBS] if isinstance(obs, Mapping) else obs


def _obs_size(env: Any, name: str) -> int:
    """Entries of an observation. Raises `FieldError` unless it is one vector."""
    obs = jax.eval_shape(functools.partial(_reset, env), jax.random.key(0)).obs
    if isinstance(obs, Mapping) and MAIN_OBS not in obs:
        allowed = f"one vector, or several with {MAIN_OBS!r}"
        raise FieldError("env", name, allowed, f"has observations {', '.join(obs)}")
    shape = _main(obs).shape
    if len(shape) != 1:
        raise FieldError("env", name, "one vector, no pictures", f"has observations of shape {shape}")
    return shape[0]
