"""Finished runs read back from their directories."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.runs.config import RunConfig
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.rows import check, in_order
from experiments.runs.scene import Scene
from experiments.runs.schedule import gap
from experiments.runs.status import Status
from jaxplore.validate import FieldError


class LoadedRun(NamedTuple):
    """A run, or its first steps as if it had ended there. Steps count those of its parents."""

    directory: RunDirectory
    config: RunConfig
    rows: list[dict[str, Any]]
    scene: Scene
    before: int = 0
    """Steps of its parents, which are counted in `config.steps` and in every row."""


def load(path: Path, until: int | None = None) -> LoadedRun:
    """A finished run, or its first `until` steps, those of its parents included.

    Raises:
        RunError: `path` holds no run, or one that has not come that far.
        ValueError: its configuration is damaged.
    """
    directory = RunDirectory(path)
    spec, rows = directory.spec(), directory.rows()
    config, before = spec.config, spec.parent.steps if spec.parent else 0
    if until is not None and until <= before:
        raise RunError(f"{path} begins after {before} steps of its parents. Compare with --until={before + 1} or more.")
    wanted = until - before if until else config.steps
    last = max((row["step"] for row in rows), default=0)
    status = directory.status()
    if status is Status.DIVERGED and last < wanted:
        raise RunError(f"{path} diverged at step {last}, before step {wanted}. Compare with --until={last} or less.")
    if last < wanted and status is not Status.FINISHED:
        raise RunError(f"{path} stands at step {last} of {wanted}. Finish it with --resume first.")
    damage = gap(config, rows, wanted)
    if damage is not None:
        raise RunError(
            f"{directory.metrics_path} {damage[1]}. What to do: put back a copy of the file, or compare with "
            f"--until={damage[0]} or less."
        )
    scene = scene_of(directory)
    for row in rows:
        try:
            check(row, scene.coverage.num_cells)
        except FieldError as error:
            raise RunError(
                f"{directory.metrics_path}, step {row['step']} of seed {row['seed']}: {error} What to do: put back a "
                "copy of the file."
            ) from error
    rows = [{**row, "step": row["step"] + before} for row in rows if row["step"] <= wanted]
    return LoadedRun(directory, dataclasses.replace(config, steps=wanted + before), rows, scene, before)


def scene_of(directory: RunDirectory) -> Scene:
    """What reports must know of a run's environment; of a run from before that was saved, by building it.

    Raises:
        RunError: there is no run, or its file is damaged.
        ValueError: its environment cannot be built here.
    """
    saved = directory.scene()
    if saved is not None:
        return saved
    from experiments.training import build

    config = directory.config()
    env = build.make_env(config)
    return build.make_scene(config, env, build.make_agent(config, env))


def series(rows: Sequence[dict[str, Any]], field: str) -> tuple[np.ndarray, np.ndarray]:
    """One field of a run's rows: `(steps [T], values [S, T])`, NaN where a row has none."""
    steps = sorted({row["step"] for row in rows})
    seeds = sorted({row["seed"] for row in rows})
    values = np.full((len(seeds), len(steps)), np.nan)
    column = {step: t for t, step in enumerate(steps)}
    line = {seed: i for i, seed in enumerate(seeds)}
    for row in rows:
        if row.get(field) is not None:
            values[line[row["seed"]], column[row["step"]]] = row[field]
    return np.array(steps), values


def held(values: np.ndarray) -> np.ndarray:
    """Values `[S, T]` with the last one that there was in place of each NaN that comes later.

    A seed that diverged has no rows from then on: what it has seen by then, it has seen.
    """
    at = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.take_along_axis(values, np.maximum.accumulate(at, axis=1), axis=1)


def columns(
    runs: Sequence[Path], names: Sequence[str | None] | None = None, until: int | None = None
) -> dict[str, np.ndarray]:
    """The rows of finished runs as columns: `pandas.DataFrame(columns(runs))`, `polars.DataFrame(columns(runs))`.

    Args:
        runs: directories.
        names: of each run, what it counts under; None: its method.
        until: steps of each run; None: all.

    Returns:
        `name`, `run`, `env`, `method`, `preset` as text, then every field of the rows, in the order of
        `experiments.runs.rows`, `[rows]` each; numbers, NaN where a row has none, and text where a field is.

    Raises:
        RunError, ValueError: as `load`.
    """
    table: list[dict[str, Any]] = []
    for path, name in zip(runs, names or [None] * len(runs), strict=True):
        run = load(path, until)
        config = run.config
        own = {"name": name or config.method, "run": str(path), "env": config.env, "method": config.method}
        table += [{**own, "preset": config.preset, **row} for row in run.rows]
    order = in_order((field for row in table for field in row), ("name", "run", "env", "method", "preset"))
    return {field: _column([row.get(field) for row in table]) for field in order}


def _column(values: Sequence[Any]) -> np.ndarray:
    if any(isinstance(value, str) for value in values):
        return np.array(["" if value is None else value for value in values])
    if all(type(value) is int for value in values):
        return np.array(values)
    return np.array([np.nan if value is None else value for value in values], dtype=float)
