"""Predicted variance beside true error."""

import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

from experiments.analysis.figures.style import COLOURS, SOFT, STYLE, save


class Reliability(NamedTuple):
    """Predicted variance beside squared error, transition by transition."""

    label: str
    """What the transitions are, such as `"its data"`."""
    variance: np.ndarray
    """`[N]`"""
    error: np.ndarray
    """`[N]`"""


def plot_calibration(
    path: str | os.PathLike[str],
    groups: Sequence[Reliability],
    cells: Sequence[dict[str, Any]] | None,
    *,
    unit: str,
    title: str | None = None,
    fewest: int = 20,
) -> None:
    """Draws how predicted variance orders and sizes the error, and what is predicted where.

    On the left the transitions of each group, cut into ten parts of equal number by their variance: mean squared error
    of each part against its mean variance. On the dashed line uncertainty is as large as errors are. On the right
    variance and error by cell or, where there are no cells to show, how variance is spread in each group.

    Args:
        path: of the PNG to write.
        groups: at least one.
        cells: of each coverage cell `cell`, `seen`, and the medians `variance` and `error`, or None.
        unit: of both, for the axes.
        title: above the picture.
        fewest: transitions that a part must have.

    Raises:
        RunError: the file cannot be written.
    """
    colours = dict(zip((group.label for group in groups), COLOURS, strict=False))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.4, 4.8), layout="constrained")
        halves = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.15, 1))[0]
        left, right = (half.subplots() for half in halves)
        ends = []
        for group in groups:
            parts = max(1, min(10, len(group.variance) // fewest))
            order = np.array_split(np.argsort(group.variance), parts)
            x, y = (np.array([values[part].mean() for part in order]) for values in (group.variance, group.error))
            left.plot(
                x, y, "o-", color=colours[group.label], markersize=4, label=f"{group.label}, n = {len(group.error):,}"
            )
            ends += [*x[x > 0], *y[y > 0]]
        if ends:
            low, high = min(ends) / 1.5, max(ends) * 1.5
            left.plot([low, high], [low, high], color=SOFT, linestyle="--", linewidth=1, zorder=0)
            left.text(high, high, "as large as errors are ", color=SOFT, ha="right", va="bottom", fontsize=8.5)
            left.set(xscale="log", yscale="log")
        left.set_xlabel(f"variance of the models ({unit})")
        left.set_ylabel("squared error of their mean")
        left.set_title("predicted against true, by tenths", loc="left")
        if cells:
            _cells_panel(right, cells)
        else:
            for group in groups:
                shares = (np.arange(len(group.variance)) + 1) / len(group.variance)
                right.plot(np.sort(group.variance), shares, color=colours[group.label], linewidth=2, label=group.label)
            right.set(xscale="log", xlabel=f"variance of the models ({unit})", ylabel="share of transitions below")
            right.set_title("how variance is spread", loc="left")
        rows = -(-len(groups) // 2)
        for half, axes in zip(halves, (left, right), strict=True):
            # Below, where they cover nothing, and as high on either side.
            handles, labels = axes.get_legend_handles_labels()
            columns = -(-len(labels) // rows)
            half.legend(handles, labels, loc="outside lower center", frameon=False, fontsize=9, ncols=columns)
            axes.grid(color="#e4e4e4", linewidth=0.7)
            axes.set_axisbelow(True)
        if title:
            figure.suptitle(title, x=0.01, ha="left")
        save(figure, path)


def _cells_panel(axes: Axes, cells: Sequence[dict[str, Any]]) -> None:
    """Median variance and error of uniform actions in each cell; what has not been seen is shaded."""
    at = np.array([entry["cell"] for entry in cells])
    for entry in cells:
        if not entry["seen"]:
            axes.axvspan(entry["cell"] - 0.5, entry["cell"] + 0.5, color="#f3ead9", zorder=0, linewidth=0)
    for quantity, colour, marker in (("variance", COLOURS[0], "o"), ("error", COLOURS[1], "s")):
        values = np.array([np.nan if entry[quantity] is None else entry[quantity] for entry in cells], float)
        label = "variance of the models" if quantity == "variance" else "squared error of their mean"
        axes.plot(at, values, color=colour, marker=marker, linewidth=1.5, label=label)
    axes.set_yscale("log")
    axes.set_xlim(at[0] - 0.5, at[-1] + 0.5)
    axes.xaxis.set_major_locator(FixedLocator(at.tolist()))
    axes.set_xlabel("cell (shaded: never seen)")
    axes.set_title("uniform actions in each cell, medians", loc="left")
