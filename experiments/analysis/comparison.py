"""Runs side by side: pictures, and tables in Markdown."""

import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from experiments.analysis import figures
from experiments.analysis.calibration import DATA, HELD_OUT, UNSEEN
from experiments.analysis.intervals import (
    Bounds,
    bootstrap,
    interquartile_mean,
    interval,
    paired,
    probability_of_improvement,
)
from experiments.analysis.statistics import MEASURES, Group, group
from experiments.analysis.tables import duration, markdown_table, number
from experiments.runs.errors import disk_error
from experiments.runs.files import write_text
from experiments.runs.scene import Cells, Scene
from jaxplore import validate


def write(
    runs: Sequence[Path],
    names: Sequence[str | None],
    out: Path,
    until: int | None = None,
    against: str | None = None,
) -> str:
    """Compare runs: pictures and `comparison.json` in `out`; gives the tables.

    Args:
        runs: directories.
        names: of each run, what it counts under; None: its method.
        out: a directory.
        until: steps to compare; None: all.
        against: the name that all others are compared with, seed by seed; None: the first.

    Raises:
        RunError: a run cannot be read or does not go with the others, or `out` cannot be written.
        ValueError: the configuration of a run is damaged, or no run is called `against`.
    """
    first, groups = group(runs, until, names)
    against = groups[0].label if against is None else against
    validate.one_of("against", against, [one.label for one in groups])
    config, scene = first.config, first.scene
    try:
        out.mkdir(parents=True, exist_ok=True)
        _draw(groups, first.scene, config.env, out)
        found = {one.label: [outcome._asdict() for outcome in one.outcomes] for one in groups}
        record = {"env": config.env, "preset": config.preset, "steps": config.steps, "methods": found}
        write_text(out / "comparison.json", json.dumps(record, indent=2) + "\n")
    except OSError as error:
        raise disk_error("write the comparison", out, error) from error
    tables = [
        coverage_table(groups, scene.coverage),
        paired_table(groups, against),
        return_table(groups),
        belief_table(groups),
        calibration_table(groups),
    ]
    total = sum(outcome.minutes for one in groups for outcome in one.outcomes)
    after = f"{duration(60 * total)} of wall time in all; written to {out}"
    return "\n\n".join([*(text for text in tables if text), after])


def _draw(groups: Sequence[Group], scene: Scene, env: str, out: Path) -> None:
    curves = [figures.Curves(one.label, one.steps, one.coverage) for one in groups]
    figures.plot_coverage(out / "coverage.png", curves, scene.coverage, episode_steps=scene.episode_steps, title=env)
    earned = [figures.Curves(one.label, one.evaluated, one.returns) for one in groups if len(one.evaluated)]
    if earned:
        figures.plot_return(out / "return.png", earned, title=f"{env}: return of evaluations without exploring")
    known = [figures.Curves(one.label, one.steps, one.variance) for one in groups if np.isfinite(one.variance).any()]
    if known:
        figures.plot_intrinsic_reward(
            out / "variance.png",
            known,
            unit=f"equation 1 ({scene.variance_unit})",
            title=f"{env}: variance of the models on the transitions just met",
        )


def coverage_table(groups: Sequence[Group], cells_of: Cells) -> str:
    """A Markdown table: medians, ranges in brackets, and the mean height of the coverage curves with its interval."""
    most = cells_of.reachable or cells_of.num_cells
    seen = f"{cells_of.unit} of {cells_of.size}: median (range)"
    head = ("method", "seeds", seen, "each seed", "all seen at step", "coverage over the run: mean, 95 %", "minutes")
    lines = []
    for one in groups:
        cells = [outcome.cells for outcome in one.outcomes]
        whole = [f"{outcome.reached[-1]:,}" for outcome in one.outcomes if outcome.cells == most]
        lines.append(
            (
                *(f"`{one.label}`", str(len(cells)), f"{statistics.median(cells):g} ({min(cells)} to {max(cells)})"),
                *(", ".join(map(str, cells)), ", ".join(whole) or "-", _percent(one)),
                f"{statistics.median(outcome.minutes for outcome in one.outcomes):.1f}",
            )
        )
    return markdown_table(head, lines)


