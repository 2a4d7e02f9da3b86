"""Whether a run fits into memory, found out by tracing it: before anything is written, computed or compiled."""

import dataclasses
import math
import os
from collections.abc import Collection, Iterator
from typing import Any

import jax
import numpy as np

from envs.base import Environment
from experiments.runs.config import RunConfig, flag
from experiments.training.programs import Programs

PER_STEP = 12
"""Bytes that a run keeps of each step: where it began, and which of its episode it was."""


def check_steps(config: RunConfig) -> None:
    """Refuse a run of which what is kept of each step is larger than the machine.

    Raises:
        ValueError: says what is needed, what there is, and the settings that it follows from.
    """
    need, memory = config.num_seeds * config.steps * PER_STEP, total_memory()
    if need > memory:
        raise _refusal(need, memory, "what is kept of its steps", _settings(config, (config.steps, config.num_seeds)))


def check_arrays(config: RunConfig, env: Environment, programs: Programs) -> None:
    """Refuse a run whose state, or an array that a step of learning makes, is larger than the machine.

    Seeds that are spread over devices, each with a memory of its own, share the state.

    Both programs are traced for that as they are in the run, which then does not trace them again.

    Raises:
        ValueError: as `check_steps`.
    """
    memory = total_memory()
    try:
        state = programs.trace_init()
    except (OverflowError, MemoryError) as error:
        raise _no_machine(config) from error
    leaves = jax.tree.leaves(state)
    share = 1 if jax.devices()[0].platform == "cpu" else programs.learning.num_devices
    need, largest = sum(map(_bytes, leaves)) // share, max(leaves, key=_bytes)
    if need > memory:
        raise _refusal(need, memory, f"arrays such as {_name(largest)}", _settings(config, largest.shape))
    shape = (config.num_seeds, config.explorer.steps_per_round)
    rows = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*shape, *leaf.shape[2:]), leaf.dtype), state.data.rows)
    obs = jax.ShapeDtypeStruct((config.num_seeds, env.spec.obs_size), np.float32)
    valid, alive = (jax.ShapeDtypeStruct(dims, bool) for dims in (shape, shape[:1]))
    try:
        traced = programs.trace_learn(state, (rows, valid), obs, config.steps, alive)
    except (OverflowError, MemoryError) as error:
        raise _no_machine(config) from error
    largest = max(_arrays(traced.jaxpr), key=_bytes)
    if _bytes(largest) > memory:
        raise _refusal(_bytes(largest), memory, f"an array {_name(largest)}", _settings(config, largest.shape))


def total_memory() -> int:
    """Bytes of the device that learning runs on."""
    stats = jax.devices()[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return stats["bytes_limit"]
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return 2**63


def _arrays(jaxpr: Any) -> Iterator[Any]:
    """Every array that a program makes, those of the programs within it included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name != "shard_map":  # Whose results are those of all devices together.
            yield from (variable.aval for variable in equation.outvars if hasattr(variable.aval, "shape"))
        for part in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda part: hasattr(part, "eqns")):
            inner = getattr(part, "jaxpr", part)
            if hasattr(inner, "eqns"):
                yield from _arrays(inner)


def _bytes(leaf: Any) -> int:
    # A key's dtype has no size in bytes that NumPy knows.
    return math.prod(leaf.shape) * getattr(leaf.dtype, "itemsize", 8)


def _name(leaf: Any) -> str:
    return f"{leaf.dtype}[{', '.join(f'{size:,}' for size in leaf.shape)}]"


def _settings(config: RunConfig, sizes: Collection[int]) -> str:
    """The flags whose values are among sizes, the large ones: what they most likely follow from."""
    found = []

    def search(part: Any, prefix: str) -> None:
        for item in dataclasses.fields(part):
            value, path = getattr(part, item.name), f"{prefix}{item.name}"
            if dataclasses.is_dataclass(value):
                search(value, f"{path}.")
            elif type(value) is int and value >= 1000 and value in sizes:
                found.append(f"{flag(path)}={value}")
            elif isinstance(value, tuple) and any(type(one) is int and one >= 1000 and one in sizes for one in value):
                found.append(f"{flag(path)} {' '.join(map(str, value))}")

    search(config, "")
    return ", ".join(found)


def _no_machine(config: RunConfig) -> ValueError:
    settings = _settings(config, range(2**20, 2**1000))
    return ValueError(f"{settings or 'these sizes'}: arrays of such sizes fit no machine. Allowed: smaller sizes.")


def _refusal(need: int, memory: int, what: str, settings: str) -> ValueError:
    of = f" (sizes of {settings})" if settings else ""
    return ValueError(
        f"this run needs {_gib(need)} of memory for {what}{of}, and there are {_gib(memory)}. Allowed: smaller sizes."
    )


def _gib(size: int) -> str:
    return f"{size / 2**30:,.1f} GiB"
