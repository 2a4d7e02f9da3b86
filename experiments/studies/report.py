"""The report on a plan: its finished runs as curves and tables, and a verdict on each claim."""

import dataclasses
import datetime
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from experiments.analysis.intervals import bootstrap, interquartile_mean, paired, probability_of_improvement
from experiments.analysis.load import LoadedRun, load
from experiments.analysis.measures import WHOLE, Measure, curves, rising, staying
from experiments.analysis.page import FloorVisits, Panel, Report, Section, Series, Table
from experiments.analysis.tables import duration, number, span, spans
from experiments.analysis.verdicts import Numbers, judge
from experiments.runs.config import differences
from experiments.runs.errors import RunError
from experiments.runs.files import read_json
from experiments.studies import figures_of_paper, scale
from experiments.studies.estimates import Rates
from experiments.studies.figures_of_paper import Cell, Figure, Part
from experiments.studies.found import setting_of
from experiments.studies.plan import Plan, Standing, State

PROGRAM = "python -m experiments.paper"


class Member(NamedTuple):
    """A finished run, and the seeds that a line takes from it."""

    run: LoadedRun
    seeds: tuple[int, ...]


class Line(NamedTuple):
    """The seeds of a cell that are there, measured."""

    series: Series
    scores: dict[int, float]
    """Seed -> the measure's number."""
    ends: dict[int, float]
    """Seed -> the height at which its curve ends."""
    changes: dict[int, float]
    """Seed -> how high its curve is later, as a multiple of how high it is at first."""
    rises: dict[int, float]
    """The same until the seed had seen all."""
    members: list[Member]


class _Read(NamedTuple):
    """The finished runs that lines take from, read once; by the keys of their jobs."""

    runs: dict[str, LoadedRun]
    diverged: dict[str, dict[int, str]]
    """Of a run that survived, seeds that did not, and how."""
    damaged: dict[str, str]
    """Why a run cannot be read."""


def make(
    plan: Plan,
    standings: Mapping[str, Standing],
    failed: Mapping[str, str],
    rates: Rates,
    words: Sequence[str] = (),
) -> Report:
    """The report on what is finished by now. A run that cannot be read is left out, and said to be.

    Args:
        plan: all that was to be done.
        standings: where each job stands.
        failed: those that will not be finished, and why.
        rates: what steps took in runs of before, for estimates.
        words: flags that the report was made with, for the commands that it shows.

    Raises:
        RunError: the runs of a cell differ in more than their seed, or a testbed's file is damaged.
    """
    read = _read(plan, standings)
    sections = [_section(plan, figure, standings, failed, read, rates, words) for figure in plan.figures]
    now = datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    notes = _notes(plan, standings, failed, read)
    return Report("Implicit generative modeling for efficient exploration: what was found here", sections, now, notes)


def _read(plan: Plan, standings: Mapping[str, Standing]) -> _Read:
    read, parts = _Read({}, {}, {}), {figure.name: figure.parts for figure in plan.figures}
    walked = {key for (name, i, _), one in plan.cells.items() if parts[name][i].measure.needs_walk for key in one.keys}
    for key in dict.fromkeys(key for one in plan.cells.values() for key in one.keys):
        job = plan.jobs[key]
        if standings[key].state is not State.FINISHED:
            continue
        try:
            run = load(job.path)
            if key in walked:
                run.directory.walk()
            how = {seed: one for seed, one in run.directory.diverged().items() if seed in job.seeds}
        except (RunError, ValueError) as error:
            read.damaged[key] = str(error)
            continue
        read.runs[key] = run
        if how:
            read.diverged[key] = {
                seed: f"diverged at step {one['step']:,} (not finite: {one['what']})" for seed, one in how.items()
            }
    return read


def _notes(plan: Plan, standings: Mapping[str, Standing], failed: Mapping[str, str], read: _Read) -> list[str]:
    states = [one.state for one in standings.values()]
    notes = [f"{states.count(State.FINISHED)} of {len(states)} runs of these figures are finished."]
    known, here = figures_of_paper.figures(), {figure.name for figure in plan.figures}
    others = [name for name in known if name not in here]
    if others:
        notes.append(f"{len(here)} of {len(known)} figures are in this report. Not in it: {', '.join(others)}.")
    notes += [f"{plan.jobs[key].name} is in no figure: {why}" for key, why in sorted(failed.items())]
    for key, seeds in read.diverged.items():
        notes += [f"{plan.jobs[key].name}, seed {seed}, is in no figure: it {how}" for seed, how in seeds.items()]
    notes += [f"{plan.jobs[key].name} is left out: {why}" for key, why in read.damaged.items()]
    if plan.preset == "smoke":
        notes.append("The smoke preset shows that everything runs; nothing can be learned from its numbers.")
    return notes


