"""How groups of lines share a picture: all in one, or each in a small panel of its own with the others in grey. Names
stand beside the axes, never on them.
"""

import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from experiments.analysis.figures.style import COLOURS, save


class Curves(NamedTuple):
    """One quantity over a run, a line per seed."""

    label: str
    """What ran, such as `"implicit"`."""
    steps: np.ndarray
    """Environment steps, `[T]`."""
    values: np.ndarray
    """The quantity, `[S, T]`; NaN where there is none."""


class Panel(NamedTuple):
    """Axes, and what is drawn on them."""

    axes: Axes
    curves: Sequence[Curves]
    """In colour."""
    others: Sequence[Curves]
    """In grey, to compare with."""


MOST_IN_PICTURE = 8
"""More groups than these get a panel each: nobody tells so many lines apart."""
MOST_BELOW = 4
"""More groups than these are named to the right of the axes, not below."""
OTHERS = "#c8c8c8"
STEPS = "environment steps"


def panels_of(curves: Sequence[Curves]) -> tuple[Figure, list[Panel]]:
    """A figure with one panel for all groups, or one for each where there are more than `MOST_IN_PICTURE`."""
    count = len(curves)
    if count <= MOST_IN_PICTURE:
        figure = Figure(figsize=(6.6, 4.1), layout="constrained")
        return figure, [Panel(figure.subplots(), curves, ())]
    # Few empty places, and then rather few rows.
    columns = 3 if count <= 9 else min((5, 4), key=lambda columns: -count % columns)
    rows = -(-count // columns)
    figure = Figure(figsize=(2.4 * columns + 0.6, 1.75 * rows + 0.9), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[count:]:
        axes.set_axis_off()
    # The lowest of each column has the numbers; where the last row is not full that is one further up.
    for axes in grid.flat[max(0, count - columns) : count]:
        axes.xaxis.set_tick_params(labelbottom=True)
        axes.set_xlabel(STEPS, fontsize=9)
    panels = []
    for i, (axes, group) in enumerate(zip(grid.flat, curves, strict=False)):
        axes.set_title(f"{group.label}, n = {len(group.values)}", loc="left", fontsize=9.5)
        panels.append(Panel(axes, [group], [*curves[:i], *curves[i + 1 :]]))
    return figure, panels


def draw_lines(
    panels: Sequence[Panel], middle: Callable[[Curves], np.ndarray], name: Callable[[Curves], str], **style: Any
) -> None:
    """Draws each group's seeds thin and its middle bold, and of the others the middles in grey.

    Args:
        panels: where.
        middle: `[T]` of a group; one without any numbers is left out.
        name: of a group, in the legend.
        **style: matplotlib's, of all lines.
    """
    for axes, curves, others in panels:
        for group in others:
            if np.isfinite(group.values).any():
                axes.plot(group.steps, middle(group), color=OTHERS, linewidth=0.8, zorder=1, **style)
        faint = 0.45 if len(curves) <= MOST_BELOW else 0.25
        for (colour, dashes), group in zip(_colours(curves), curves, strict=True):
            if not np.isfinite(group.values).any():
                continue
            for values in group.values:
                axes.plot(group.steps, values, color=colour, linewidth=0.8, alpha=faint, **style)
            axes.plot(group.steps, middle(group), dashes, color=colour, linewidth=2.4, label=name(group), **style)


def name_of(group: Curves, curves: Sequence[Curves], middle: str = "median") -> str:
    """What a group is called in the legend; short where there are many, as its title, or the panel's, says the rest.
    `middle` is what its bold line is.
    """
    count = len(group.values)
    if len(curves) > MOST_IN_PICTURE:
        return middle
    if len(curves) > MOST_BELOW:
        return f"{group.label}, {count}"
    return f"{group.label}, {f'{middle} of ' if count > 1 else ''}n = {count}"


def finish(
    path: str | os.PathLike[str],
    figure: Figure,
    panels: Sequence[Panel],
    *,
    quantity: str,
    title: str | None,
    middle: str = "median",
) -> None:
    """Names steps and quantity, adds the legend outside of all axes, and writes the file.

    Args:
        path: of the PNG to write.
        figure: the picture.
        panels: its panels, drawn.
        quantity: label of the upright axis.
        title: above the picture.
        middle: what the bold lines are.

    Raises:
        RunError: the file cannot be written.
    """
    one = len(panels) == 1
    curves = [group for panel in panels for group in panel.curves]
    for axes, *_ in panels:
        axes.set_xlim(0, max(float(group.steps[-1]) for group in curves))
        axes.xaxis.set_major_locator(MaxNLocator(6 if one else 3, integer=True))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda step, _: f"{step:,.0f}"))
    first = panels[0].axes
    if one:
        first.set_xlabel(STEPS)
        first.set_ylabel(quantity)
        if title:
            first.set_title(title, loc="left")
    else:
        figure.supylabel(quantity, fontsize=10)
        if title:
            figure.suptitle(title, x=0.01, ha="left")
    _add_legend(figure, first, curves, middle)
    save(figure, path)


def _add_legend(figure: Figure, axes: Axes, curves: Sequence[Curves], middle: str) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if len(curves) > MOST_IN_PICTURE:
        # The first panel has the names of all.
        handles += [
            Line2D([], [], color=COLOURS[0], linewidth=0.8, alpha=0.45, label="each seed"),
            Line2D([], [], color=OTHERS, linewidth=0.8, label=f"{middle}s of the others"),
        ]
        figure.legend(handles=handles, loc="outside lower right", frameon=False, ncols=len(handles))
    elif len(curves) > MOST_BELOW:
        figure.set_figwidth(figure.get_figwidth() * 1.3)
        title = f"{middle}, of so many seeds"
        figure.legend(handles, labels, loc="outside right upper", frameon=False, title=title, alignment="left")
    elif handles:
        columns = 2 if max(map(len, labels)) <= 34 and len(labels) > 1 else 1
        rows = -(-len(labels) // columns)
        figure.set_figheight(figure.get_figheight() + 0.1 + 0.2 * rows)
        figure.legend(handles, labels, loc="outside lower center", frameon=False, ncols=columns)


def _colours(curves: Sequence[Curves]) -> list[tuple[str, str]]:
    """A colour and a line style each; where colours run out they come again, dashed."""
    count = len(COLOURS)
    return [(COLOURS[i % count], "--" if i // count % 2 else "-") for i in range(len(curves))]
