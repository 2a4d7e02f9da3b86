"""Curves over a run: coverage, and intrinsic reward, a line per seed."""

import os
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, PercentFormatter

from experiments.analysis.figures import panels as layout
from experiments.analysis.figures.panels import Curves, draw_lines, finish, name_of, panels_of
from experiments.analysis.figures.style import FEW_CELLS, SOFT, STYLE
from experiments.analysis.intervals import interval
from experiments.runs.scene import Cells

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
    """Draws how much has been seen against environment steps: a thin line per seed, their median in bold.

    Args:
        path: of the PNG to write.
        curves: fractions seen, 0 to 1: one group of lines for a run, several to compare methods; many get a panel each.
        coverage: of the environment; what a cell is called and how many there are.
        episode_steps: of a whole episode; given, and few enough, episodes are counted along the top.
        title: above the picture.

    Raises:
        ValueError: `curves` is empty, or its shapes do not match.
        RunError: the file cannot be written.
    """
    _check(curves)
    with matplotlib.rc_context(STYLE):
        figure, panels = panels_of(curves)
        # A value holds until the next one is known: coverage goes up in steps.
        draw_lines(
            panels,
            lambda group: np.median(group.values, axis=0),
            lambda group: name_of(group, curves),
            drawstyle="steps-post",
        )
        few = coverage.num_cells <= FEW_CELLS
        for axes, *_ in panels:
            axes.set_ylim(0, 1.04)
            axes.yaxis.set_major_locator(FixedLocator([0, 0.2, 0.4, 0.6, 0.8, 1] if len(panels) == 1 else [0, 0.5, 1]))
            axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
            if coverage.reachable is not None:
                label = f"all {coverage.reachable:,} that can be reached"
                height = coverage.reachable / coverage.num_cells
                axes.axhline(height, color="#666666", linewidth=1.2, linestyle="--", label=label)
            # With few cells, coverage can only stand on these lines.
            for count in range(1, coverage.num_cells + 1) if few else ():
                axes.axhline(count / coverage.num_cells, color="#e4e4e4", linewidth=0.7, zorder=0)
        if len(panels) == 1:
            steps = max(group.steps[-1] for group in curves)
            if episode_steps and steps <= MOST_EPISODES * episode_steps:
                _count_episodes(panels[0].axes, episode_steps)
            if few:
                _count_cells(panels[0].axes, coverage)
        quantity = "explored" if few else f"explored, of {coverage.num_cells:,} {coverage.unit}"
        if few and len(panels) > 1:
            quantity = f"explored, a line for each of {coverage.num_cells} {coverage.unit}"
        finish(path, figure, panels, quantity=quantity, title=title)


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
        figure, panels = panels_of(curves)
        draw_lines(
            panels,
            lambda group: _smooth(_median(group.values), _window(group)),
            lambda group: name_of(group, curves) + _smoothed(group, curves),
        )
        for axes, *_ in panels:
            _grid(axes)
        drawn = np.concatenate([group.values[np.isfinite(group.values)] for group in curves])
        # All panels have the same axis.
        _scale(panels[0].axes, drawn)
        finish(path, figure, panels, quantity=unit, title=title)


def plot_return(path: str | os.PathLike[str], curves: Sequence[Curves], *, title: str | None = None) -> None:
    """Draws returns against environment steps: a thin line per seed, their mean in bold, and around it its 95 %
    interval (Student's t), where there are several seeds.

    Args:
        path: of the PNG to write.
        curves: returns of evaluations, a group of lines for each method.
        title: above the picture.

    Raises:
        ValueError: `curves` is empty, or its shapes do not match.
        RunError: the file cannot be written.
    """
    _check(curves)
    with matplotlib.rc_context(STYLE):
        figure, panels = panels_of(curves)
        draw_lines(
            panels,
            lambda group: np.mean(group.values, axis=0),
            lambda group: name_of(group, curves, "mean"),
        )
        for axes, own, _ in panels:
            bold = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
            for line, group in zip(bold, own, strict=True):
                low, high = _t_bounds(group.values)
                axes.fill_between(group.steps, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
            _grid(axes)
        finish(path, figure, panels, quantity="return", title=title, middle="mean")


def _grid(axes: Axes) -> None:
    axes.grid(axis="y", color="#e4e4e4", linewidth=0.7)
    axes.set_axisbelow(True)


def _t_bounds(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the 95 % interval around the mean over seeds, `[S, T] -> [T], [T]`; of one seed the mean itself."""
    found = [interval(column) for column in values.T]
    mean, error = (np.array([one[i] or 0.0 for one in found]) for i in range(2))
    return mean - error, mean + error


def _count_episodes(axes: Axes, length: int) -> None:
    episodes = axes.secondary_xaxis(
        "top", functions=(lambda step: np.divide(step, length), lambda count: np.multiply(count, length))
    )
    episodes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    episodes.set_xlabel("episodes")
    episodes.tick_params(length=2)
    episodes.spines["top"].set_visible(False)


def _count_cells(axes: Axes, coverage: Cells) -> None:
    """Naming the lines that coverage can stand on saves the reader a division."""
    cells = coverage.num_cells
    counts = axes.secondary_yaxis(
        "right", functions=(lambda share: np.multiply(share, cells), lambda count: np.divide(count, cells))
    )
    counts.yaxis.set_major_locator(FixedLocator(list(range(cells + 1))))
    counts.set_ylabel(f"{coverage.unit} seen")
    counts.tick_params(length=0)
    counts.spines["right"].set_visible(False)


def _scale(axes: Axes, drawn: np.ndarray) -> None:
    """A log axis where values spread far, else one from 0."""
    positive = drawn[drawn > 0]
    if not len(drawn):
        axes.set_yticks([])
        axes.text(0.5, 0.5, "this method has no intrinsic reward", ha="center", color=SOFT, transform=axes.transAxes)
    elif len(positive) and np.quantile(positive, 0.98) > 30 * np.quantile(positive, 0.02):
        axes.set_yscale("log", nonpositive="mask")
        # Over many decades, only they are named.
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if positive.max() < 1e4 * positive.min() else (1,)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(bottom=min(0.0, drawn.min()))


def _check(curves: Sequence[Curves]) -> None:
    if not curves:
        raise ValueError("curves: nothing to draw")
    for group in curves:
        values, steps = np.shape(group.values), np.shape(group.steps)
        if len(values) != 2 or not values[0] or values[1:] != steps:
            raise ValueError(f"{group.label}: values {values} and steps {steps} must be [S, T] and [T]")


def _window(group: Curves) -> int:
    """Rounds, an odd number, that a bold value is the mean of."""
    return len(group.steps) // 50 * 2 + 1


def _smoothed(group: Curves, curves: Sequence[Curves]) -> str:
    window = _window(group)
    many = layout.MOST_BELOW < len(curves) <= layout.MOST_IN_PICTURE
    return f" (bold: mean of {window} rounds)" if window > 1 and not many else ""


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
