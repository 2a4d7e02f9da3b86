"""Curves over a run: coverage, and intrinsic reward, a line per seed."""

import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, PercentFormatter

from experiments.analysis.figures.style import COLOURS, SOFT, STYLE, save
from experiments.runs.scene import Cells


class Curves(NamedTuple):
    """One quantity over a run, a line per seed."""

    label: str
    """What ran, such as `"implicit"`."""
    steps: np.ndarray
    """Environment steps, `[T]`."""
    values: np.ndarray
    """The quantity, `[S, T]`; NaN where there is none."""


FEW_CELLS = 12
"""Up to so many coverage cells are shown one by one."""
MOST_IN_PICTURE = 4
"""More groups than these are named beside the picture: inside, names would cover lines."""
MOST_EPISODES = 40
"""Up to so many episodes are worth counting along an axis."""


def plot_coverage(
    path: str | os.PathLike[str],
    curves: Sequence[Curves],
    coverage: Cells,
    *,
    episode_steps: int | None = None,
    title: str | None = None,
) -> None:
    """Draws how much has been seen against environment steps: a thin line per seed, of several their median in bold.

    Args:
        path: of the PNG to write.
        curves: fractions seen, 0 to 1: one group of lines for a run, several to compare methods.
        coverage: of the environment; what a cell is called and how many there are.
        episode_steps: of a whole episode; given, and few enough, episodes are counted along the top.
        title: above the picture.

    Raises:
        ValueError: `curves` is empty, or its shapes do not match.
        RunError: the file cannot be written.
    """
    _check(curves)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.6, 4.1), layout="constrained")
        axes = figure.subplots()
        if episode_steps and max(group.steps[-1] for group in curves) <= MOST_EPISODES * episode_steps:
            length = episode_steps
            episodes = axes.secondary_xaxis(
                "top", functions=(lambda step: np.divide(step, length), lambda count: np.multiply(count, length))
            )
            episodes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
            episodes.set_xlabel("episodes")
            episodes.tick_params(length=2)
            episodes.spines["top"].set_visible(False)
        faint = 0.45 if len(curves) <= MOST_IN_PICTURE else 0.25
        for (colour, dashes), group in zip(_colours(curves), curves, strict=True):
            # A value holds until the next one is known: coverage goes up in steps.
            many = len(group.values) > 1
            for values in group.values:
                width, alpha = (0.9, faint) if many else (2.2, 1.0)
                axes.plot(group.steps, values, color=colour, linewidth=width, alpha=alpha, drawstyle="steps-post")
            middle, label = np.median(group.values, axis=0), _label(group, curves)
            axes.plot(group.steps, middle, dashes, color=colour, linewidth=2.4, drawstyle="steps-post", label=label)
        axes.set_ylim(0, 1.04)
        axes.yaxis.set_major_locator(FixedLocator([0, 0.2, 0.4, 0.6, 0.8, 1]))
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        axes.set_ylabel(
            "explored" if coverage.num_cells <= FEW_CELLS else f"explored, of {coverage.num_cells:,} {coverage.unit}"
        )
        if coverage.reachable is not None:
            label = f"all {coverage.reachable:,} that can be reached"
            axes.axhline(
                coverage.reachable / coverage.num_cells, color="#666666", linewidth=1.2, linestyle="--", label=label
            )
        if coverage.num_cells <= FEW_CELLS:
            # Coverage can only stand on these lines; naming them saves the reader a division.
            cells = coverage.num_cells
            counts = axes.secondary_yaxis(
                "right", functions=(lambda share: np.multiply(share, cells), lambda count: np.divide(count, cells))
            )
            counts.yaxis.set_major_locator(FixedLocator(list(range(cells + 1))))
            counts.set_ylabel(f"{coverage.unit} seen")
            counts.tick_params(length=0)
            counts.spines["right"].set_visible(False)
            for count in range(1, cells + 1):
                axes.axhline(count / cells, color="#e4e4e4", linewidth=0.7, zorder=0)
        _finish(figure, axes, path, curves, title, "best")


