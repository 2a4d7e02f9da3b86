"""The report on a plan: its finished runs as curves and tables, and a verdict on each claim."""

import dataclasses
import datetime
import platform
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.analysis.intervals import bootstrap, interquartile_mean, paired, probability_of_improvement
from experiments.analysis.load import LoadedRun, load
from experiments.analysis.measures import Measure, curves
from experiments.analysis.page import FloorVisits, Panel, Report, Section, Series, Table
from experiments.analysis.tables import duration, number, span
from experiments.analysis.verdicts import judge
from experiments.runs.config import differences
from experiments.runs.errors import RunError
from experiments.runs.files import read_json
from experiments.studies.figures_of_paper import Cell, Figure, Part, config_of
from experiments.studies.plan import Plan, Rates, Standing, State

PROGRAM = "python -m experiments.paper"


class Line(NamedTuple):
    """The finished runs of a cell, measured."""

    series: Series
    scores: dict[int, float]
    """Seed -> the measure's number."""
    ends: dict[int, float]
    """Seed -> the height at which its curve ends."""
    runs: list[LoadedRun]


def make(plan: Plan, standings: Mapping[str, Standing], failed: Mapping[str, str], rates: Rates) -> Report:
    """The report on what is finished by now.

    Args:
        plan: all that was to be done.
        standings: where each job stands.
        failed: those that will not be finished, and why.
        rates: what steps took in runs of before, for estimates.

    Raises:
        RunError: a run cannot be read, or the runs of a cell differ in more than their seed.
        ValueError: a run's configuration is damaged.
    """
    sections = [_section(plan, figure, standings, failed, rates) for figure in plan.figures]
    now = datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    states = [one.state for one in standings.values()]
    notes = [f"{states.count(State.FINISHED)} of {len(states)} runs are finished."]
    notes += [f"{plan.jobs[key].name} is in no figure: {why}" for key, why in sorted(failed.items())]
    if plan.preset == "smoke":
        notes.append("The smoke preset shows that everything runs; nothing can be learned from its numbers.")
    return Report("Implicit generative modeling for efficient exploration: what was found here", sections, now, notes)


def measured(cell: Cell, measure: Measure, runs: Sequence[LoadedRun]) -> Line | None:
    """The runs of a cell as one line; None where they do not have the measure.

    Raises:
        RunError: they differ in more than their seed, or a seed comes twice.
    """
    if not runs:
        return None
    alike = [dataclasses.replace(run.config, seed=0, num_seeds=1) for run in runs]
    for run, config in zip(runs, alike, strict=True):
        changed = differences(alike[0], config)
        if changed:
            raise RunError(
                f"{cell.label}: {runs[0].directory} and {run.directory} differ in {'; '.join(changed)}. Allowed: runs "
                "that differ in their seed alone."
            )
    rows = [row for run in runs for row in run.rows]
    seeds = sorted({row["seed"] for row in rows})
    if len(seeds) < sum(len({row["seed"] for row in run.rows}) for run in runs):
        raise RunError(f"{cell.label}: a seed comes twice in {', '.join(str(run.directory) for run in runs)}.")
    found = curves(rows, measure)
    if found is None:
        return None
    steps, values = found
    scores = dict(zip(seeds, measure.score(steps, values).tolist(), strict=True))
    ends = dict(zip(seeds, values[:, -1].tolist(), strict=True))
    shown = steps / runs[0].scene.episode_steps if measure.over == "episodes" else steps
    return Line(Series(cell.label, shown, values, tuple(seeds)), scores, ends, list(runs))


