"""What every comparison with a peer is made of: its line in the table, and PyTorch on one thread."""

import dataclasses
import importlib
from collections.abc import Sequence
from typing import Any

from benchmarks.result import as_time
from benchmarks.timing import Pairs
from experiments.analysis.tables import number, text_table

HEAD = ("kernel", "shape", "who", "ours", "theirs", "theirs / ours", "quartiles", "FLOPs, ours", "theirs")


@dataclasses.dataclass(frozen=True)
class Line:
    """One line of the table."""

    kernel: str
    shape: str
    who: str
    """Whose is compared with ours."""
    pairs: Pairs
    """Seconds of one unit of work, and their ratio."""
    our_flops: int | None = None
    """Of one unit's matrix products, where both have such."""
    their_flops: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """As the JSON has it."""
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "pairs"}
        return {**own, **self.pairs._asdict()}


def table(lines: Sequence[Line]) -> str:
    """The lines as aligned text."""
    rows = [
        (
            *(line.kernel, line.shape, line.who, as_time(line.pairs.ours), as_time(line.pairs.theirs)),
            as_ratio(line.pairs.ratio),
            f"{as_ratio(line.pairs.low)} to {as_ratio(line.pairs.high)}",
            *(_as_flops(line.our_flops), _as_flops(line.their_flops)),
        )
        for line in lines
    ]
    return text_table(HEAD, rows)


def as_ratio(ratio: float) -> str:
    """A ratio with two decimals, or as a whole number from 10 on: 0.96 and 1.04 are not the same."""
    return f"{ratio:.2f}" if ratio < 10 else f"{ratio:,.0f}"


def _as_flops(flops: int | None) -> str:
    return number(None) if flops is None else f"{flops / 1e9:.3g} G"


def torch_on_one_thread() -> Any:
    """PyTorch, which computes on one thread from here on, as XLA does; nothing of it is compiled."""
    torch = importlib.import_module("torch")
    torch.set_num_threads(1)
    return torch