def measured(cell: Cell, measure: Measure, members: Sequence[Member]) -> Line | None:
    """The seeds of a cell as one line; None where they do not have the measure.

    Raises:
        RunError: their runs differ in more than their seed, or a seed comes twice.
    """
    if not members:
        return None
    _check_alike(cell, [member.run for member in members])
    rows = [row for run, seeds in members for row in run.rows if row["seed"] in seeds]
    seeds = sorted({row["seed"] for row in rows})
    if len(seeds) < sum(len(set(member.seeds)) for member in members):
        raise RunError(f"{cell.label}: a seed comes twice in {', '.join(str(run.directory) for run, _ in members)}.")
    found = curves(rows, measure)
    if found is None:
        return None
    steps, values = found

    def by_seed(numbers: np.ndarray) -> dict[int, float]:
        return dict(zip(seeds, numbers.tolist(), strict=True))

    shown = steps / members[0].run.scene.episode_steps if measure.over == "episodes" else steps
    changes, rises = dict[int, float](), dict[int, float]()
    coverage = curves(rows, WHOLE)
    if measure.can_change and coverage is not None:
        changes = by_seed(staying(steps, values))
        rises = by_seed(rising(steps, values, WHOLE.score(*coverage)))
    scores, ends = by_seed(measure.score(steps, values)), by_seed(values[:, -1])
    return Line(Series(cell.label, shown, values, tuple(seeds)), scores, ends, changes, rises, list(members))


def _check_alike(cell: Cell, runs: Sequence[LoadedRun]) -> None:
    settings = [setting_of(run.directory.spec()) for run in runs]
    for run, setting in zip(runs, settings, strict=True):
        if setting != settings[0]:
            alike = [dataclasses.replace(one.config, seed=0, num_seeds=1) for one in (runs[0], run)]
            changed = "; ".join(differences(*alike)) or "their parents or first seeds"
            raise RunError(
                f"{cell.label}: {runs[0].directory} and {run.directory} differ in {changed}. Allowed: runs that differ "
                "in their seed alone."
            )


def _section(
    plan: Plan,
    figure: Figure,
    standings: Mapping[str, Standing],
    failed: Mapping[str, str],
    read: _Read,
    rates: Rates,
    words: Sequence[str],
) -> Section:
    panels: list[Panel | FloorVisits] = []
    tables, numbers, everything = list[Table](), list[Numbers](), list[LoadedRun]()
    there, asked = list[int](), list[int]()
    for i, part in enumerate(figure.parts):
        lines = _lines(plan, figure, i, read)
        wanted = {cell.label: len(plan.cells[figure.name, i, cell.label].seeds) for cell in part.of(plan.preset)}
        numbers.append(_numbers(part, lines, wanted))
        if lines:
            panels += _panels(part, lines)
            tables.append(_table(part, lines, figure.printed))
            everything += [member.run for line in lines.values() for member in line.members]
            there += [len(line.scores) for line in lines.values()]
            asked += [wanted[label] for label in lines]
    beliefs, ranked = _testbed_table(figure, plan, standings)
    numbers.append(Numbers(ranked))
    tables += [beliefs] if beliefs is not None else []
    verdict, reasons = judge(figure.conditions, numbers)
    said = [] if reasons else ["No condition decides this one: see the table."]
    said += [f"Not asked: {figure.unasked.rstrip('.')}."] if figure.unasked else []
    mine = [key for key, job in plan.jobs.items() if figure.name in job.figures]
    left = [key for key in mine if standings[key].state is not State.FINISHED or key in read.damaged]
    if not everything and beliefs is None:
        verdict, reasons, said = "not run", (), ["No run of it is finished."]
    elif left:
        lost = sum(key in failed for key in left)
        said.append(f"{len(left)} of {len(mine)} runs are not in it" + (f", {lost} of them failed." if lost else "."))
    command = " ".join([PROGRAM, figure.name, f"--preset={plan.preset}", *map(shlex.quote, words)])
    facts = {"preset": plan.preset, **_facts_of(everything, there, asked)}
    facts["at the paper's scale"] = scale.describe(figure, rates)
    about = (figure.name, figure.title, figure.source, figure.claim)
    return Section(*about, verdict, " ".join(said), command, panels, tables, facts, reasons)


