"""A ring buffer as a pytree: any record of arrays, fixed capacity, uniform sampling with replacement."""

from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import validate
from jaxplore.types import Array, Key

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


def add(state: Replay[Record], batch: Record, valid: Array | None = None) -> Replay[Record]:
    """Write a batch, oldest rows first to go.

    Args:
        state: the buffer.
        batch: records `[B, ...]`, `B` at most the capacity.
        valid: `[B]` bool, which rows to write (all by default); the others leave no trace.

    Returns:
        The buffer with the rows in it.

    Raises:
        ValueError: `B` over the capacity.
    """
    batch_size, limit = jax.tree.leaves(batch)[0].shape[0], capacity(state)
    if batch_size > limit:
        raise ValueError(f"batch of {batch_size} rows does not fit. Allowed: at most the capacity, {limit}.")
    valid = jnp.ones(batch_size, bool) if valid is None else valid
    offset = jnp.cumsum(valid.astype(jnp.int32)) - 1
    # Rows that are not valid aim past the end, where the scatter drops them.
    index = jnp.where(valid, (state.position + offset) % limit, limit)
    count = jnp.sum(valid.astype(jnp.int32))
    return Replay(
        rows=jax.tree.map(lambda rows, new: rows.at[index].set(new, mode="drop"), state.rows, batch),
        position=(state.position + count) % limit,
        size=jnp.minimum(state.size + count, limit),
    )


def sample(key: Key, state: Replay[Record], batch_size: int) -> Record:
    """Draw `batch_size` rows `[B, ...]`, independent and uniform over the rows held (with replacement).

    An empty buffer gives its zero rows. `key` is consumed.
    """
    # randint, not choice(replace=False): the latter sorts the whole capacity at each draw.
    index = jax.random.randint(key, (batch_size,), 0, jnp.maximum(state.size, 1))
    return jax.tree.map(lambda rows: rows[index], state.rows)
