"""What a finished run leaves to look at: pictures and a table, made from its files alone."""

import functools
import os
import shlex
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.analysis import figures
from experiments.analysis.load import held, scene_of, series
from experiments.analysis.tables import duration, number, span, text_table
from experiments.runs.directory import RunDirectory
from experiments.runs.metrics import Row
from experiments.runs.scene import Cells, Scene

PANELS = 4
"""Pictures of the floor, at equal parts of a run."""

Column = tuple[str, Callable[[float], str], Callable[[Sequence[Row]], float | None]]
"""Its head, how a number is written, and the number of one seed's rows; None where there is none."""


def write(directory: RunDirectory) -> str:
    """Draw the pictures of a finished run (the floor plan of its first seed), and give its closing table.

    Raises:
        RunError: the run's files cannot be read, or the pictures cannot be written.
    """
    config, rows, scene = directory.config(), directory.rows(), scene_of(directory)
    files = {"metrics": directory.metrics_path, "coverage": directory.picture("coverage")}
    title = f"{config.method} on {config.env}"
    steps, covered = series(rows, "coverage")
    covered = held(covered)
    curves = [figures.Curves(config.method, steps, covered)]
    figures.plot_coverage(files["coverage"], curves, scene.coverage, episode_steps=scene.episode_steps, title=title)
    if scene.floor_plan is not None and not directory.is_kept():
        files["visitation"] = directory.picture("visitation")
        positions, episode_steps = directory.walk()
        panels = min(PANELS, config.steps)
        ends = [config.steps * panel // panels for panel in range(1, panels + 1)]
        cells = np.round(covered[0] * scene.coverage.num_cells).astype(int)
        seen = [int(cells[max(0, np.searchsorted(steps, end, side="right") - 1)]) for end in ends]
        figures.plot_visitation(
            files["visitation"],
            (positions[0], episode_steps[0]),
            seen,
            scene.floor_plan,
            scene.coverage,
            title=f"{title}, seed {config.seed}",
        )
    steps, reward = series(rows, "intrinsic_reward")
    files["reward"] = directory.picture("intrinsic_reward")
    unit = f"intrinsic reward ({scene.reward_unit})" if scene.reward_unit else "intrinsic reward"
    curves = [figures.Curves(config.method, steps, reward)]
    figures.plot_intrinsic_reward(files["reward"], curves, unit=unit, title=title)
    return "\n\n".join([summary(rows, scene.coverage, files), *hints(directory.path, rows, scene)])


def hints(directory: Path, rows: Sequence[Row], scene: Scene) -> list[str]:
    """What can be done next with a run, or with several seeds' runs: lines in one text, or nothing."""
    further = (
        ("To see it move", "render", scene.has_view),
        ("To ask what its models know", "calibrate", any("model_error" in row for row in rows)),
    )
    found = [
        f"{what}: python -m experiments.{name} {shlex.quote(str(directory))}" for what, name, fits in further if fits
    ]
    return ["\n".join(found)] if found else []


def summary(rows: Sequence[Row], cells: Cells, files: Mapping[str, str | os.PathLike[str]] | None = None) -> str:
    """The table that closes a run, as plain text: a line per seed, of several also the median and the range.

    Args:
        rows: all rows of the run.
        cells: what coverage counts.
        files: what to point to below the table, name to path.

    Raises:
        ValueError: there are no rows.
        KeyError: a row lacks `step`, `seed`, `cells` or `wall_time`.
    """
    if not rows:
        raise ValueError("rows: a run without rows has no summary")
    seeds = sorted({row["seed"] for row in rows})
    own = [[row for row in rows if row["seed"] == seed] for seed in seeds]
    columns = _columns(cells, rows)
    values = [[find(one) for _, _, find in columns] for one in own]
    lines = [
        (str(seed), *("-" if v is None else f(v) for v, (_, f, _) in zip(line, columns, strict=True)))
        for seed, line in zip(seeds, values, strict=True)
    ]
    if len(seeds) > 1:
        known = [[v for v in column if v is not None] for column in zip(*values, strict=True)]
        write = [f for _, f, _ in columns]
        pairs = list(zip(write, known, strict=True))
        lines.append(("median", *(f(statistics.median(v)) if v else "-" for f, v in pairs)))
        lines.append(("range", *(span(f(min(v)), f(max(v))) if v else "-" for f, v in pairs)))
    text = text_table(("seed", *(head for head, _, _ in columns)), lines).split("\n")
    if len(seeds) > 1:
        text[-2:-2] = [text[1]]
    if dropped := sum(row.get("dropped") or 0 for row in rows):
        text += ["", f"{dropped:,} steps dropped: physics that diverged, which ends an episode and is no data"]
    for row in rows:
        if row.get("diverged"):
            text += ["", f"seed {row['seed']} diverged at step {row['step']:,}: not finite was {row['diverged']}"]
    if files:
        width = max(map(len, files))
        text += ["", *(f"{name.ljust(width)}   {os.fspath(path)}" for name, path in files.items())]
    return "\n".join(text)


def _columns(cells: Cells, rows: Sequence[Row]) -> list[Column]:
    """The columns of the closing table; returns only where there are any."""
    returns = (("last return", "episode_return"), ("eval return", "eval/return"))
    return [
        (f"{cells.unit} (of {cells.size})", lambda n: f"{n:g}", lambda rows: max(row["cells"] for row in rows)),
        ("last new at step", lambda n: f"{n:,.0f}", _last_new),
        *(
            (head, number, functools.partial(_last, field=field))
            for head, field in returns
            if _last(rows, field) is not None
        ),
        ("steps", lambda n: f"{n:,.0f}", lambda rows: rows[-1]["step"]),
        ("time", duration, lambda rows: rows[-1]["wall_time"]),
        ("steps/s", lambda n: f"{n:.1f}", lambda rows: rows[-1]["step"] / max(rows[-1]["wall_time"], 1e-9)),
    ]


def _last(rows: Sequence[Row], field: str) -> float | None:
    return next((row[field] for row in reversed(rows) if row.get(field) is not None), None)


def _last_new(rows: Sequence[Row]) -> int | None:
    """The step (end of its round) at which the last new cell was seen; None: none was."""
    most = max(row["cells"] for row in rows)
    return next(row["step"] for row in rows if row["cells"] == most) if most else None
