"""Small figures, and finished runs of them written by hand: without an environment, an agent or a process."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from envs.base import FloorPlan
from experiments.analysis.measures import COVERAGE, RETURN, VISITS, WHOLE, Measure
from experiments.analysis.verdicts import Condition
from experiments.runs.directory import RunDirectory
from experiments.runs.scene import Cells, Scene
from experiments.runs.schedule import rounds
from experiments.runs.spec import RunSpec
from experiments.runs.status import Status
from experiments.studies.estimates import Rates
from experiments.studies.figures_of_paper import Cell, Figure, Part
from experiments.studies.plan import Job

FLOOR = FloorPlan((0, 1), (), ((0.0, 0.0, 1.0, 1.0), (1.0, 0.0, 2.0, 1.0)))
SCENE = Scene(Cells(4, "squares", 2), FLOOR, 50, 6, 1, True, True, None, "normalised delta, squared")
STEPS = {"smoke": 300, "laptop": 300, "paper": 300}


def cell(method: str, label: str = "", env: str = "ant_maze", seeds: int = 2, **fields) -> Cell:
    return Cell(label or method, env, method, seeds, STEPS, **fields)


SHORT = {"explorer": {"warm_up_steps": 50, "data_capacity": 1_000}}
PARENT = cell("disagreement", env="half_cheetah_task")
CHILD = cell("sac", "ours", "half_cheetah_task", parent=PARENT, settings=SHORT)


def figure(name: str, cells: tuple[Cell, ...], measure: Measure = COVERAGE, conditions: tuple[Condition, ...] = ()):
    return Figure(name, name.title(), "Figure 0", "It is so.", (Part("A part", measure, cells),), conditions)


def finish(job: Job, cells: Mapping[int, int] | None = None, path: Path | None = None, value: float = 1.0) -> Path:
    """Write the finished run of a job: of each seed, half of its `cells` are seen in the first half of its steps."""
    assert job.spec is not None
    return write(job.spec, path or job.path, cells, value)


def write(
    spec: RunSpec, path: Path, cells: Mapping[int, int] | None = None, value: float = 1.0, pace: float = 0.01
) -> Path:
    """Write a finished run, `pace` seconds a step."""
    config, directory = spec.config, RunDirectory(path)
    directory.begin(spec, SCENE)
    log = directory.metrics_log()
    for _, step in rounds(config, 0):
        lines = []
        for seed in range(config.seed, config.seed + config.num_seeds):
            seen = (cells or {}).get(seed, 2)
            seen = seen if 2 * step > config.steps else seen // 2
            row = {"step": step, "seed": seed, "coverage": seen / 4, "cells": seen, "wall_time": pace * step}
            lines.append({**row, "variance": value, "episode_return": value * (seed + 1)})
        log.append(lines)
    log.close()
    positions = np.zeros((config.num_seeds, config.steps, 2)) + np.arange(config.num_seeds)[:, None, None]
    directory.write_walk(positions, np.zeros((config.num_seeds, config.steps), int))
    directory.write_outcome(Status.FINISHED, {})
    return path


LONG = dict.fromkeys(("smoke", "laptop", "paper"), 10_000)
SMALL_CELLS = tuple(
    Cell(
        f"noise {noise}",
        "acrobot",
        "random",
        2,
        LONG,
        {"checkpoint_every": 100, "obs_noise": noise, "explorer": {"warm_up_steps": 50}},
    )
    for noise in (0.0, 0.1, 0.2)
)
SMALL = figure("small", SMALL_CELLS)
"""Of random actions, which compile in no time; long enough to be killed often."""


NO_RATES = Rates({}, {})

__all__ = ["COVERAGE", "NO_RATES", "RETURN", "SMALL", "VISITS", "WHOLE", "cell", "figure", "finish", "write"]
