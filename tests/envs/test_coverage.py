import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import coverage
from envs.ant_maze import CELLS, POSITION, SPEC
from envs.base import Coverage, EnvSpec

MAZE = coverage.make_box_coverage(POSITION, CELLS, "maze cells")
CENTRES = [(0, 0), (2, 0), (4, 0), (4, 2), (4, 4), (2, 4), (0, 4)]


def obs_at(points) -> jax.Array:
    """Observations `[T, 31]` whose x and y are `points`."""
    points = jnp.asarray(points, jnp.float32)
    return jnp.full((len(points), SPEC.obs_size), 9.0).at[:, 2:4].set(points)


@pytest.mark.parametrize(("index", "centre"), list(enumerate(CENTRES)))
def test_cells_are_numbered_from_the_start_along_the_corridor(index, centre):
    assert MAZE.cell(obs_at([centre])[0]) == index


@pytest.mark.parametrize(
    ("point", "cell"),
    [
        ((-0.999, -0.999), 0),
        ((0.999, 0.999), 0),
        ((1.0, 0.0), 1),  # the lower border belongs to the cell
        ((3.0, 0.999), 2),
        ((3.0, 1.0), 3),
        ((4.999, 4.999), 4),
        ((2.999, 1.5), -1),  # the wall between the arms
        ((0.0, 2.0), -1),
        ((5.0, 0.0), -1),
        ((0.0, -1.001), -1),
        ((np.nan, 0.0), -1),
        ((np.inf, 0.0), -1),
    ],
)
def test_borders_lie_at_minus_1_1_3_and_5(point, cell):
    assert MAZE.cell(obs_at([point])[0]) == cell


def test_cell_is_int32_under_jit_and_vmap():
    cells = jax.jit(jax.vmap(MAZE.cell))(obs_at(CENTRES))
    assert cells.dtype == jnp.int32
    np.testing.assert_array_equal(cells, range(7))


def test_scripted_path_counts_each_cell_once():
    path = obs_at([(0, 0), (0.5, 0.5), (2, 0), (0, 0), (2, 2), (4, 0), (4, 2), (9, 9)])
    visited, fractions = coverage.init(MAZE), []
    for obs in path:
        visited = coverage.update_from_obs(MAZE, visited, obs)
        fractions.append(float(coverage.fraction(visited)))
    np.testing.assert_allclose(fractions, np.array([1, 1, 2, 2, 2, 3, 4, 4]) / 7, rtol=1e-6)
    np.testing.assert_array_equal(visited, [True, True, True, True, False, False, False])


def test_a_batch_counts_as_its_observations_one_by_one():
    key = jax.random.key(0)
    batch = obs_at(jax.random.uniform(key, (60, 2), minval=-3.0, maxval=7.0))
    one_by_one = coverage.init(MAZE)
    for obs in batch:
        one_by_one = coverage.update(one_by_one, MAZE.cell(obs))
    at_once = jax.jit(lambda obs: coverage.update_from_obs(MAZE, coverage.init(MAZE), obs))(batch.reshape(6, 10, -1))
    np.testing.assert_array_equal(at_once, one_by_one)


def test_outside_marks_nothing_and_no_cell_is_ever_forgotten():
    visited = coverage.update(coverage.init(MAZE), jnp.array([6]))
    np.testing.assert_array_equal(coverage.update(visited, jnp.array([-1, -1])), visited)


def test_nothing_seen_is_0_and_everything_seen_is_1():
    small = Coverage(3, lambda obs: jnp.int32(0), "cells")
    visited = coverage.init(small)
    assert visited.shape == (3,)
    assert visited.dtype == bool
    assert coverage.fraction(visited) == 0
    assert coverage.fraction(coverage.update(visited, jnp.arange(3))) == 1


def test_full_tour_of_the_corridor_is_7_of_7():
    visited = coverage.update_from_obs(MAZE, coverage.init(MAZE), obs_at(CENTRES))
    assert coverage.fraction(visited) == 1


def brute_force(obs, dims, low, high, bins, clip):
    """The cell by the definition, in NumPy and one entry at a time."""
    index = []
    for dim, lowest, highest, count in zip(dims, low, high, bins, strict=True):
        i = int(np.floor((obs[dim] - lowest) / (highest - lowest) * count))
        if not clip and not 0 <= i < count:
            return -1
        index.append(min(max(i, 0), count - 1))
    return int(np.ravel_multi_index(index, bins))


@pytest.mark.parametrize("clip", [True, False])
def test_grid_cells_are_the_bins_of_each_entry(clip):
    # 3 entries of 5 with borders that are no round numbers; half of the points lie beyond an end
    grid = ((3, 0, 4), (-1.7, 0.3, -9.1), (2.2, 0.9, -1.0), (4, 3, 5))
    points = np.random.default_rng(0).uniform(-1, 1, (400, 5)).astype(np.float32) * np.array([2, 9, 9, 4, 12])
    cover = coverage.make_grid_coverage(*grid, "boxes", clip=clip)
    got = jax.jit(jax.vmap(cover.cell))(jnp.asarray(points, jnp.float32))
    np.testing.assert_array_equal(got, [brute_force(obs, *grid, clip) for obs in points])
    assert got.dtype == jnp.int32
    assert cover.num_cells == 60
    assert ((np.asarray(got) == -1).mean() > 0.5) == (not clip)


