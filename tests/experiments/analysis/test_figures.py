from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from envs.base import FloorPlan
from experiments.analysis.figures import (
    Curves,
    Reliability,
    plot_calibration,
    plot_coverage,
    plot_intrinsic_reward,
    plot_visitation,
)
from experiments.analysis.figures.curves import _smooth
from experiments.runs.errors import RunError
from experiments.runs.scene import Cells

COVERAGE = Cells(3, "maze cells")
PLAN = FloorPlan(
    position=(0, 1),
    walls=((-3.0, 1.0, 5.0, 3.0), (-3.0, -3.0, 5.0, -1.0)),
    cells=((-1.0, -1.0, 1.0, 1.0), (1.0, -1.0, 3.0, 1.0), (3.0, -1.0, 5.0, 1.0)),
)
STEPS = np.arange(25, 1001, 25)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are saved."""
    saved: list[Figure] = []
    original = Figure.savefig

    def savefig(self: Figure, *args: Any, **kwargs: Any) -> None:
        original(self, *args, **kwargs)
        saved.append(self)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return saved


def seeds(count: int) -> np.ndarray:
    return np.stack([np.minimum(3, 1 + STEPS // (300 + 50 * seed)) / 3 for seed in range(count)])


def check_legends(figure: Figure) -> list[str]:
    """No legend covers any axes, which is where curves are, or another legend; gives what they name."""
    parts = [figure, *figure.subfigs]
    legends = [*(legend for part in parts for legend in part.legends)]
    legends += [legend for axes in figure.axes if (legend := axes.get_legend()) is not None]
    boxes = [legend.get_window_extent() for legend in legends]
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
        assert not any(box.overlaps(axes.xaxis.label.get_window_extent()) for axes in figure.axes)
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, "cut off"
    return [text.get_text() for legend in legends for text in legend.get_texts()]


def check_picture(path: Path, width: int) -> np.ndarray:
    """A picture of at least `width` pixels that is neither blank nor cut off at its edges."""
    pixels = imread(path)[..., :3]
    assert pixels.shape[1] >= width
    assert 0.01 < (pixels.mean(-1) < 0.95).mean() < 0.9
    for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
        assert (edge == 1).all(), "something touches the edge"
    assert [entry.name for entry in path.parent.glob("*.tmp*")] == []
    return pixels


def test_coverage_of_one_seed(tmp_path: Path, figures: list[Figure]):
    plot_coverage(tmp_path / "c.png", [Curves("implicit", STEPS, seeds(1))], COVERAGE)
    check_picture(tmp_path / "c.png", 1000)
    (axes,) = figures[0].axes
    assert check_legends(figures[0]) == ["implicit, n = 1"]
    assert axes.get_xlim() == (0, 1000)


def test_coverage_of_several_seeds_and_methods(tmp_path: Path, figures: list[Figure]):
    groups = [Curves("implicit", STEPS, seeds(5)), Curves("random", STEPS, seeds(3) / 2)]
    plot_coverage(tmp_path / "c.png", groups, COVERAGE, title="Ant maze")
    check_picture(tmp_path / "c.png", 1000)
    (axes,) = figures[0].axes
    bold = {line.get_label(): line for line in axes.lines if not str(line.get_label()).startswith("_")}
    assert list(bold) == ["implicit, median of n = 5", "random, median of n = 3"]
    np.testing.assert_array_equal(bold["implicit, median of n = 5"].get_ydata(), seeds(5)[2])
    assert len(axes.lines) == 5 + 3 + 2 + COVERAGE.num_cells
    assert axes.get_title(loc="left") == "Ant maze"


def test_visitation_has_a_panel_per_quarter(tmp_path: Path, figures: list[Figure]):
    rng = np.random.default_rng(0)
    position = np.cumsum(rng.normal(size=(1000, 2)) * 0.02, axis=0).clip([-1, -1], [5, 1])
    age = 1 + np.arange(1000) % 300
    plot_visitation(tmp_path / "v.png", (position, age), [1, 1, 2, 3], PLAN, COVERAGE)
    check_picture(tmp_path / "v.png", 1500)
    *panels, bar = figures[0].axes
    assert [axes.get_title(loc="left") for axes in panels] == ["250 steps", "500 steps", "750 steps", "1,000 steps"]
    assert [axes.get_title(loc="right") for axes in panels] == [f"{n} of 3 maze cells" for n in (1, 1, 2, 3)]
    assert bar.get_ylabel() == "step of the episode"
    assert [axes.get_xlabel() for axes in panels] == ["x (m)"] * 4
    assert [axes.get_ylabel() for axes in panels] == ["y (m)", "", "", ""]
    for axes in panels:
        metres = [tick for tick in axes.get_xticks() if axes.get_xlim()[0] < tick < axes.get_xlim()[1]]
        shown = [text.get_text().replace("\N{MINUS SIGN}", "-") for text in axes.get_xticklabels()]
        assert len(metres) >= 3 and {f"{tick:g}" for tick in metres} <= set(shown)
    for count, axes in zip((250, 500, 750, 1000), panels, strict=True):
        walls, _, points = axes.collections
        assert axes.get_aspect() == 1
        assert len(walls.get_paths()) == 2
        shown = np.asarray(points.get_offsets())
        np.testing.assert_array_equal(np.sort(shown, axis=0), np.sort(position[:count], axis=0))
        colours = points.get_cmap()(points.norm(np.array([1, 300])))
        assert colours[0, 2] > 0.8 > 0.2 > colours[0, 0], "early is blue"
        assert colours[1, 0] > 0.8 > 0.2 > colours[1, 2], "late is red"


@pytest.mark.parametrize(
    ("positions", "ages", "cells", "message"),
    [
        (np.zeros((5, 3)), np.zeros(5), [1], "positions"),
        (np.zeros((5, 2)), np.zeros(4), [1], "episode_steps"),
        (np.zeros((3, 2)), np.zeros(3), [1, 1, 1, 1], "cells_seen"),
        (np.zeros((3, 2)), np.zeros(3), [], "cells_seen"),
    ],
)
def test_visitation_refuses_what_does_not_match(
    tmp_path: Path, positions: np.ndarray, ages: np.ndarray, cells: list[int], message: str
):
    with pytest.raises(ValueError, match=message):
        plot_visitation(tmp_path / "v.png", (positions, ages), cells, PLAN, COVERAGE)


@pytest.mark.parametrize(("decay", "scale"), [(100.0, "log"), (1e6, "linear")])
def test_intrinsic_reward_chooses_its_scale(tmp_path: Path, figures: list[Figure], decay: float, scale: str):
    values = np.exp(-STEPS / decay)[None].repeat(3, 0)
    values[:, :2] = np.nan
    plot_intrinsic_reward(tmp_path / "r.png", [Curves("implicit", STEPS, values)])
    check_picture(tmp_path / "r.png", 1000)
    (axes,) = figures[0].axes
    assert axes.get_yscale() == scale
    assert len(axes.lines) == 4


@pytest.mark.parametrize("decades", [2, 4, 10, 30])
@pytest.mark.parametrize("count", [1, 9])
def test_a_log_axis_has_numbers(tmp_path: Path, figures: list[Figure], decades: int, count: int):
    values = np.geomspace(10.0**-decades, 1, len(STEPS))[None]
    plot_intrinsic_reward(tmp_path / "r.png", [Curves(f"{i}", STEPS, values) for i in range(count)])
    axes = figures[0].axes[0]
    low, high = axes.get_ylim()
    assert sum(low <= tick <= high for tick in axes.get_yticks()) >= 2


def test_intrinsic_reward_that_does_not_exist_says_so(tmp_path: Path, figures: list[Figure]):
    plot_intrinsic_reward(tmp_path / "r.png", [Curves("random", STEPS, np.full((2, len(STEPS)), np.nan))])
    assert [text.get_text() for text in figures[0].axes[0].texts] == ["this method has no intrinsic reward"]
    assert (tmp_path / "r.png").exists()


@pytest.mark.parametrize("value", [0.0, 1.0, -1.0])
def test_constant_rewards_and_single_rows_are_drawn(tmp_path: Path, value: float):
    plot_intrinsic_reward(tmp_path / "r.png", [Curves("a", STEPS, np.full((1, len(STEPS)), value))])
    plot_intrinsic_reward(tmp_path / "s.png", [Curves("a", STEPS[:1], np.full((1, 1), value))])
    plot_coverage(tmp_path / "c.png", [Curves("a", STEPS[:1], np.full((1, 1), 0.5))], COVERAGE)


def test_smoothing_is_the_mean_of_what_is_there():
    values = np.array([np.nan, 1.0, 3.0, np.nan, 5.0, 1.0])
    np.testing.assert_allclose(_smooth(values, 3), [np.nan, 2, 2, np.nan, 3, 3])
    np.testing.assert_array_equal(_smooth(values, 1), values)
    np.testing.assert_allclose(_smooth(np.array([2.0]), 1), [2])


@pytest.mark.parametrize("values", [np.zeros(40), np.zeros((2, 39)), np.zeros((0, 40))])
def test_curves_of_the_wrong_shape_are_named(tmp_path: Path, values: np.ndarray):
    with pytest.raises(ValueError, match="implicit: values"):
        plot_coverage(tmp_path / "c.png", [Curves("implicit", STEPS, values)], COVERAGE)
    with pytest.raises(ValueError, match="nothing to draw"):
        plot_intrinsic_reward(tmp_path / "c.png", [])


def test_unwritable_pictures_are_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"c\.png"):
        plot_coverage(tmp_path / "file" / "c.png", [Curves("implicit", STEPS, seeds(1))], COVERAGE)


QUICK = {(1, 2), (2, None), (4, None), (5, 2), (8, None), (8, 2), (9, None), (25, 2)}
"""Each number of curves, and each form of the legend, once; the other pairs are slow together."""


@pytest.mark.parametrize(
    ("count", "reachable"),
    [
        pytest.param(count, reachable, marks=[] if (count, reachable) in QUICK else [pytest.mark.slow])
        for count in (1, 2, 4, 5, 8, 9, 25)
        for reachable in (None, 2)
    ],
)
def test_no_legend_covers_a_curve(tmp_path: Path, figures: list[Figure], count: int, reachable: int | None):
    # Curves that leave no corner free.
    values = np.stack([np.linspace(0, 1, len(STEPS)), np.linspace(1, 0, len(STEPS))])
    curves = [Curves(f"method_{i}", STEPS, values) for i in range(count)]
    plot_coverage(tmp_path / "c.png", curves, Cells(3, "maze cells", reachable), episode_steps=100, title="Ant maze")
    plot_intrinsic_reward(tmp_path / "r.png", curves, title="Ant maze")
    coverage, reward = map(check_legends, figures)
    assert len(coverage) == len(reward) + (reachable is not None)
    assert len(reward) == (count if count <= 8 else 3)


@pytest.mark.parametrize("cells", [False, True])
def test_calibration_has_its_legends_below(tmp_path: Path, figures: list[Figure], cells: bool):
    variance = np.geomspace(0.01, 10, 200)
    names = ("its data", "new steps of its own", "elsewhere, seen before", "elsewhere, never seen")
    groups = [Reliability(name, variance, variance[:: 1 if i % 2 else -1]) for i, name in enumerate(names)]
    by_cell = [{"cell": i, "seen": i < 4, "variance": 1.0 + i, "error": None if i == 2 else 2.0} for i in range(7)]
    plot_calibration(tmp_path / "c.png", groups, by_cell if cells else None, unit="normalised delta, squared")
    check_picture(tmp_path / "c.png", 1500)
    named = check_legends(figures[0])
    assert named[:4] == [f"{name}, n = 200" for name in names]
    assert named[4:] == (["variance of the models", "squared error of their mean"] if cells else list(names))


def test_eight_groups_share_a_picture_and_are_named_beside_it(tmp_path: Path, figures: list[Figure]):
    steps = np.arange(1, 5) * 25
    curves = [Curves(f"method {i}", steps, np.full((2, 4), i / 10)) for i in range(8)]
    plot_coverage(tmp_path / "c.png", curves, COVERAGE)
    check_picture(tmp_path / "c.png", 1500)
    (axes,) = figures[0].axes
    bold = [line for line in axes.get_lines() if str(line.get_label()).startswith("method")]
    assert len({(line.get_color(), line.get_linestyle()) for line in bold}) == 8
    assert check_legends(figures[0]) == [f"method {i}, 2" for i in range(8)]
    (legend,) = figures[0].legends
    assert legend.get_title().get_text() == "median, of so many seeds"


@pytest.mark.parametrize("plot", ["coverage", "reward"])
def test_more_than_eight_groups_have_a_panel_each(tmp_path: Path, figures: list[Figure], plot: str):
    steps = np.arange(1, 5) * 25
    curves = [Curves(f"method {i}", steps, np.array([[0.0], [i / 20], [1.0]]) * np.ones(4)) for i in range(17)]
    if plot == "coverage":
        plot_coverage(tmp_path / "c.png", curves, COVERAGE, title="acrobot")
    else:
        plot_intrinsic_reward(tmp_path / "c.png", curves, title="acrobot")
    check_picture(tmp_path / "c.png", 1500)
    panels = [axes for axes in figures[0].axes if axes.axison]
    assert [axes.get_title(loc="left") for axes in panels] == [f"method {i}, n = 3" for i in range(17)]
    for i, axes in enumerate(panels):
        (bold,) = [line for line in axes.get_lines() if line.get_linewidth() > 2]
        np.testing.assert_allclose(bold.get_ydata(), i / 20)
        grey = [line for line in axes.get_lines() if line.get_color() == "#c8c8c8"]
        assert sorted(float(np.asarray(line.get_ydata())[0]) for line in grey) == [j / 20 for j in range(17) if j != i]
        assert (axes.get_xlim(), axes.get_ylim()) == (panels[0].get_xlim(), panels[0].get_ylim())
    # The lowest of each column says what steps are.
    assert [bool(axes.get_xlabel()) for axes in panels] == [False] * 12 + [True] * 5
    assert check_legends(figures[0]) == ["median", "each seed", "medians of the others"]
