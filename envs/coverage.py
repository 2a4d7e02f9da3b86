"""Coverage: how much of an environment has been seen, as MAX counts it.

**The metric.** Coverage is the number of distinct cells that any observation stored in the replay buffer lies in,
divided by the number of cells. It is cumulative over the whole run and never falls; it takes no evaluation rollout and
no agent. For the ant maze there are 7 cells, the free 2 m x 2 m squares of the maze, with borders at -1, 1, 3 and 5 m
on both axes (nnaisense/max, issue 3, the maintainer's answer: "# of visited blocks / total # of blocks (which is 7)").

- The observations are counted as they are stored: with observation noise if there is any.
- The observation *before* each step is counted (`Transition.obs`), the random warm-up steps included. So the successor
  of the last step of an episode, which is never an `obs`, is not counted.
- The start cell always counts: MAX reads the unused rows of its buffer, zeros, as the start cell. Here every episode
  begins in it, so the first stored transition sets it, and coverage is at least 1/7 from then on.
- An observation outside all cells (inside a wall, by noise) counts for nothing.
"""

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Coverage, EnvSpec
from jaxplore import validate
from jaxplore.types import Array
from jaxplore.validate import FieldError

MAX_CELLS = 1_000_000
"""Cells that a grid may have: a run keeps and saves one byte for each."""


def make_box_coverage(
    position: tuple[int, int], boxes: Sequence[tuple[float, float, float, float]], unit: str
) -> Coverage:
    """Cells that are axis-aligned boxes on the floor.

    Args:
        position: indices of x and y in the observation.
        boxes: `(x_min, y_min, x_max, y_max)` of each cell in metres. The lower borders belong to a cell.
        unit: what a cell is, for axis labels.
    """
    x_index, y_index = position

    def cell(obs: Array) -> Array:
        x_min, y_min, x_max, y_max = jnp.asarray(boxes, obs.dtype).T
        x, y = obs[x_index][None], obs[y_index][None]
        inside = (x_min <= x) & (x < x_max) & (y_min <= y) & (y < y_max)
        return jnp.where(inside.any(), jnp.argmax(inside), -1).astype(jnp.int32)

    return Coverage(len(boxes), cell, unit)


def make_grid_coverage(
    dims: Sequence[int],
    low: Sequence[float],
    high: Sequence[float],
    bins: int | Sequence[int],
    unit: str,
    *,
    clip: bool = True,
    reachable: int | None = None,
) -> Coverage:
    """Cells that are the boxes of a regular grid over some entries of the observation.

    Cells are numbered with the last entry's bin running fastest: with `bins` of 2 and 3, cell 4 is bin 1 of the first
    entry and bin 1 of the second. An observation with an entry of `dims` that is not finite lies in no cell.

    Args:
        dims: indices of the entries in the observation, each at most once.
        low: lower end of the grid along each entry, in the entry's own unit.
        high: upper end.
        bins: bins along each entry, or one number for all.
        unit: what a cell is, for axis labels.
        clip: whether a value beyond an end counts as in the bin at that end. Otherwise it lies in no cell; the lower
            border belongs to a bin, the upper one does not.
        reachable: how many of the cells can be reached, where that is known.

    Raises:
        FieldError: no entry, one that is negative or named twice, an end too many or too few or not finite, `low` not
            below `high`, `bins` below 1, or more than `MAX_CELLS` cells.

    Example:
        >>> import jax.numpy as jnp
        >>> grid = make_grid_coverage((0, 2), (0.0, -1.0), (1.0, 1.0), (2, 3), "boxes")
        >>> int(grid.cell(jnp.array([0.7, 9.0, 0.0]))), grid.num_cells
        (4, 6)
    """
    dims = tuple(dims)
    counts = (bins,) * len(dims) if isinstance(bins, int) else tuple(bins)
    if not dims or len(set(dims)) < len(dims):
        raise FieldError("dims", dims, "one or more entries of the observation, each once")
    for dim in dims:
        validate.at_least("dims", dim, 0)
    for name, values in (("low", low), ("high", high), ("bins", counts)):
        if len(values) != len(dims):
            raise FieldError(name, values, f"{len(dims)} numbers, one for each of dims={dims!r}")
    for count, lowest, highest in zip(counts, low, high, strict=True):
        validate.at_least("bins", count, 1)
        validate.in_range("low", lowest)
        validate.in_range("high", highest, lowest, open_low=True)
    if math.prod(counts) > MAX_CELLS:
        raise FieldError("bins", counts, f"at most {MAX_CELLS:,}", f"are {math.prod(counts):,} cells")
    borders = [np.linspace(*ends) for ends in zip(low, high, np.add(counts, 1).tolist(), strict=True)]

    def cell(obs: Array) -> Array:
        index, inside = jnp.int32(0), jnp.bool_(True)
        for dim, edges, count in zip(dims, borders, counts, strict=True):
            value = obs[dim]
            # How many borders lie at or below it: 0 below the grid, count + 1 above.
            passed = jnp.searchsorted(jnp.asarray(edges, obs.dtype), value, side="right").astype(jnp.int32)
            inside &= jnp.isfinite(value) & (clip | ((passed > 0) & (passed <= count)))
            index = index * count + jnp.clip(passed - 1, 0, count - 1)
        return jnp.where(inside, index, -1)

    return Coverage(math.prod(counts), cell, unit, reachable)


ENTRY_BINS = (50, 16, 8)
"""Bins along each entry of a grid over one, two or three of them."""
PROJECTION_BINS = 16
PROJECTION_SEED = 0


