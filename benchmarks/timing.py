"""The timing helpers of the benchmarks, and the machine's own limit measured with them."""

import statistics
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


class Pairs(NamedTuple):
    """Two ways to do the same, timed in turn."""

    ours: float
    """Median seconds of one unit of work."""
    theirs: float
    ratio: float
    """Median over pairs of theirs over ours: above 1 where ours is the quicker."""
    low: float
    """Lower quartile of that ratio."""
    high: float
    """Upper quartile."""


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


def measure_pairs(
    ours: Callable[[], Any],
    theirs: Callable[[], Any],
    *,
    pairs: int = 15,
    calls: int = 1,
    inner: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> Pairs:
    """Time two calls in turn: ours, theirs, ours, theirs, ...

    What else the machine does then slows both down, and the ratio within a pair says more than that of two medians.

    Args:
        ours: one side; what it returns is waited for, if it is JAX's.
        theirs: the other. Both are called twice before, as a second call may compile again.
        pairs: how many; at least 2.
        calls: of one side in a row, as one time. More where a call is short: the first after the other side finds
            caches that are not its own.
        inner: how many units of work one call does; the times are per unit.
        clock: seconds.

    Raises:
        ValueError: fewer than two pairs.
    """
    if pairs < 2:
        raise ValueError(f"pairs={pairs}. Allowed: at least 2, as quartiles are of several.")

    def once(call: Callable[[], Any]) -> float:
        began = clock()
        for _ in range(calls):
            jax.block_until_ready(call())
        return (clock() - began) / (calls * inner)

    for call in (ours, theirs) * 2:
        jax.block_until_ready(call())
    times = [(once(ours), once(theirs)) for _ in range(pairs)]
    low, ratio, high = statistics.quantiles([their / our for our, their in times], n=4, method="inclusive")
    our_times, their_times = zip(*times, strict=True)
    return Pairs(statistics.median(our_times), statistics.median(their_times), ratio, low, high)


def matmul_rate() -> float:
    """FLOP/s of a square float32 matrix product on the default device, at JAX's default precision."""
    matrix = jax.random.normal(jax.random.key(0), (MATMUL_SIZE, MATMUL_SIZE))
    product = jax.jit(jnp.matmul)
    return 2.0 * MATMUL_SIZE**3 / measure(lambda: product(matrix, matrix), repeats=10).best
