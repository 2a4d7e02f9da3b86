"""Running mean and standard deviation as a pytree (Welford; Chan et al. 1979 for batches)."""

import jax.numpy as jnp
from flax import struct

from jaxplore.types import Array

MIN_STD = 1e-3
"""Standard deviations are floored here: an entry that never moves must not divide by zero."""


@struct.dataclass
class Normalizer:
    """Statistics of the rows seen so far."""

    count: Array
    """Rows seen, float32 scalar."""
    mean: Array
    """`[F]`"""
    sum_squares: Array
    """Sum of squared deviations from the mean, `[F]`."""

    @property
    def std(self) -> Array:
        """Population standard deviation, at least `MIN_STD`; 1 before the first row. `[F]`."""
        std = jnp.sqrt(self.sum_squares / jnp.maximum(self.count, 1.0))
        return jnp.where(self.count > 0, jnp.maximum(std, MIN_STD), 1.0)


def init(size: int) -> Normalizer:
    """Statistics of no rows of `size` entries: normalising with them changes nothing."""
    return Normalizer(count=jnp.zeros(()), mean=jnp.zeros(size), sum_squares=jnp.zeros(size))


def update(state: Normalizer, rows: Array, weights: Array | None = None) -> Normalizer:
    """Take rows into the statistics.

    Args:
        state: statistics so far.
        rows: `[B, F]`.
        weights: `[B]`, 1 for rows to count and 0 for rows to leave out; all count by default.

    Returns:
        The statistics of all rows, as if they had come one by one.

    Example:
        >>> import jax.numpy as jnp
        >>> state = update(init(1), jnp.array([[1.0], [3.0]]))
        >>> float(state.mean[0]), float(state.std[0])
        (2.0, 1.0)
    """
    weights = jnp.ones(rows.shape[0]) if weights is None else weights
    keep = weights[:, None] > 0
    count = jnp.sum(weights)
    rows = jnp.where(keep, rows, 0.0)
    mean = jnp.sum(rows, axis=0) / jnp.maximum(count, 1.0)
    sum_squares = jnp.sum(jnp.where(keep, rows - mean[None], 0.0) ** 2, axis=0)
    total = jnp.maximum(state.count + count, 1.0)
    delta = mean - state.mean
    return Normalizer(
        count=state.count + count,
        mean=state.mean + delta * count / total,
        sum_squares=state.sum_squares + sum_squares + delta**2 * state.count * count / total,
    )


def normalize(state: Normalizer, rows: Array) -> Array:
    """`(rows - mean) / std`, in standard deviations. `rows` is `[..., F]`."""
    shape = (1,) * (rows.ndim - 1) + state.mean.shape
    return (rows - state.mean.reshape(shape)) / state.std.reshape(shape)


def denormalize(state: Normalizer, rows: Array) -> Array:
    """The inverse of `normalize`: back to the rows' own units. `rows` is `[..., F]`."""
    shape = (1,) * (rows.ndim - 1) + state.mean.shape
    return rows * state.std.reshape(shape) + state.mean.reshape(shape)