def paired_table(groups: Sequence[Group], against: str) -> str | None:
    """A Markdown table of each method against one of them, by the mean height of the coverage curve: the difference on
    the seeds that both have, and over all seeds how often the method's is higher; None where nothing can be compared.
    """
    reference = next(one for one in groups if one.label == against)
    seeds_ahead = f"seeds ahead of `{against}`"
    head = ("method", "coverage: interquartile mean, 95 %", f"less `{against}`, by seed: mean, 95 %", seeds_ahead)
    head = (*head, "probability of being ahead, 95 %")
    lines = []
    for one in groups:
        heights, others = (np.array(list(group.heights.values())) for group in (one, reference))
        line = [f"`{one.label}`", _bounds(bootstrap(interquartile_mean, heights), ".0%", len(heights))]
        found = paired(one.heights, reference.heights) if one is not reference else None
        if found is None:
            line += ["-", "-"]
        else:
            mean, half_width = found.difference
            error = "" if half_width is None else f" +- {100 * half_width:.0f}"
            line += [f"{100 * mean:+.0f}{error} points", f"{found.ahead:g} of {len(found.seeds)}"]
        if one is reference:
            line.append("-")
        else:
            chance = bootstrap(probability_of_improvement, heights, others)
            line.append(_bounds(chance, ".2f", min(len(heights), len(others))))
        lines.append(line)
    return markdown_table(head, lines) if len(groups) > 1 else None


def return_table(groups: Sequence[Group]) -> str | None:
    """A Markdown table of the mean returns of the last evaluations; None where there was none."""
    lines = []
    for one in groups:
        finals = [outcome.final_return for outcome in one.outcomes if outcome.final_return is not None]
        if not finals:
            continue
        mean, half_width = interval(np.array(finals))
        error = "" if half_width is None else f" +- {half_width:,.1f}"
        each = ", ".join(f"{value:,.1f}" for value in finals)
        last = f"{one.evaluated[-1]:,}" if len(one.evaluated) else "-"
        lines.append((f"`{one.label}`", str(len(finals)), f"{mean:,.1f}{error}", each, last))
    head = ("method", "seeds", "final return: mean, 95 %", "each seed", "at step, parents' counted")
    return markdown_table(head, lines) if lines else None


def belief_table(groups: Sequence[Group]) -> str | None:
    """A Markdown table of what the beliefs said in the second half of the runs, means over seeds; None without any."""
    pairs = (
        ("own reward, imagined", "policy/imagined_reward"),
        ("own reward", "intrinsic_reward"),
        ("variance", "variance"),
        ("divergence", "divergence"),
    )
    head = ("method", "model error", *(f"{title}: mean, 95th percentile" for title, _ in pairs))
    lines = []
    for one in groups:
        means = {name: _mean([outcome.measures.get(name) for outcome in one.outcomes]) for name in MEASURES}
        if means["model_error"] is not None:
            shown = (f"{number(means[name])}, {number(means[f'{name}_p95'])}" for _, name in pairs)
            lines.append((f"`{one.label}`", number(means["model_error"]), *shown))
    return markdown_table(head, lines) if lines else None


def calibration_table(groups: Sequence[Group]) -> str | None:
    """A Markdown table of what `experiments.calibrate` found, geometric means of ratios and means of the rest over the
    seeds that were asked; None where none was.
    """
    kinds = (("data", DATA), ("new", HELD_OUT), ("unseen", UNSEEN))
    head = (
        *("method", "seeds"),
        *(f"error / variance, {short}" for short, _ in kinds),
        *(f"rank correlation, {short}" for short, _ in kinds),
        "unseen told from data",
    )
    lines = []
    for one in groups:
        asked = [outcome.calibration for outcome in one.outcomes if outcome.calibration]
        if not asked:
            continue
        sets = [[found["sets"].get(kind, {}) for found in asked] for _, kind in kinds]
        ratios = [[found.get("error_per_variance") for found in kind] for kind in sets]
        told = _mean([found["unseen_told_from_data"] for found in asked])
        lines.append(
            (
                *(f"`{one.label}`", str(len(asked))),
                *(number(_mean([value and float(np.log(value)) for value in kind], np.exp)) for kind in ratios),
                *(number(_mean([found.get("rank") for found in kind])) for kind in sets),
                "-" if told is None else f"{told:.0%}",
            )
        )
    return markdown_table(head, lines) if lines else None


def _mean(values: Sequence[float | None], then: Callable[[float], float] = float) -> float | None:
    """Mean of the values that there are."""
    known = [value for value in values if value is not None]
    return then(float(np.mean(known))) if known else None


def _bounds(found: Bounds, written: str, seeds: int) -> str:
    """A number and its interval, which one seed does not give."""
    value, low, high = (format(number, written) for number in found)
    return value if seeds < 2 else f"{value} ({low} to {high})"


def _percent(one: Group) -> str:
    mean, half_width = interval(one.coverage.mean(axis=1))
    return f"{mean:.0%}" if half_width is None else f"{mean:.0%} +- {100 * half_width:.0f}"
