"""Where agents have been, as a picture of the floor and a table of its cells."""

from html import escape
from typing import Any, NamedTuple

import numpy as np

from experiments.analysis.pages.contents import FloorVisits, Table
from experiments.analysis.pages.numbers import Scale, step_name, ticks

BINS = 48
"""Squares along the longer side of the floor."""
LEVELS = 6
"""Shades of the page, `v1` to `v6`."""


class Histogram(NamedTuple):
    """Visits by square."""

    counts: np.ndarray
    """`[rows, columns]`, the first row at the bottom."""
    seeds: np.ndarray
    """`[rows, columns]`, how many seeds were there."""
    left: float
    bottom: float
    side: float
    """Of a square, metres."""


def histogram(panel: FloorVisits) -> Histogram:
    """Counts the positions of all seeds in squares over the cells of the floor and a rim; others are left out."""
    boxes = np.array(panel.floor.cells, float)
    (left, bottom), (right, top) = boxes[:, :2].min(0), boxes[:, 2:].max(0)
    side = float(max(right - left, top - bottom)) / (BINS - 4)
    left, bottom = float(left) - 2 * side, float(bottom) - 2 * side
    shape = (int(np.ceil((top - bottom) / side - 1e-9)) + 2, int(np.ceil((right - left) / side - 1e-9)) + 2)
    positions, seeds = _known(panel)
    at = np.floor((positions - (left, bottom)) / side).astype(int)
    inside = ((at >= 0) & (at < shape[::-1])).all(axis=1)
    at, seeds = at[inside], seeds[inside]
    counts, by_seed = np.zeros(shape, int), np.zeros(shape, int)
    np.add.at(counts, (at[:, 1], at[:, 0]), 1)
    for seed in np.unique(seeds):
        own = at[seeds == seed]
        seen = np.zeros(shape, bool)
        seen[own[:, 1], own[:, 0]] = True
        by_seed += seen
    return Histogram(counts, by_seed, left, bottom, side)


def measure(panel: FloorVisits, cells: Histogram) -> str:
    """What the picture shows, with its units."""
    seeds = len(np.unique(np.asarray(panel.seeds)))
    return f"visits of a square of {cells.side:.2g} m, seeds together: {seeds}; x, y in metres"


def limits(counts: np.ndarray) -> list[int]:
    """The fewest visits of each shade: equal factors from 1 to the most; fewer shades where few differ."""
    most = int(counts.max()) if counts.size else 0
    if most < 1:
        return []
    return sorted({max(1, round(most ** (level / LEVELS))) for level in range(LEVELS)})


def draw(panel: FloorVisits, name: str, cells: Histogram) -> str:
    """The floor from above, a square darker the more often it was visited; walls, and the outlines of the cells."""
    rows, columns = cells.counts.shape
    unit = 320 / columns
    width, height = 360, 34 + rows * unit
    levels = limits(cells.counts)

    def across(x: float) -> float:
        return 32 + (x - cells.left) / cells.side * unit

    def up(y: float) -> float:
        return 6 + (rows - (y - cells.bottom) / cells.side) * unit

    def box(edges: tuple[float, float, float, float]) -> str:
        x0, x1 = (float(np.clip(across(x), 32, 352)) for x in (edges[0], edges[2]))
        y0, y1 = (float(np.clip(up(y), 6, 6 + rows * unit)) for y in (edges[1], edges[3]))
        return f"M{x0:.1f} {y0:.1f}H{x1:.1f}V{y1:.1f}H{x0:.1f}Z"

    xs = [f"{32 + column * unit:.1f}" for column in range(columns + 1)]
    ys = [f"{6 + (rows - row) * unit:.1f}" for row in range(rows + 1)]
    shades = []
    shade = np.searchsorted(levels, cells.counts, side="right")
    for level in range(1, len(levels) + 1):
        squares = "".join(
            # Neighbours have the very same edges, so that nothing shines through between them.
            f"M{xs[column]} {ys[row]}H{xs[column + 1]}V{ys[row + 1]}H{xs[column]}Z"
            for row, column in np.argwhere(shade == level).tolist()
        )
        shades.append(f'<path class="v{shade_of(level, len(levels))}" d="{squares}"/>')
    labels = []
    ends = (cells.left + columns * cells.side, cells.bottom + rows * cells.side)
    for tick in ticks(Scale(cells.left, ends[0]), 6):
        labels.append(f'<text class="x" x="{across(tick):.1f}" y="{20 + rows * unit:.1f}">{step_name(tick)}</text>')
    for tick in ticks(Scale(cells.bottom, ends[1]), 6):
        labels.append(f'<text class="y" x="28" y="{up(tick):.1f}" dy=".32em">{step_name(tick)}</text>')
    said = "; ".join(", ".join(line) for line in table(panel).lines)
    return "".join(
        (
            f'<svg viewBox="0 0 {width} {height:.0f}" role="img" tabindex="0" aria-labelledby="{name}-t {name}-d">',
            f'<title id="{name}-t">{escape(panel.title)}</title>',
            f'<desc id="{name}-d">Visits of the floor, x and y in metres. By cell, visits, share and seeds: '
            f"{escape(said)}</desc>",
            f'<path class="wall" d="{"".join(map(box, panel.floor.walls))}"/>',
            *shades,
            f'<path class="cell" d="{"".join(map(box, panel.floor.cells))}"/>',
            *labels,
            '<g class="live"></g></svg>',
        )
    )


def shade_of(level: int, count: int) -> int:
    """Which of the page's shades the `level`-th of `count` has; the last is always the strongest."""
    return LEVELS - count + level


def geometry(cells: Histogram) -> dict[str, Any]:
    """What a script needs to say what is in a square: `[row, column, visits, seeds]` of each that was visited."""
    rows, columns = cells.counts.shape
    visited = np.argwhere(cells.counts > 0)
    squares = [[r, c, int(cells.counts[r, c]), int(cells.seeds[r, c])] for r, c in visited.tolist()]
    corner = [round(cells.left, 4), round(cells.bottom, 4), round(cells.side, 5)]
    return {"floor": corner, "rows": rows, "columns": columns, "total": int(cells.counts.sum()), "squares": squares}


def table(panel: FloorVisits) -> Table:
    """Visits of each cell, in its order: how many, their share of all positions, by how many seeds."""
    positions, seeds = _known(panel)
    total, every = len(positions), len(np.unique(np.asarray(panel.seeds)))
    lines = []
    for number, (x0, y0, x1, y1) in enumerate(panel.floor.cells, 1):
        inside = ((positions >= (x0, y0)) & (positions < (x1, y1))).all(axis=1)
        there = int(inside.sum())
        lines.append(
            (
                f"{number}: {_range(x0, x1)}, {_range(y0, y1)}",
                f"{there:,}",
                f"{there / max(total, 1):.1%}",
                f"{len(np.unique(seeds[inside]))} of {every}",
            )
        )
    return Table(("cell: x, y (m)", "visits", "share of steps", "seeds that were there"), lines)


def _known(panel: FloorVisits) -> tuple[np.ndarray, np.ndarray]:
    """Positions that are finite, and their seeds."""
    positions = np.asarray(panel.positions, float)
    known = np.isfinite(positions).all(axis=1)
    return positions[known], np.asarray(panel.seeds)[known]


def _range(low: float, high: float) -> str:
    return f"{low:g} to {high:g}"
