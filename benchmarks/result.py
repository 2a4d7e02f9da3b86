"""Lines of the table, as they are measured, printed and stored."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from benchmarks.timing import Timing
from experiments.analysis.tables import number, text_table

HEAD = ("kernel", "shape", "time", "floor", "x floor", "per second", "first call")
UNITS = (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))


@dataclasses.dataclass(frozen=True)
class Result:
    """One line of the table."""

    kernel: str
    shape: str
    seconds: float
    """Of one unit of work, best of the repeats."""
    median_seconds: float
    compile_seconds: float
    flops: float | None = None
    floor_seconds: float | None = None
    per_second: float | None = None
    """Environment steps, where that is what counts."""

    @property
    def times_floor(self) -> float | None:
        """How many times the floor the kernel takes."""
        return self.seconds / self.floor_seconds if self.floor_seconds else None

    def to_dict(self) -> dict[str, Any]:
        """As the JSON has it."""
        return {**dataclasses.asdict(self), "times_floor": self.times_floor}


def make_result(
    kernel: str, shape: str, timing: Timing, flop: float | None = None, rate: float | None = None
) -> Result:
    """A line of the table, with a floor where the FLOPs that it cannot do without are known.

    Args:
        kernel: what was timed.
        shape: how much of it.
        timing: of one unit of work.
        flop: FLOPs of one unit of work.
        rate: FLOP/s of a matrix product on this machine.
    """
    floor = flop / rate if flop and rate else None
    return Result(kernel, shape, timing.best, timing.median, timing.compile, flop, floor)


def widths(hidden: tuple[int, ...]) -> str:
    """Layer widths as a shape has them: `"64-64"`."""
    return "-".join(map(str, hidden))


def table(results: Sequence[Result]) -> str:
    """The results as aligned text."""
    lines = [
        (
            result.kernel,
            result.shape,
            as_time(result.seconds),
            as_time(result.floor_seconds),
            number(result.times_floor),
            number(result.per_second),
            as_time(result.compile_seconds),
        )
        for result in results
    ]
    return text_table(HEAD, lines)


def as_time(seconds: float | None) -> str:
    """A time in the largest unit that it reaches: `"3.1 ms"`.

    Example:
        >>> as_time(0.0031), as_time(0.25), as_time(None)
        ('3.1 ms', '250 ms', '-')
    """
    if seconds is None:
        return number(None)
    unit, scale = next(((unit, scale) for unit, scale in UNITS if seconds >= scale), UNITS[-1])
    return f"{number(seconds / scale)} {unit}"