def plot_intrinsic_reward(
    path: str | os.PathLike[str], curves: Sequence[Curves], *, unit: str = "intrinsic reward", title: str | None = None
) -> None:
    """Draws the reward for exploring against environment steps: raw values thin, smoothed bold; a log axis if need be.

    Args:
        path: of the PNG to write.
        curves: mean intrinsic reward of each round's real transitions; NaN where there is none. Without any (a method
            without a belief) the picture says so.
        unit: label of the axis.
        title: above the picture.

    Raises:
        ValueError: `curves` is empty, or its shapes do not match.
        RunError: the file cannot be written.
    """
    _check(curves)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.6, 4.1), layout="constrained")
        axes = figure.subplots()
        drawn = [value[np.isfinite(value)] for group in curves for value in group.values]
        for (colour, dashes), group in zip(_colours(curves), curves, strict=True):
            if not np.isfinite(group.values).any():
                continue
            for values in group.values:
                axes.plot(group.steps, values, color=colour, linewidth=0.7, alpha=0.35)
            window = len(group.steps) // 50 * 2 + 1
            label = _label(group, curves)
            if window > 1 and len(curves) <= MOST_IN_PICTURE:
                label += f" (bold: mean of {window} rounds)"
            middle = _smooth(_median(group.values), window)
            axes.plot(group.steps, middle, dashes, color=colour, linewidth=2.4, label=label)
        positive = np.concatenate([values[values > 0] for values in drawn])
        if not sum(map(len, drawn)):
            axes.set_yticks([])
            axes.text(
                0.5, 0.5, "this method has no intrinsic reward", ha="center", color=SOFT, transform=axes.transAxes
            )
        elif len(positive) and np.quantile(positive, 0.98) > 30 * np.quantile(positive, 0.02):
            axes.set_yscale("log", nonpositive="mask")
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        else:
            axes.set_ylim(bottom=min(0.0, *(values.min() for values in drawn if len(values))))
        axes.set_ylabel(unit)
        axes.grid(axis="y", color="#e4e4e4", linewidth=0.7)
        axes.set_axisbelow(True)
        _finish(figure, axes, path, curves, title, "best")


def _check(curves: Sequence[Curves]) -> None:
    if not curves:
        raise ValueError("curves: nothing to draw")
    for group in curves:
        values, steps = np.shape(group.values), np.shape(group.steps)
        if len(values) != 2 or not values[0] or values[1:] != steps:
            raise ValueError(f"{group.label}: values {values} and steps {steps} must be [S, T] and [T]")


def _colours(curves: Sequence[Curves]) -> list[tuple[str, str]]:
    """A colour and a line style each; where colours run out they come again, dashed and then dotted."""
    styles = ("-", "--", ":")
    count = len(COLOURS)
    return [(COLOURS[i % count], styles[i // count % len(styles)]) for i in range(len(curves))]


def _label(group: Curves, curves: Sequence[Curves]) -> str:
    """What a line is called; short where there are many, as the legend's title says the rest."""
    count = len(group.values)
    if len(curves) > MOST_IN_PICTURE:
        return f"{group.label}, {count}"
    return f"{group.label}, {'median of ' if count > 1 else ''}n = {count}"


def _median(values: np.ndarray) -> np.ndarray:
    """The median over seeds, `[S, T] -> [T]`, of those that have a value; NaN where none has."""
    middle = np.full(values.shape[1], np.nan)
    some = np.isfinite(values).any(axis=0)
    middle[some] = np.nanmedian(np.where(np.isfinite(values), values, np.nan)[:, some], axis=0)
    return middle


def _smooth(values: np.ndarray, window: int) -> np.ndarray:
    """The mean of the `window` (odd) values around each one, of those that there are; NaN where there is none."""
    known = np.isfinite(values)
    sums, counts = (np.convolve(x, np.ones(window), "same") for x in (np.where(known, values, 0.0), known))
    return np.where(known, sums / np.maximum(counts, 1), np.nan)


def _finish(
    figure: Figure, axes: Axes, path: str | os.PathLike[str], curves: Sequence[Curves], title: str | None, legend: Any
) -> None:
    axes.set_xlim(0, max(float(group.steps[-1]) for group in curves))
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda step, _: f"{step:,.0f}"))
    axes.set_xlabel("environment steps")
    if axes.get_legend_handles_labels()[0]:
        if len(curves) > MOST_IN_PICTURE:
            figure.set_figwidth(figure.get_figwidth() * 1.3)
            title_of_legend = "median, of so many seeds"
            figure.legend(loc="outside right upper", frameon=False, title=title_of_legend, alignment="left")
        else:
            axes.legend(loc=legend, frameon=True, framealpha=0.9, edgecolor="none")
    if title:
        axes.set_title(title, loc="left")
    save(figure, path)
