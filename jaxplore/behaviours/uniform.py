"""Uniform random actions: the warm-up of every method, and a method of its own."""

from typing import Any

import jax

from jaxplore import validate
from jaxplore.behaviours.base import Behaviour
from jaxplore.dynamics import Normalizers
from jaxplore.types import Array, Key


def uniform_actions(key: Key, obs: Array, action_size: int, discrete: bool = False) -> Array:
    """Uniform random actions for `obs [..., O]`: `[..., A]`, in [-1, 1] or, if `discrete`, one-hot."""
    leading = obs.shape[:-1]
    if discrete:
        return jax.nn.one_hot(jax.random.randint(key, leading, 0, action_size), action_size)
    return jax.random.uniform(key, (*leading, action_size), minval=-1.0, maxval=1.0)


def make_uniform(action_size: int, discrete: bool = False) -> Behaviour:
    """Uniform actions, always: in [-1, 1], or one of `action_size` choices.

    Raises:
        FieldError: `action_size` below 1.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import dynamics
        >>> behaviour = make_uniform(2)
        >>> behaviour.act(jax.random.key(0), (), dynamics.init_normalizers(3, 2), jnp.zeros((5, 3))).shape
        (5, 2)
    """
    validate.sizes(action_size=action_size)

    def act(key: Key, actor: Any, normalizers: Normalizers, obs: Array) -> Array:
        return uniform_actions(key, obs, action_size, discrete)

    return Behaviour(
        init=lambda key: (),
        improve=lambda key, state, experience: (state, {}),
        actor=lambda state: (),
        act=act,
    )
