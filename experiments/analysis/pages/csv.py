"""Everything behind a panel as CSV, with all digits."""

import csv
import io
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from experiments.analysis.pages.contents import FloorVisits, Panel


def text(panel: Panel | FloorVisits) -> str:
    """Curves as `series,seed,step,value`, or what they run over in place of steps, such as `episodes`; an empty value
    where there is none. Visits as `seed,x,y` in metres.
    """
    if isinstance(panel, FloorVisits):
        positions = np.asarray(panel.positions, float).tolist()
        seeds = np.asarray(panel.seeds).tolist()
        return _lines(("seed", "x", "y"), ((seed, *map(_value, at)) for seed, at in zip(seeds, positions, strict=True)))
    return _lines(("series", "seed", panel.column, "value"), _curves(panel))


def _curves(panel: Panel) -> Iterable[tuple[Any, ...]]:
    for one in panel.series:
        steps = np.asarray(one.steps).tolist()
        for seed, values in zip(one.seeds, np.asarray(one.values, float).tolist(), strict=True):
            yield from ((one.label, seed, step, _value(value)) for step, value in zip(steps, values, strict=True))


def _value(value: float) -> float | str:
    return value if math.isfinite(value) else ""


def _lines(head: tuple[str, ...], lines: Iterable[tuple[Any, ...]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(lines)
    return out.getvalue()