@pytest.mark.parametrize(
    ("value", "clipped", "outside"),
    [(-1.001, 0, -1), (-1.0, 0, 0), (-0.001, 0, 0), (0.0, 1, 1), (0.999, 1, 1), (1.0, 1, -1), (1e30, 1, -1)],
)
def test_grid_borders(value, clipped, outside):
    # the lower border belongs to a bin, the upper one to the next
    for clip, cell in ((True, clipped), (False, outside)):
        grid = coverage.make_grid_coverage((0,), (-1.0,), (1.0,), 2, "halves", clip=clip)
        assert grid.cell(jnp.array([value])) == cell


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_grid_puts_what_is_not_finite_nowhere(value):
    grid = coverage.make_grid_coverage((0, 1), (0.0, 0.0), (1.0, 1.0), 2, "boxes")
    assert grid.cell(jnp.array([0.5, value])) == -1
    assert grid.cell(jnp.array([value, 0.5])) == -1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dims": ()}, r"dims=\(\)\. Allowed: one or more"),
        ({"dims": (1, 1)}, r"dims=\(1, 1\)\. Allowed: .* each once"),
        ({"dims": (0, -1)}, "dims=-1 is out of range"),
        ({"low": (0.0,)}, r"low=\(0\.0,\)\. Allowed: 2 numbers"),
        ({"bins": (2, 2, 2)}, r"bins=\(2, 2, 2\)\. Allowed: 2 numbers"),
        ({"bins": (2, 0)}, "bins=0 is out of range. Allowed: a whole number, 1 or more"),
        ({"low": (0.0, np.inf)}, "low=inf is out of range"),
        ({"high": (1.0, 0.0)}, r"high=0\.0 is out of range\. Allowed: a finite number in \(0"),
        ({"bins": 1001}, r"bins=\(1001, 1001\) are 1,002,001 cells\. Allowed: at most 1,000,000"),
    ],
)
def test_bad_grids_are_refused(change, message):
    good = {"dims": (0, 1), "low": (0.0, 0.0), "high": (1.0, 1.0), "bins": 2, "unit": "boxes"}
    with pytest.raises(ValueError, match=message):
        coverage.make_grid_coverage(**{**good, **change})


def make_spec(size, limits=None, one_hot_obs=False):
    names = tuple(f"{chr(ord('a') + i)} [m]" for i in range(size))
    return EnvSpec("made up", names, ("push",), 10, 0.1, one_hot_obs=one_hot_obs, obs_limits=limits)


def test_named_entries_are_cut_between_their_limits_or_by_their_arctangent():
    spec = make_spec(4, ((0.0, 8.0), (-np.inf, np.inf), (-1.0, 1.0), (0.0, 1.0)))
    grid = coverage.make_entries_coverage(spec, ("0", "b"))
    assert (grid.num_cells, grid.unit) == (16 * 16, "cells of a [m], b [m]")
    for a, b, cell in (
        (0.1, -99.0, 0),
        (0.4, -99.0, 0),
        (0.6, -99.0, 16),  # a bin of the first entry is 0.5 m
        (-5.0, -99.0, 0),  # beyond a limit is the limit
        (99.0, 99.0, 255),
        (0.1, -0.99, 4),  # half of the bins lie between -1 and 1
        (0.1, 0.99, 11),
        (0.1, np.nan, -1),
        (np.inf, 0.0, -1),
    ):
        obs = jnp.array([a, b, 0.3, 0.4])
        assert grid.cell(obs) == coverage.make_entries_coverage(spec, (0, 1)).cell(obs) == cell, (a, b)
    assert coverage.make_entries_coverage(spec, ("d [m]",)).num_cells == 50
    assert coverage.make_entries_coverage(spec, (3, 0, 1)).num_cells == 8**3


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (("4",), r"coverage_dims='4' is out of range\. Allowed: 0 to 3, or names: a \[m\], b"),
        ((-1,), "coverage_dims=-1 is out of range"),
        (("aa",), r"coverage_dims='aa' is not known\. Did you mean 'a'\? Allowed: a, b, c, d"),
        ((), r"coverage_dims=\(\)\. Allowed: 1 to 3 entries, each once"),
        (("0", "a"), r"Allowed: 1 to 3 entries, each once"),
        ((0, 1, 2, 3), r"Allowed: 1 to 3 entries, each once"),
    ],
)
def test_entries_that_are_not_there_are_refused(entries, message):
    with pytest.raises(ValueError, match=message):
        coverage.make_entries_coverage(make_spec(4), entries)


def test_the_generic_coverage_is_one_fixed_projection():
    grid, again = (coverage.make_generic_coverage(make_spec(20)) for _ in range(2))
    assert grid.num_cells == 256
    obs = jax.random.normal(jax.random.key(0), (500, 20))
    cells = jax.vmap(grid.cell)(obs)
    np.testing.assert_array_equal(cells, jax.vmap(again.cell)(obs))
    assert cells.min() >= 0
    assert len(np.unique(cells)) > 60
    # The middle of all entries is the middle of the grid, where four cells meet.
    near = jax.vmap(grid.cell)(0.01 * obs)
    assert set(np.unique(near)) == {7 * 16 + 7, 7 * 16 + 8, 8 * 16 + 7, 8 * 16 + 8}
    assert grid.cell(obs[0].at[3].set(jnp.nan)) == grid.cell(obs[0].at[3].set(jnp.inf)) == -1


def test_where_little_is_seen_nothing_is_projected():
    two = coverage.make_generic_coverage(make_spec(2))
    assert (two.num_cells, two.unit) == (256, "cells of a [m], b [m]")
    assert coverage.make_generic_coverage(make_spec(1)).num_cells == 50
    states = coverage.make_generic_coverage(make_spec(5, one_hot_obs=True))
    assert (states.num_cells, int(states.cell(jnp.eye(5)[3]))) == (5, 3)