def _section(
    plan: Plan, figure: Figure, standings: Mapping[str, Standing], failed: Mapping[str, str], rates: Rates
) -> Section:
    panels: list[Panel | FloorVisits] = []
    tables, scores, ends, everything = list[Table](), list[Any](), list[Any](), list[LoadedRun]()
    for i, part in enumerate(figure.parts):
        lines: dict[str, Line] = {}
        for cell in part.of(plan.preset):
            keys = plan.cells.get((figure.name, i, cell.label), ())
            paths = [standings[key].path for key in keys if standings[key].state is State.FINISHED]
            line = measured(cell, part.measure, [load(path) for path in paths])
            if line is not None:
                lines[cell.label] = line
        scores.append({label: _turned(line.scores, part.measure) for label, line in lines.items()})
        ends.append({label: line.ends for label, line in lines.items()})
        if lines:
            panels += _panels(part, lines)
            tables.append(_table(part, lines, figure.printed))
            everything += [run for line in lines.values() for run in line.runs]
    beliefs = _testbed_table(plan, figure, standings)
    tables += [beliefs] if beliefs is not None else []
    verdict, why = judge(figure.conditions, scores, ends)
    mine = [key for key, job in plan.jobs.items() if figure.name in job.figures]
    left = [key for key in mine if standings[key].state is not State.FINISHED]
    if not everything and beliefs is None:
        verdict, why = "not run", "no run of it is finished"
    elif left:
        why += f"; {len(left)} of {len(mine)} runs are not in it"
        why += f", {sum(key in failed for key in left)} of them failed" if any(key in failed for key in left) else ""
    command = f"{PROGRAM} {figure.name} --preset={plan.preset}"
    facts = _facts(plan, figure, everything, rates)
    return Section(figure.name, figure.title, figure.source, figure.claim, verdict, why, command, panels, tables, facts)


def _turned(scores: Mapping[int, float], measure: Measure) -> dict[int, float]:
    sign = 1.0 if measure.higher_is_better else -1.0
    return {seed: sign * value for seed, value in scores.items() if np.isfinite(value)}


def _panels(part: Part, lines: Mapping[str, Line]) -> list[Panel | FloorVisits]:
    scene = next(iter(lines.values())).runs[0].scene
    if part.measure.needs_walk:
        pictures: list[Panel | FloorVisits] = []
        for label, line in lines.items():
            walks = [(run.config.seed, run.directory.walk()[0]) for run in line.runs]
            plan = scene.floor_plan
            if plan is None:
                raise RunError(f"{line.runs[0].directory} has no floor plan, so nothing shows where it has been.")
            # [seeds of a run, steps, 2]
            where = [walk.reshape(-1, 2) for _, walk in walks]
            whose = [np.repeat(np.arange(first, first + len(walk)), walk.shape[1]) for first, walk in walks]
            title = f"{part.title}: {label}"
            pictures.append(FloorVisits(title, np.concatenate(where), np.concatenate(whose), plan))
        return pictures
    cells, name = scene.coverage, part.measure.name
    is_share = part.measure.fields == ("coverage",)
    ceiling = cells.reachable / cells.num_cells if is_share and cells.reachable else None
    unit = f"{name} of {cells.num_cells} {cells.unit}" if is_share else name
    if part.measure.fields == ("variance",):
        unit = f"{name} [{scene.variance_unit}]"
    return [Panel(part.title, unit, [line.series for line in lines.values()], part.measure.over, ceiling)]


