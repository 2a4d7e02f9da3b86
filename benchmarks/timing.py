"""The one timing helper of the benchmarks, and the machine's own limit measured with it."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

MATMUL_SIZE = 2048


class Timing(NamedTuple):
    """Seconds of one call."""

    best: float
    median: float
    compile: float
    """Of the first call, compilation included."""


def measure(call: Callable[[], Any], *, repeats: int = 5, inner: int = 1) -> Timing:
    """Time `call`, which returns arrays that are waited for.

    Args:
        call: what to time; called once before, to compile.
        repeats: timed calls. The best is the least disturbed; the median says how noisy the machine is.
        inner: how many units of work one call does; the times are per unit.
    """
    began = time.perf_counter()
    jax.block_until_ready(call())
    compiled = time.perf_counter() - began
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append((time.perf_counter() - began) / inner)
    times.sort()
    return Timing(times[0], times[len(times) // 2], compiled)


def measure_chain(call: Callable[[Any], Any], state: Any, *, repeats: int = 5, inner: int = 1) -> Timing:
    """`measure` of a function that takes its state over and gives it back, each call from where the last one ended."""

    def once() -> Any:
        nonlocal state
        state = call(state)
        return state

    return measure(once, repeats=repeats, inner=inner)


def matmul_rate() -> float:
    """FLOP/s of a square float32 matrix product on the default device, at JAX's default precision."""
    matrix = jax.random.normal(jax.random.key(0), (MATMUL_SIZE, MATMUL_SIZE))
    product = jax.jit(jnp.matmul)
    return 2.0 * MATMUL_SIZE**3 / measure(lambda: product(matrix, matrix), repeats=10).best