def _lines(plan: Plan, figure: Figure, i: int, read: _Read) -> dict[str, Line]:
    """The lines of a part that there is anything of."""
    lines = {}
    for cell in figure.parts[i].of(plan.preset):
        taken = plan.cells[figure.name, i, cell.label]
        members = []
        for key in taken.keys:
            gone = read.diverged.get(key, {})
            seeds = tuple(seed for seed in plan.jobs[key].seeds if seed in taken.seeds and seed not in gone)
            members += [Member(read.runs[key], seeds)] if key in read.runs and seeds else []
        line = measured(cell, figure.parts[i].measure, members)
        if line is not None:
            lines[cell.label] = line
    return lines


def _numbers(part: Part, lines: Mapping[str, Line], wanted: Mapping[str, int]) -> Numbers:
    return Numbers(
        {label: _turned(line.scores, part.measure) for label, line in lines.items()},
        part.measure.unit,
        {label: line.ends for label, line in lines.items()},
        {label: line.changes for label, line in lines.items()},
        {label: line.rises for label, line in lines.items()},
        wanted,
    )


def _turned(scores: Mapping[int, float], measure: Measure) -> dict[int, float]:
    """Scores of which the higher is the better."""
    sign = 1.0 if measure.higher_is_better else -1.0
    return {seed: sign * value for seed, value in scores.items() if np.isfinite(value)}


def _panels(part: Part, lines: Mapping[str, Line]) -> list[Panel | FloorVisits]:
    scene = next(iter(lines.values())).members[0].run.scene
    if part.measure.needs_walk:
        return [_visits(f"{part.title}: {label}", line) for label, line in lines.items()]
    cells, name = scene.coverage, part.measure.name
    is_share = part.measure.fields == ("coverage",)
    ceiling = cells.reachable / cells.num_cells if is_share and cells.reachable else None
    unit = f"{name} of {cells.num_cells} {cells.unit}" if is_share else name
    if part.measure.fields == ("variance",):
        unit = f"{name} [{scene.variance_unit}]"
    return [Panel(part.title, unit, [line.series for line in lines.values()], part.measure.over, ceiling)]


def _visits(title: str, line: Line) -> FloorVisits:
    """Where all seeds of a line have been."""
    where, whose = list[np.ndarray](), list[np.ndarray]()
    for run, seeds in line.members:
        walk = run.directory.walk()[0][[seed - run.config.seed for seed in seeds]]  # [seeds, steps, 2]
        where.append(walk.reshape(-1, 2))
        whose.append(np.repeat(seeds, walk.shape[1]))
    plan = line.members[0].run.scene.floor_plan
    if plan is None:
        raise RunError(f"{line.members[0].run.directory} has no floor plan, so nothing shows where it has been.")
    return FloorVisits(title, np.concatenate(where), np.concatenate(whose), plan)


def _table(part: Part, lines: Mapping[str, Line], printed: Mapping[str, str]) -> Table:
    """A line for each label: its number and how sure it is, and against the first label, the proposed method's."""
    measure, first = part.measure, next(iter(lines))
    head = ("", "seeds", "interquartile mean, 95 % by bootstrap", "mean ± deviation")
    head = (*head, f"{first} ahead by, 95 % by Student's t", f"probability of {first} ahead")
    head = (*head, *(["never, counted as the last step"] if measure.is_open else []))
    head = (*head, *(["the paper's"] if printed else []))
    rows = []
    for label, line in lines.items():
        values = np.array([value for value in line.scores.values() if np.isfinite(value)])
        if not len(values):
            continue
        low = bootstrap(interquartile_mean, values)
        middle = number(low.value) + (f" ({number(low.low)} to {number(low.high)})" if len(values) > 1 else "")
        spread = f" ± {number(float(np.std(values, ddof=1)))}" if len(values) > 1 else ""
        seeds = f"{len(line.scores)}: {spans(line.scores)}"
        row = (label, seeds, middle, f"{number(float(values.mean()))}{spread}")
        row = (*row, *(_beside(measure, lines[first], line) if label != first else ("-", "-")))
        never = sum(end < 1.0 - 1e-6 for end in line.ends.values())
        row = (*row, *([f"{never} of {len(line.ends)}"] if measure.is_open else []))
        rows.append((*row, *([printed.get(label, "-")] if printed else [])))
    better = "" if measure.higher_is_better else "; less is better"
    unit = f", in {measure.unit.removeprefix('of ')}" if measure.unit else ""
    return Table(head, rows, f"{part.title}: {measure.score_name}{better}. Ahead by: differences seed by seed{unit}")


