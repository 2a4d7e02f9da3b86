"""What a finished run leaves to look at: three pictures and a table, made from its files alone."""

import shlex
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.base import Environment
from experiments import loop, plot
from experiments.config import RunConfig
from experiments.errors import RunError
from experiments.log import read_metrics, summary
from jaxplore.methods import get_method, reward_unit

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
    """Draw the pictures of the finished run in `out` (the floor plan of its first seed), and give its closing table.

    Raises:
        RunError: the run's files cannot be read, or the pictures cannot be written.
    """
    rows = read_metrics(out / "metrics.jsonl")
    files = {"metrics": out / "metrics.jsonl"}
    title = f"{config.method} on {config.env}"
    steps, covered = series(rows, "coverage")
    files["coverage"] = out / "coverage.png"
    plot.plot_coverage(
        files["coverage"],
        [plot.Curves(config.method, steps, covered)],
        env.coverage,
        episode_steps=env.spec.episode_steps,
        title=title,
    )
    if env.floor_plan is not None:
        files["visitation"] = out / "visitation.png"
        positions, episode_steps = _read_walk(out / loop.WALK)
        panels = min(PANELS, config.steps)
        ends = [config.steps * panel // panels for panel in range(1, panels + 1)]
        cells = np.round(covered[0] * env.coverage.num_cells).astype(int)
        seen = [int(cells[max(0, np.searchsorted(steps, end, side="right") - 1)]) for end in ends]
        plot.plot_visitation(
            files["visitation"],
            positions[0],
            episode_steps[0],
            seen,
            env.floor_plan,
            env.coverage,
            title=f"{title}, seed {config.seed}",
        )
    steps, reward = series(rows, "intrinsic_reward")
    files["reward"] = out / "intrinsic_reward.png"
    unit = f"intrinsic reward ({reward_unit(get_method(config.method), config.explorer)})"
    plot.plot_intrinsic_reward(files["reward"], [plot.Curves(config.method, steps, reward)], unit=unit, title=title)
    table = summary(rows, size=env.coverage.size, unit=env.coverage.unit, files=files)
    further = (
        ("To see it move", "render", env.view is not None),
        ("To ask what its models know", "posterior", any("model_error" in row for row in rows)),
    )
    hints = [f"{what}: python -m experiments.{name} {shlex.quote(str(out))}" for what, name, fits in further if fits]
    return "\n\n".join([table, *(["\n".join(hints)] if hints else [])])


def _read_walk(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions `[S, steps, 2]` [m] and the step of the episode of each, `[S, steps]`."""
    try:
        with np.load(path) as walk:
            return walk["positions"], walk["episode_steps"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise RunError(f"cannot read {path}: {error}. What to do: remove it, and finish with --resume.") from error