def _table(part: Part, lines: Mapping[str, Line], printed: Mapping[str, str]) -> Table:
    """A line for each label: its number and how sure it is, and against the first label, the proposed method's."""
    first = next(iter(lines))
    reference = lines[first]
    head = ("", "seeds", "interquartile mean, 95 %", "mean ± deviation", f"{first} less it, by seed, 95 %")
    head = (*head, f"probability of {first} ahead", *(["the paper's"] if printed else []))
    rows = []
    for label, line in lines.items():
        values = np.array([value for value in line.scores.values() if np.isfinite(value)])
        if not len(values):
            continue
        low = bootstrap(interquartile_mean, values)
        middle = number(low.value) + (f" ({number(low.low)} to {number(low.high)})" if len(values) > 1 else "")
        spread = f" ± {number(float(np.std(values, ddof=1)))}" if len(values) > 1 else ""
        found = paired(reference.scores, line.scores) if line is not reference else None
        less, chance = "-", "-"
        if found is not None:
            half = found.difference.half_width
            less = number(found.difference.mean) + ("" if half is None else f" ± {number(half)}")
            pair = [np.array(list(_turned(one.scores, part.measure).values())) for one in (reference, line)]
            chance = f"{probability_of_improvement(*pair):.2f}" if all(map(len, pair)) else "-"
        seeds = span(*(str(end(line.scores)) for end in (min, max)))
        row = (label, seeds, middle, f"{number(float(values.mean()))}{spread}", less, chance)
        rows.append((*row, *([printed.get(label, "-")] if printed else [])))
    better = "" if part.measure.higher_is_better else "; less is better"
    return Table(head, rows, f"{part.title}: {part.measure.score_name}{better}")


def _testbed_table(plan: Plan, figure: Figure, standings: Mapping[str, Standing]) -> Table | None:
    head = ("belief", "transitions", "kind", "error", "variance", "error / variance", "rank correlation")
    rows = []
    for testbed in figure.testbeds:
        one = standings[f"testbed-{testbed.label}"]
        if one.state is not State.FINISHED:
            continue
        try:
            found = read_json(one.path)["stored"]
            for fit in found:
                for kind, judged in fit["kinds"].items():
                    values = (judged[name] for name in ("error", "variance", "ratio", "rank"))
                    rows.append((testbed.label, fit["environment"], kind, *map(number, values)))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise RunError(f"cannot read {one.path}: {error!r}. What to do: remove it, and run this again.") from error
    return Table(head, rows, "a line for each fit") if rows else None


def _facts(plan: Plan, figure: Figure, runs: Sequence[LoadedRun], rates: Rates) -> dict[str, str]:
    facts = {"preset": plan.preset}
    if runs:
        once = {str(run.directory): run for run in runs}.values()
        seeds = [row["seed"] for run in once for row in run.rows[-run.config.num_seeds :]]
        steps = [run.config.steps for run in once]
        facts["seeds"] = span(str(min(seeds)), str(max(seeds)))
        facts["steps"] = span(f"{min(steps):,}", f"{max(steps):,}")
        facts["wall time"] = f"{duration(sum(run.rows[-1]['wall_time'] for run in once))} of {len(once)} runs together"
        facts["versions"] = _versions(list(once))
    facts["this machine"] = f"{platform.machine()}, {platform.system()}"
    facts["at the paper's scale, extrapolated"] = _paper_scale(figure, rates)
    return facts


def _versions(runs: Sequence[LoadedRun]) -> str:
    """Versions that the runs began with, those of JAX and the project's own; more than one where they differ."""
    found: dict[str, set[str]] = {}
    for run in runs:
        try:
            saved = read_json(run.directory.path / "versions.json")
        except (OSError, ValueError):
            continue
        for name in ("jaxplore", "jax", "mujoco"):
            found.setdefault(name, set()).add(str(saved.get(name, "unknown")))
    return ", ".join(f"{name} {' and '.join(sorted(values))}" for name, values in found.items())


def _paper_scale(figure: Figure, rates: Rates) -> str:
    """What the figure's runs would take with the paper's preset, at the pace of runs of that preset."""
    total, unknown = 0.0, 0
    cells = [cell for part in figure.parts for cell in _family(part.cells)]
    for config in dict.fromkeys(config_of(cell, "paper") for cell in cells):
        rate = rates.get((config.env, config.method, "paper"))
        if rate is None:
            unknown += 1
        else:
            total += rate * config.steps * config.num_seeds
    if not total:
        return "no run with the paper's preset to tell from"
    return f"{duration(total)}" + (f", and {unknown} lines of which no run tells" if unknown else "")


def _family(cells: Sequence[Cell]) -> list[Cell]:
    return [one for cell in cells for one in (cell.parent, cell) if one is not None]
