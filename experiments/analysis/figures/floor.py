"""The floor seen from above: where an agent has been."""

import os
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from envs.base import FloorPlan
from experiments.analysis.figures.style import STYLE, save
from experiments.runs.scene import Cells

_WALL: Any = {"facecolor": "#b4b4b4", "edgecolor": "none", "zorder": 1}
_CELL: Any = {"facecolor": "none", "edgecolor": "#dadada", "linewidth": 0.7, "zorder": 2}
_AGE = LinearSegmentedColormap.from_list("age", ["#1b5fd9", "#8f7fd0", "#d98aa8", "#d7191c"])


def plot_visitation(
    path: str | os.PathLike[str],
    walk: tuple[np.ndarray, np.ndarray],
    cells_seen: Sequence[int],
    plan: FloorPlan,
    coverage: Cells,
    *,
    title: str | None = None,
) -> None:
    """Draws the floor from above, in metres, at equal parts of a run: everywhere it has been so far, early in an
    episode blue, late red.

    Args:
        path: of the PNG to write.
        walk: x and y at every environment step of one seed, `[T, 2]` [m], and the step of the episode that each was,
            `[T]`.
        cells_seen: how many cells had been seen at the end of each part; as many panels are drawn (four: after a
            quarter, a half, three quarters and all of the steps).
        plan: walls and cells of the environment.
        coverage: of the environment; what a cell is called and how many there are.
        title: above the picture.

    Raises:
        ValueError: shapes do not match, or there are fewer steps than panels.
        RunError: the file cannot be written.
    """
    positions, episode_steps = map(np.asarray, walk)
    total, panels = len(positions), len(cells_seen)
    if positions.shape != (total, 2) or episode_steps.shape != (total,):
        raise ValueError(f"positions {positions.shape} and episode_steps {episode_steps.shape}: must be [T, 2] and [T]")
    if not 1 <= panels <= total:
        raise ValueError(f"cells_seen: {panels} panels of {total} steps")
    # What can be reached and a rim of the walls around it; the rest of the outer walls would only take room.
    boxes = np.array(plan.cells)
    (left, bottom), (right, top) = boxes[:, :2].min(0), boxes[:, 2:].max(0)
    rim = 0.06 * max(right - left, top - bottom)
    left, bottom, right, top = left - rim, bottom - rim, right + rim, top + rim
    # In random order: neither the early nor the late points of an episode may lie on top of the others.
    order = np.random.default_rng(0).permutation(total)
    ages = Normalize(0, max(1, episode_steps.max()))
    with matplotlib.rc_context(STYLE):
        width = 2.75  # Of a panel, inches.
        height = max(1.5, width * (top - bottom) / (right - left))  # The colour bar has a label.
        figure = Figure(figsize=(width * panels + 1.3, height + 0.7 + (0.22 if title else 0)), layout="compressed")
        row = figure.subplots(1, panels, squeeze=False)[0]
        for panel, (axes, cells) in enumerate(zip(row, cells_seen, strict=True), 1):
            until = total * panel // panels
            for rectangles, style in ((plan.walls, _WALL), (plan.cells, _CELL)):
                patches = [Rectangle((x0, y0), x1 - x0, y1 - y0) for x0, y0, x1, y1 in rectangles]
                axes.add_collection(PatchCollection(patches, **style))
            shown = order[order < until]
            dots = {"s": 3.0, "alpha": 0.8, "linewidths": 0, "zorder": 3}
            axes.scatter(*positions[shown].T, c=episode_steps[shown], cmap=_AGE, norm=ages, **dots)
            axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x (m)")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(4, integer=True))
            axes.tick_params(length=2, labelleft=axes is row[0])
            axes.spines[:].set_visible(False)
            axes.set_title(f"{until:,} steps", loc="left", fontweight="bold")
            axes.set_title(f"{cells} of {coverage.num_cells} {coverage.unit}", loc="right", fontsize=9.5)
        row[0].set_ylabel("y (m)")
        bar = figure.colorbar(ScalarMappable(ages, _AGE), ax=row, fraction=0.03, pad=0.012, aspect=24)
        bar.set_label("step of the episode")
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        if title:
            figure.suptitle(title)
        save(figure, path)
