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

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from envs.base import Coverage
from jaxplore.types import Array


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