def make_entries_coverage(spec: EnvSpec, entries: Sequence[str] | Sequence[int]) -> Coverage:
    """Cells over one to three entries of the observation that a user names, of any environment.

    Each entry is brought to [-1, 1] and cut into equal bins, 50 for one entry, 16 x 16 for two, 8 x 8 x 8 for three. An
    entry x with known limits low and high becomes `2 (x - low) / (high - low) - 1`, beyond them -1 or 1; any other one
    becomes `2 / pi * arctan(x)`, so half of its bins lie between -1 and 1 in the entry's own unit. An observation with
    an entry that is not finite lies in no cell.

    Args:
        spec: the environment's; its `obs_limits` are the known limits.
        entries: indices of entries, from 0, or their names with or without the unit (`"x"` for `"x [m]"`).

    Raises:
        FieldError: no entry, more than three, one named twice, or one that there is not; with those that there are.
    """
    dims = tuple(_find_entry(spec, entry) for entry in entries)
    if not 1 <= len(dims) <= len(ENTRY_BINS) or len(set(dims)) < len(dims):
        raise FieldError("coverage_dims", tuple(entries), f"1 to {len(ENTRY_BINS)} entries, each once")
    bins, count = ENTRY_BINS[len(dims) - 1], len(dims)
    grid = make_grid_coverage(range(count), (-1.0,) * count, (1.0,) * count, bins, "cells", clip=True)
    squash = _make_squash(spec)
    unit = f"cells of {', '.join(spec.obs_names[dim] for dim in dims)}"
    return Coverage(grid.num_cells, lambda obs: grid.cell(squash(obs)[jnp.array(dims)]), unit)


def make_generic_coverage(spec: EnvSpec) -> Coverage:
    """Cells for an environment whose own are not known: 16 x 16 over a fixed random projection of the observation.

    Each entry is brought to [-1, 1] as in `make_entries_coverage`. The two directions are orthogonal, of length 1,
    and drawn once and for all from the number of entries: the same in every run. Projections are cut into 16 equal bins
    over [-1, 1] each; beyond that they count as in the outermost bin. How many of the 256 cells can be reached is not
    known, so coverage compares agents in one environment, not environments. With two entries or one nothing is
    projected, and where observations are one-hot the states themselves are counted.
    """
    if spec.one_hot_obs:
        return Coverage(spec.obs_size, lambda obs: jnp.argmax(obs).astype(jnp.int32), "states")
    if spec.obs_size <= 2:
        return make_entries_coverage(spec, range(spec.obs_size))
    random = np.random.RandomState(PROJECTION_SEED).standard_normal((spec.obs_size, 2))
    directions = np.linalg.qr(random)[0].T.astype(np.float32)
    squash = _make_squash(spec)
    grid = make_grid_coverage((0, 1), (-1.0, -1.0), (1.0, 1.0), PROJECTION_BINS, "cells", clip=True)
    return Coverage(
        grid.num_cells, lambda obs: grid.cell(jnp.asarray(directions) @ squash(obs)), "cells of a random projection"
    )


def _find_entry(spec: EnvSpec, entry: str | int) -> int:
    """The index of an entry of the observation."""
    if isinstance(entry, int) or entry.lstrip("-").isdecimal():
        if not 0 <= int(entry) < spec.obs_size:
            allowed = f"0 to {spec.obs_size - 1}, or names: {', '.join(spec.obs_names)}"
            raise FieldError("coverage_dims", entry, allowed, "is out of range")
        return int(entry)
    if entry in spec.obs_names:
        return spec.obs_names.index(entry)
    bare = [name.partition(" [")[0] for name in spec.obs_names]
    validate.one_of("coverage_dims", entry, bare)
    return bare.index(entry)


def _make_squash(spec: EnvSpec) -> Callable[[Array], Array]:
    """`squash(obs [O]) -> [O]`, each entry in [-1, 1]."""
    low, high = np.array(spec.obs_limits or [(-np.inf, np.inf)] * spec.obs_size, np.float64).T
    # Limits as wide as numbers go are none.
    known = (low < high) & (np.maximum(np.abs(low), np.abs(high)) < 1e6)
    low, high = np.where(known, low, -1.0), np.where(known, high, 1.0)
    centre, half = ((low + high) / 2).astype(np.float32), ((high - low) / 2).astype(np.float32)

    def squash(obs: Array) -> Array:
        scaled = (obs - centre) / half
        # Clipped before a value that is not finite could pass for the outermost; such a one stays what it is.
        squashed = jnp.where(known, jnp.clip(scaled, -1.0, 1.0), 2 / jnp.pi * jnp.arctan(scaled))
        return jnp.where(jnp.isfinite(obs), squashed, jnp.nan)

    return squash


def init(coverage: Coverage) -> Array:
    """Nothing seen yet: False, bool `[num_cells]`."""
    return jnp.zeros(coverage.num_cells, bool)


def update(visited: Array, cells: Array) -> Array:
    """Marks `cells` (int of any shape, 0 to num_cells - 1, or -1 for outside of all) in `visited` `[num_cells]`."""
    outside = visited.size
    return visited.at[jnp.where(cells < 0, outside, cells)].set(True, mode="drop")


def update_from_obs(coverage: Coverage, visited: Array, obs: Array) -> Array:
    """Marks the cells that stored observations `[..., O]` lie in. Returns `visited`, bool `[num_cells]`."""
    return update(visited, jax.vmap(coverage.cell)(obs.reshape(-1, obs.shape[-1])))


def fraction(visited: Array) -> Array:
    """The share of cells visited, 0 to 1, float32: the paper's exploration ratio. `visited` is `[num_cells]`."""
    return visited.mean(dtype=jnp.float32)
