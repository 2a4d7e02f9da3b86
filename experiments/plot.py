"""The three pictures of a run: coverage over steps, the floor seen from above, intrinsic reward over steps.

Every function takes arrays, draws without a display, and replaces its file as a whole.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from experiments.errors import RunError, disk_error

if TYPE_CHECKING:  # Pictures of finished runs should not wait for JAX and its libraries to load.
    from envs.base import Coverage, FloorPlan

try:
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import PatchCollection
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, PercentFormatter
except ImportError as error:
    raise RunError('pictures need matplotlib. What to do: pip install -e ".[experiments]".') from error

# Okabe and Ito's colours, told apart with any kind of colour vision.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_INK, _SOFT = "#222222", "#8a8a8a"
_WALL = {"facecolor": "#b4b4b4", "edgecolor": "none", "zorder": 1}
_CELL = {"facecolor": "none", "edgecolor": "#dadada", "linewidth": 0.7, "zorder": 2}
_AGE = LinearSegmentedColormap.from_list("age", ["#1b5fd9", "#8f7fd0", "#d98aa8", "#d7191c"])
_STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "axes.titlesize": 11,
    "axes.titlecolor": _INK,
    "axes.edgecolor": _SOFT,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": _SOFT,
    "ytick.color": _SOFT,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
    "savefig.dpi": 180,
    "savefig.facecolor": "white",
}


class Curves(NamedTuple):
    """One quantity over a run, a line per seed."""

    label: str
    """What ran, such as `"implicit"`."""
    steps: np.ndarray
    """Environment steps, `[T]`."""
    values: np.ndarray
    """The quantity, `[S, T]`; NaN where there is none."""


class Reliability(NamedTuple):
    """Predicted variance beside squared error, transition by transition."""

    label: str
    """What the transitions are, such as `"its data"`."""
    variance: np.ndarray
    """`[N]`"""
    error: np.ndarray
    """`[N]`"""


FEW_CELLS = 12
"""Up to so many coverage cells are shown one by one."""
MOST_IN_PICTURE = 4
"""More groups than these are named beside the picture: inside, names would cover lines."""
MOST_EPISODES = 40
"""Up to so many episodes are worth counting along an axis."""


def plot_coverage(
    path: str | os.PathLike[str],
    curves: Sequence[Curves],
    coverage: Coverage,
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
    with matplotlib.rc_context(_STYLE):
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
    with matplotlib.rc_context(_STYLE):
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
                0.5, 0.5, "this method has no intrinsic reward", ha="center", color=_SOFT, transform=axes.transAxes
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


def plot_visitation(
    path: str | os.PathLike[str],
    positions: np.ndarray,
    episode_steps: np.ndarray,
    cells_seen: Sequence[int],
    plan: FloorPlan,
    coverage: Coverage,
    *,
    title: str | None = None,
) -> None:
    """Draws the floor from above at equal parts of a run: everywhere it has been so far, early in an episode blue, late
    red.

    Args:
        path: of the PNG to write.
        positions: x and y after every environment step of one seed, `[T, 2]` [m].
        episode_steps: the step of the episode at which each was reached, `[T]`.
        cells_seen: how many cells had been seen at the end of each part; as many panels are drawn (four: after a
            quarter, a half, three quarters and all of the steps).
        plan: walls and cells of the environment.
        coverage: of the environment; what a cell is called and how many there are.
        title: above the picture.

    Raises:
        ValueError: shapes do not match, or there are fewer steps than panels.
        RunError: the file cannot be written.
    """
    positions, episode_steps = np.asarray(positions), np.asarray(episode_steps)
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
    with matplotlib.rc_context(_STYLE):
        width = 2.75  # Of a panel, inches.
        height = max(1.5, width * (top - bottom) / (right - left))  # The colour bar has a label.
        figure = Figure(figsize=(width * panels + 0.9, height + 0.4 + (0.22 if title else 0)), layout="compressed")
        row = figure.subplots(1, panels, squeeze=False)[0]
        for panel, (axes, cells) in enumerate(zip(row, cells_seen, strict=True), 1):
            until = total * panel // panels
            for rectangles, style in ((plan.walls, _WALL), (plan.cells, _CELL)):
                patches = [Rectangle((x0, y0), x1 - x0, y1 - y0) for x0, y0, x1, y1 in rectangles]
                axes.add_collection(PatchCollection(patches, **style))
            shown = order[order < until]
            dots = {"s": 3.0, "alpha": 0.8, "linewidths": 0, "zorder": 3}
            axes.scatter(*positions[shown].T, c=episode_steps[shown], cmap=_AGE, norm=ages, **dots)
            axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            axes.set_title(f"{until:,} steps", loc="left", fontweight="bold")
            axes.set_title(f"{cells} of {coverage.num_cells} {coverage.unit}", loc="right", fontsize=9.5)
        bar = figure.colorbar(ScalarMappable(ages, _AGE), ax=row, fraction=0.03, pad=0.012, aspect=24)
        bar.set_label("step of the episode")
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        if title:
            figure.suptitle(title)
        _save(figure, path)


def plot_posterior(
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
    colours = dict(zip((group.label for group in groups), _COLOURS, strict=False))
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.4, 4.3), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
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
            left.plot([low, high], [low, high], color=_SOFT, linestyle="--", linewidth=1, zorder=0)
            left.text(high, high, "as large as errors are ", color=_SOFT, ha="right", va="bottom", fontsize=8.5)
            left.set(xscale="log", yscale="log")
        left.set_xlabel(f"variance of the models ({unit})")
        left.set_ylabel("squared error of their mean")
        left.set_title("predicted against true, by tenths", loc="left")
        left.legend(frameon=False, fontsize=9)
        if cells:
            _cells_panel(right, cells)
        else:
            for group in groups:
                shares = (np.arange(len(group.variance)) + 1) / len(group.variance)
                right.plot(np.sort(group.variance), shares, color=colours[group.label], linewidth=2, label=group.label)
            right.set(xscale="log", xlabel=f"variance of the models ({unit})", ylabel="share of transitions below")
            right.set_title("how variance is spread", loc="left")
        for axes in (left, right):
            axes.grid(color="#e4e4e4", linewidth=0.7)
            axes.set_axisbelow(True)
        if title:
            figure.suptitle(title, x=0.01, ha="left")
        _save(figure, path)


def _cells_panel(axes: Axes, cells: Sequence[dict[str, Any]]) -> None:
    """Median variance and error of uniform actions in each cell; what has not been seen is shaded."""
    at = np.array([entry["cell"] for entry in cells])
    for entry in cells:
        if not entry["seen"]:
            axes.axvspan(entry["cell"] - 0.5, entry["cell"] + 0.5, color="#f3ead9", zorder=0, linewidth=0)
    for quantity, colour, marker in (("variance", _COLOURS[0], "o"), ("error", _COLOURS[1], "s")):
        values = np.array([np.nan if entry[quantity] is None else entry[quantity] for entry in cells], float)
        label = "variance of the models" if quantity == "variance" else "squared error of their mean"
        axes.plot(at, values, color=colour, marker=marker, linewidth=1.5, label=label)
    axes.set_yscale("log")
    axes.set_xlim(at[0] - 0.5, at[-1] + 0.5)
    axes.xaxis.set_major_locator(FixedLocator(at.tolist()))
    axes.set_xlabel("cell (shaded: never seen)")
    axes.set_title("uniform actions in each cell, medians", loc="left")
    axes.legend(frameon=False, fontsize=9)


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
    count = len(_COLOURS)
    return [(_COLOURS[i % count], styles[i // count % len(styles)]) for i in range(len(curves))]


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
    _save(figure, path)


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    draft = Path(path).with_suffix(".tmp.png")
    try:
        figure.savefig(draft)
        draft.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise disk_error("write the picture", path, error) from error
