"""A state as arrays by name and records of what they were, and back."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Misfit(Exception):
    """A saved state is whole but is not of the structure asked for."""


class Allowances(NamedTuple):
    """In what a saved state may differ from the one that is asked for."""

    newer: Mapping[str, Any] = {}
    """Leaves that a state saved by an older version lacks, and the number that they are then full of."""
    longer: Collection[str] = ()
    """Leaves that may be shorter along their second axis, and are then filled up with zeros: a run that goes on for
    more steps than it was begun for."""


NONE = Allowances()
"""A saved state is to be just as the one that is asked for."""


def _named_leaves(tree: Any) -> tuple[dict[str, Any], Any]:
    """The leaves of a tree by path, such as `"sac.policy.Dense_0.kernel"`, and its structure."""
    pairs, structure = jax.tree_util.tree_flatten_with_path(tree)
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in pairs}
    if len(named) != len(pairs):
        raise TypeError("two leaves of the state have the same path: are there dots in the keys of a dictionary?")
    return named, structure


def encode(state: Any) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
    """Splits a state into arrays for Orbax and, for every leaf, a JSON record of what it was.

    Everything goes through Orbax as NumPy arrays: it would canonicalise float64 where x64 is off, and refuses arrays
    without entries (MJX has many); those are rebuilt from their record.
    """
    arrays: dict[str, np.ndarray] = {}
    records: dict[str, dict[str, Any]] = {}
    for name, leaf in _named_leaves(state)[0].items():
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            kind, extra, array = (
                "key",
                {"impl": str(jax.random.key_impl(leaf))},
                np.asarray(jax.device_get(jax.random.key_data(leaf))),
            )
        elif isinstance(leaf, jax.Array):
            # Weak types are kept: a resumed state must hit the compiled programs of the first one.
            kind, extra, array = "jax", {"weak": bool(leaf.weak_type)}, np.asarray(jax.device_get(leaf))
        elif isinstance(leaf, np.ndarray | np.generic):
            kind, extra, array = "numpy", {"scalar": isinstance(leaf, np.generic)}, np.asarray(leaf, order="C")
        elif isinstance(leaf, bool | int | float | str):
            records[name] = {"kind": "python", "value": leaf}
            continue
        else:
            raise TypeError(f"{name}: a {type(leaf).__name__} cannot be saved, only arrays, keys and Python scalars")
        if array.dtype.hasobject or array.dtype.names or not array.dtype.isnative or array.dtype.kind in "SUMm":
            raise TypeError(f"{name}: an array of {array.dtype} cannot be saved")
        records[name] = {"kind": kind, "dtype": str(array.dtype), "shape": list(array.shape), **extra}
        if array.size:
            arrays[name] = array
    return arrays, records


def decode(
    abstract_state: Any, records: dict[str, dict[str, Any]], arrays: dict[str, np.ndarray], allowed: Allowances
) -> Any:
    """Puts a state together again, the inverse of `encode`.

    Args:
        abstract_state: a state with the structure, shapes and dtypes of the saved one.
        records: what the leaves were.
        arrays: the leaves that are arrays.
        allowed: where the saved state may differ.

    Raises:
        Misfit: structure, shapes or dtypes are not those of `abstract_state`.
    """
    like, structure = _named_leaves(abstract_state)
    absent = {name for name in allowed.newer if name in like and name not in records}
    if like.keys() - absent != records.keys():
        missing, unknown = sorted(like.keys() - absent - records.keys()), sorted(records.keys() - like.keys())
        raise Misfit(
            "; ".join(f"it {verb} {_some(names)}" for verb, names in (("lacks", missing), ("has", unknown)) if names)
        )
    leaves = {name: np.full(like[name].shape, allowed.newer[name], like[name].dtype) for name in absent}
    for name, record in records.items():
        array = arrays.get(name)
        if array is not None and name in allowed.longer:
            array = _lengthen(array, np.shape(like[name]))
        leaf = record["value"] if array is None else _rebuild(name, record, array, like[name])
        if np.shape(leaf) != np.shape(like[name]) or _dtype(leaf) != _dtype(like[name]):
            raise Misfit(
                f"{name} is {_dtype(leaf)}{list(np.shape(leaf))} there and "
                f"{_dtype(like[name])}{list(np.shape(like[name]))} here"
            )
        leaves[name] = leaf
    return jax.tree_util.tree_unflatten(structure, [leaves[name] for name in like])


def _lengthen(leaf: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """`leaf` with zeros after it along its second axis, if that makes it of this shape."""
    if leaf.ndim != len(shape) or leaf.ndim < 2 or leaf.shape[1] >= shape[1]:
        return leaf
    return np.pad(leaf, [(0, shape[1] - leaf.shape[1] if axis == 1 else 0) for axis in range(leaf.ndim)])


def _rebuild(name: str, record: dict[str, Any], array: np.ndarray, like: Any) -> Any:
    if record["kind"] == "numpy":
        return array[()] if record["scalar"] else array
    # A copy: on a CPU the JAX array would share memory with the NumPy array, and the first step may donate it.
    leaf = jnp.array(array)
    if leaf.dtype != array.dtype:
        raise Misfit(f"{name} is {array.dtype}, which needs jax_enable_x64")
    if record["kind"] == "key":
        leaf = jax.random.wrap_key_data(leaf, impl=record["impl"])
    elif record["weak"]:
        leaf = jnp.broadcast_to(jnp.asarray(array.dtype.type(0).item()), array.shape).at[...].set(leaf)
    sharding = getattr(like, "sharding", None)
    return jax.device_put(leaf, sharding) if sharding is not None and len(sharding.device_set) > 1 else leaf


def _dtype(leaf: Any) -> str:
    """The dtype as `jax.eval_shape` would have it, so that both kinds of abstract state can be compared."""
    dtype = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
    if jnp.issubdtype(dtype, jax.dtypes.extended) or dtype.kind in "US":
        return str(dtype)
    return str(jax.dtypes.canonicalize_dtype(dtype))


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
