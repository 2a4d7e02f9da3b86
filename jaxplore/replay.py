"""A ring buffer as a pytree: any record of arrays, fixed capacity, uniform sampling with replacement."""

from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxplore import validate
from jaxplore.types import Array, Key
from jaxplore.validate import FieldError

Record = TypeVar("Record")


@struct.dataclass
class Replay(Generic[Record]):
    """Rows and where the next one goes."""

    rows: Record
    """The records, each leaf `[capacity, ...]`."""
    position: Array
    """Index of the next write, int32."""
    size: Array
    """Rows held, int32, at most the capacity."""


def capacity(state: Replay[Record]) -> int:
    """How many rows the buffer can hold."""
    return jax.tree.leaves(state.rows)[0].shape[0]


def init(example: Record, capacity: int) -> Replay[Record]:
    """An empty buffer for records shaped like `example` (one record, no batch axis).

    Raises:
        ValueError: `capacity` below 1.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> replay = init({"obs": jnp.zeros(3)}, capacity=100)
        >>> replay = add(replay, {"obs": jnp.ones((25, 3))})
        >>> int(replay.size), sample(jax.random.key(0), replay, 8)["obs"].shape
        (25, (8, 3))
    """
    validate.at_least("capacity", capacity, 1)
    rows = jax.tree.map(lambda x: jnp.zeros((capacity, *jnp.shape(x)), jnp.asarray(x).dtype), example)
    return Replay(rows=rows, position=jnp.zeros((), jnp.int32), size=jnp.zeros((), jnp.int32))


def cleared(state: Replay[Record]) -> Replay[Record]:
    """The buffer, empty; the rows that it held are written over one by one."""
    return Replay(rows=state.rows, position=jnp.zeros_like(state.position), size=jnp.zeros_like(state.size))


def add(state: Replay[Record], batch: Record, valid: Array | None = None) -> Replay[Record]:
    """Write a batch, oldest rows first to go.

    Args:
        state: the buffer.
        batch: records `[B, ...]`, `B` at most the capacity.
        valid: `[B]` bool, which rows to write (all by default); the others leave no trace.

    Returns:
        The buffer with the rows in it.

    Raises:
        ValueError: `B` over the capacity, a batch whose shapes are not those of the buffer's records, or another number
            in `valid`.
    """
    _check_batch(state, batch)
    batch_size, limit = jax.tree.leaves(batch)[0].shape[0], capacity(state)
    if batch_size > limit:
        raise ValueError(f"batch of {batch_size} rows does not fit. Allowed: at most the capacity, {limit}.")
    valid = jnp.ones(batch_size, bool) if valid is None else valid
    validate.shape("valid", valid, batch_size)
    offset = jnp.cumsum(valid.astype(jnp.int32)) - 1
    # Rows that are not valid aim past the end, where the scatter drops them.
    index = jnp.where(valid, (state.position + offset) % limit, limit)
    count = jnp.sum(valid.astype(jnp.int32))
    return Replay(
        rows=jax.tree.map(lambda rows, new: rows.at[index].set(new, mode="drop"), state.rows, batch),
        position=(state.position + count) % limit,
        size=jnp.minimum(state.size + count, limit),
    )


def _check_batch(state: Replay[Record], batch: Record) -> None:
    """Raise unless a batch has the structure and the shapes of the buffer's records: others would be broadcast."""
    there, here = jax.tree.structure(state.rows), jax.tree.structure(batch)
    if there != here:
        raise ValueError(f"batch is {here}. Allowed: {there}, as the buffer's records.")
    leaves = jax.tree.leaves(batch)
    for rows, new in zip(jax.tree.leaves(state.rows), leaves, strict=True):
        if jnp.shape(new)[:1] != jnp.shape(leaves[0])[:1] or jnp.shape(new)[1:] != rows.shape[1:] or not jnp.ndim(new):
            allowed = f"shape [B, {', '.join(map(str, rows.shape[1:]))}], the same B in all".replace(", ]", "]")
            raise FieldError("batch", jnp.shape(new), allowed, "is the shape of a part")


def sample(key: Key, state: Replay[Record], batch_size: int) -> Record:
    """Draw `batch_size` rows `[B, ...]`, independent and uniform over the rows held (with replacement).

    `key` is consumed.

    Raises:
        FieldError: `batch_size` below 1, or an empty buffer. Traced, where nobody knows how many rows it holds, an
            empty one gives its zero rows.
    """
    return take(state, choose(key, state, batch_size))


def choose(key: Key, state: Replay[Record], batch_size: int) -> Array:
    """Where the rows that `sample` draws are, int32 `[B]`; for many batches at once, under `vmap` over keys. Raises as
    `sample`.
    """
    validate.at_least("batch_size", batch_size, 1)
    if validate.known(state.size) and not np.any(np.asarray(state.size)):
        raise FieldError("size", 0, "a buffer with a row in it", "is all that the buffer holds")
    # randint, not choice(replace=False): the latter sorts the whole capacity at each draw.
    return jax.random.randint(key, (batch_size,), 0, jnp.maximum(state.size, 1))


def take(state: Replay[Record], index: Array) -> Record:
    """The rows at `index [B]`, `[B, ...]`."""
    return jax.tree.map(lambda rows: rows[index], state.rows)
