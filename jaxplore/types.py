"""Records, aliases and the legend of shape letters that every module of the library uses.

Shape letters, declared here once:

| letter | meaning |
| --- | --- |
| `B` | batch of transitions |
| `M` | models: networks drawn from a belief (the paper's m particles) |
| `N` | actors: rollouts imagined side by side |
| `H` | horizon of an imagined rollout |
| `O` | observation entries |
| `A` | action entries |
| `Z` | entries of the generator's noise z |
| `P` | numbers in one network's parameters theta |
| `S` | seeds: independent runs carried side by side |

Keys are typed (`jax.random.key`), named `key`, and consumed by the function that takes them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

Array: TypeAlias = jax.Array
Key: TypeAlias = jax.Array
"""A typed key, as `jax.random.key` makes it."""

Params: TypeAlias = Any
"""A tree of parameter arrays, as `flax.linen.Module.init(...)["params"]` gives it."""

Metrics: TypeAlias = dict[str, Array]
"""Scalars to look at. Never carried: what the next step needs lives in a state."""


def no_metrics(call: Callable[[], Metrics]) -> Metrics:
    """Zeros in the shape of what `call` gives, which is traced and not run: what a loop that may not turn starts with.

    Example:
        >>> import jax.numpy as jnp
        >>> no_metrics(lambda: {"loss": jnp.float32(3.0)})["loss"].item()
        0.0
    """
    return jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), jax.eval_shape(call))


def traced_once(call: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its trace kept: asked for its metrics (`no_metrics`) and then for its result, at the same
    shapes, it is traced once. What it is traced into looks the same.

    Example:
        >>> import jax.numpy as jnp
        >>> traces = []
        >>> double = traced_once(lambda x: (traces.append(1), 2 * x)[1])
        >>> shape, result = jax.eval_shape(double, jnp.ones(3)), double(jnp.ones(3))
        >>> len(traces)
        1
    """
    return jax.jit(call, inline=True)


class Transition(NamedTuple):
    """One environment step, or any batch of them. Leading axes are free; the entries share them.

    `next_obs` is always the true successor of `obs` under `action`: a reset never enters it.
    """

    obs: Array
    """Observation before the step, `[O]`, in the environment's own units."""
    action: Array
    """Action taken, `[A]`, each entry in [-1, 1]."""
    reward: Array
    """The environment's own reward, a scalar; 0 where the environment has none."""
    next_obs: Array
    """Observation after the step, `[O]`."""
    terminated: Array
    """Whether the task ended in `next_obs` (bool): nothing may be bootstrapped from it."""
    truncated: Array
    """Whether the episode was cut here by its time limit (bool): `next_obs` still has a value."""
