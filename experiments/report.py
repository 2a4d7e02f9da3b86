"""What a finished run leaves to look at: three pictures and a table, made from its files alone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.base import Environment
from experiments import loop, plot
from experiments.config import RunConfig
from experiments.log import read_metrics, summary

PANELS = 4


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


def write(config: RunConfig, out: Path, env: Environment) -> str:
    """Draw the pictures of the run in `out`, and give its closing table.

    Raises:
        RunError: the run's files cannot be read, or the pictures cannot be written.
    """
    rows = read_metrics(out / "metrics.jsonl")
    files = {"metrics": out / "metrics.jsonl"}
    title = f"{config.method} on {config.env}"
    steps, covered = series(rows, "coverage")
    files["coverage"] = out / "coverage.png"
    plot.plot_coverage(files["coverage"], [plot.Curves(config.method, steps, covered)], env.coverage, title=title)
    if env.floor_plan is not None:
        files["visitation"] = out / "visitation.png"
        walk = np.load(out / loop.WALK)
        ends = [round(config.steps * (panel + 1) / PANELS) for panel in range(PANELS)]
        cells = covered[0] * env.coverage.num_cells
        seen = [int(cells[np.searchsorted(steps, end, side="right") - 1]) for end in ends]
        plot.plot_visitation(
            files["visitation"],
            walk["positions"][0],
            walk["episode_steps"][0],
            seen,
            env.floor_plan,
            env.coverage,
            title=f"{title}, seed {config.seed}",
        )
    steps, reward = series(rows, "intrinsic_reward")
    files["reward"] = out / "intrinsic_reward.png"
    unit = "intrinsic reward (normalised delta, squared)"
    if config.explorer.reward_units == "raw":
        unit = "intrinsic reward (raw units, squared)"
    plot.plot_intrinsic_reward(files["reward"], [plot.Curves(config.method, steps, reward)], unit=unit, title=title)
    return summary(rows, num_cells=env.coverage.num_cells, unit=env.coverage.unit, files=files)
