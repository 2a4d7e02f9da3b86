"""Running mean and standard deviation as a pytree (Welford; Chan et al. 1979 for batches)."""

import jax.numpy as jnp
from flax import struct

from jaxplore import validate
from jaxplore.types import Array
from jaxplore.validate import FieldError

MIN_STD, MIN_SHARE = 1e-3, 1e-5
"""Standard deviations are floored at the larger of these, the second times the size of the mean: an entry that hardly
moves must not divide by next to nothing. Rounding of float32 is 6e-8 of the mean."""
LIMIT = 10.0
"""Standard deviations within which normalised numbers are kept, as Gymnasium and Stable-Baselines3 have it: an entry
that stood still for long, or physics that jumps, is far away, and not 1e6 times as far as all else."""


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
        """Population standard deviation, `[F]`, at least `MIN_STD` and `MIN_SHARE` of the mean; 1 before any row."""
        std = jnp.sqrt(self.sum_squares / jnp.maximum(self.count, 1.0))
        floor = jnp.maximum(MIN_STD, MIN_SHARE * jnp.abs(self.mean))
        return jnp.where(self.count > 0, jnp.maximum(std, floor), 1.0)


def init(size: int) -> Normalizer:
    """Statistics of no rows of `size` entries: normalising with them changes nothing but what is beyond `LIMIT`.

    Raises:
        FieldError: `size` below 1.
    """
    validate.at_least("size", size, 1)
    return Normalizer(count=jnp.zeros(()), mean=jnp.zeros(size), sum_squares=jnp.zeros(size))


def update(state: Normalizer, rows: Array, weights: Array | None = None) -> Normalizer:
    """Take rows into the statistics.

    Args:
        state: statistics so far.
        rows: `[B, F]`.
        weights: `[B]`, 1 for rows to count and 0 for rows to leave out; all count by default.

    Returns:
        The statistics of all rows, as if they had come one by one.

    Raises:
        FieldError: rows or weights of another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> state = update(init(1), jnp.array([[1.0], [3.0]]))
        >>> float(state.mean[0]), float(state.std[0])
        (2.0, 1.0)
    """
    _check_width("rows", state, rows, ndim=2)
    weights = jnp.ones(rows.shape[0]) if weights is None else weights
    if jnp.shape(weights) != rows.shape[:1]:
        raise FieldError("weights", jnp.shape(weights), f"shape {rows.shape[:1]}, one for each row", "is their shape")
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


def normalize(state: Normalizer, rows: Array, limit: float | None = LIMIT) -> Array:
    """`(rows - mean) / std`, in standard deviations.

    Args:
        state: the statistics.
        rows: `[..., F]`.
        limit: how far from the mean they are kept, on both sides, to rounding; None: wherever they are.

    Raises:
        FieldError: rows of another width.
    """
    # Before the division, not after it: programs whose rows are all within then round as they do without a limit.
    rows = rows if limit is None else clip(state, rows, limit)
    _check_width("rows", state, rows)
    shape = (1,) * (rows.ndim - 1) + state.mean.shape
    return (rows - state.mean.reshape(shape)) / state.std.reshape(shape)


def clip(state: Normalizer, rows: Array, limit: float = LIMIT) -> Array:
    """Rows within `limit` standard deviations of the mean, in their own units. `rows` is `[..., F]`.

    Raises:
        FieldError: rows of another width.
    """
    _check_width("rows", state, rows)
    shape = (1,) * (rows.ndim - 1) + state.mean.shape
    mean, reach = state.mean.reshape(shape), limit * state.std.reshape(shape)
    return jnp.clip(rows, mean - reach, mean + reach)


def denormalize(state: Normalizer, rows: Array) -> Array:
    """The inverse of `normalize` without a limit: back to the rows' own units. `rows` is `[..., F]`.

    Raises:
        FieldError: rows of another width.
    """
    _check_width("rows", state, rows)
    shape = (1,) * (rows.ndim - 1) + state.mean.shape
    return rows * state.std.reshape(shape) + state.mean.reshape(shape)


def _check_width(field: str, state: Normalizer, rows: Array, ndim: int | None = None) -> None:
    """Raise unless `rows` are `[..., F]`: those of width 1 would be broadcast in silence."""
    shape, width = jnp.shape(rows), state.mean.shape[-1]
    if not shape or shape[-1] != width or (ndim is not None and len(shape) != ndim):
        batch = "..." if ndim is None else "B"
        raise FieldError(field, shape, f"shape [{batch}, {width}]", "is their shape")