def _beside(measure: Measure, reference: Line, line: Line) -> tuple[str, str]:
    """By how much the reference is ahead of a line on the seeds of both, and how often a seed of it is."""
    ours, theirs = (_turned(one.scores, measure) for one in (reference, line))
    found = paired(ours, theirs)
    less = "-"
    if found is not None:
        half = found.difference.half_width
        less = number(found.difference.mean) + ("" if half is None else f" ± {number(half)}")
    pair = [np.array(list(one.values())) for one in (ours, theirs)]
    return less, f"{probability_of_improvement(*pair):.2f}" if all(map(len, pair)) else "-"


def _testbed_table(
    figure: Figure, plan: Plan, standings: Mapping[str, Standing]
) -> tuple[Table | None, dict[str, dict[int, float]]]:
    """A line for each fit, and of each belief and fit the lowest rank correlation of all kinds of transitions."""
    head = ("belief", "transitions", "kind", "error", "variance", "error / variance", "rank correlation")
    rows, ranked = [], dict[str, dict[int, float]]()
    for testbed in figure.testbeds:
        key = f"testbed-{testbed.label}"
        if standings[key].state is not State.FINISHED:
            continue
        path = plan.jobs[key].path
        try:
            for i, fit in enumerate(read_json(path)["stored"]):
                for kind, judged in fit["kinds"].items():
                    values = (judged[name] for name in ("error", "variance", "ratio", "rank"))
                    rows.append((testbed.label, fit["environment"], kind, *map(number, values)))
                ranked.setdefault(testbed.label, {})[i] = min(one["rank"] for one in fit["kinds"].values())
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise RunError(f"cannot read {path}: {error!r}. What to do: remove it, and run this again.") from error
    return Table(head, rows, "a line for each fit") if rows else None, ranked


def _facts_of(runs: Sequence[LoadedRun], there: Sequence[int], wanted: Sequence[int]) -> dict[str, str]:
    """What to know of a figure's runs.

    Args:
        runs: each once or more.
        there: seeds of each line that there are.
        wanted: seeds of each line that there are to be.
    """
    if not runs:
        return {}
    once = list({str(run.directory): run for run in runs}.values())
    steps = [run.config.steps for run in once]
    few, many = (span(*(str(end(counts)) for end in (min, max))) for counts in (there, wanted))
    return {
        "seeds of a line": few if few == many else f"{few}, of {many} that there are to be",
        "steps": span(f"{min(steps):,}", f"{max(steps):,}"),
        "wall time": f"{duration(sum(run.rows[-1]['wall_time'] for run in once))} of {len(once)} runs together",
        "machine": _counted(run.directory.machine() or "not recorded" for run in once),
        "versions": _versions(once),
    }


def _counted(names: Iterable[str]) -> str:
    """Each name, and how many there are of it where there are several."""
    found = list(names)
    once = list(dict.fromkeys(found))
    return "; ".join(f"{name} ({found.count(name)} runs)" if len(once) > 1 else name for name in once)


def _versions(runs: Sequence[LoadedRun]) -> str:
    """Versions that the runs began with, those of JAX and the project's own; more than one where they differ."""
    found: dict[str, set[str]] = {}
    for run in runs:
        saved = run.directory.versions()
        for name in ("jaxplore", "jax", "mujoco") if saved else ():
            found.setdefault(name, set()).add(str(saved.get(name, "unknown")))
    return ", ".join(f"{name} {' and '.join(sorted(values))}" for name, values in found.items())
