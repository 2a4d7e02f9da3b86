"""What a plan will take: memory, disk, and time by runs of before."""

import dataclasses
import functools
import math
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax

from experiments.analysis.tables import duration, markdown_table, spans
from experiments.runs.config import RunConfig
from experiments.runs.directory import CONFIG, RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.files import read_json
from experiments.runs.metrics import last_row
from experiments.runs.spec import RunSpec
from experiments.studies.found import setting_of
from experiments.studies.plan import Job, Plan, Standing, State, environment, open_jobs
from experiments.studies.seeds import PER_STATE, PROCESS
from experiments.training import build
from experiments.training.programs import make_programs

STATE = 32 * 2**20
"""Bytes of a seed's state without its transitions, at the most that the small presets have (5 to 26 MiB were seen)."""
ROW = 2_000
"""Bytes that a round leaves on the disk: its row, and the same as TensorBoard events."""


class Size(NamedTuple):
    """What a job needs, in bytes."""

    memory: int
    disk: int


def size(job: Job) -> Size:
    """Memory of a job's process and what it leaves on the disk, as estimates from above.

    Of the paper's preset the state is traced. Of the small ones it is what was seen, and the transitions it keeps.
    """
    if job.spec is None:
        return Size(PROCESS, 2**20)
    config = job.spec.config
    state = config.num_seeds * (_traced(_unseeded(config)) if config.preset == "paper" else _usual(config))
    rounds = math.ceil(config.steps / config.explorer.steps_per_round)
    checkpoints = 3 + len(config.keep_at)
    return Size(PROCESS + PER_STATE * state, checkpoints * state + config.num_seeds * rounds * ROW)


def _usual(config: RunConfig) -> int:
    spec = environment(config).spec
    return STATE + 4 * config.explorer.data_capacity * (2 * spec.obs_size + spec.action_size + 3)


def _unseeded(config: RunConfig) -> RunConfig:
    return dataclasses.replace(config, seed=0, num_seeds=1, eval_every=0)


@functools.cache
def _traced(config: RunConfig) -> int:
    env = build.make_env(config)
    leaves = jax.tree.leaves(make_programs(config, env, build.make_agent(config, env)).trace_init())
    return sum(leaf.size * getattr(leaf.dtype, "itemsize", 8) for leaf in leaves)


def check_disk(plan: Plan, standings: Mapping[str, Standing]) -> None:
    """Refuse a plan that is larger than what is left of the disk.

    Raises:
        ValueError: says what it needs and what there is.
    """
    todo = open_jobs(plan, standings)
    need = sum(size(job).disk for job in todo)
    place = next(path for path in (plan.out.resolve(), *plan.out.resolve().parents) if path.exists())
    free = shutil.disk_usage(place).free
    if need > free:
        raise ValueError(
            f"--out={plan.out}: {len(todo)} runs need {need / 2**30:,.1f} GiB of disk at the most, and there are "
            f"{free / 2**30:,.1f} GiB. Allowed: fewer figures, a smaller --preset, or an --out on a larger disk."
        )


class Rates(NamedTuple):
    """What a step of a seed took in runs of before, seconds; medians."""

    settings: Mapping[str, float]
    """Of runs that differ in their seed alone, by `setting_of`."""
    kinds: Mapping[tuple[str, str, str], float]
    """By environment, method and preset."""

    def of(self, spec: RunSpec) -> float | None:
        """Of a run: that of its own settings, or else of its kind; None: there is no run of before."""
        config = spec.config
        return self.settings.get(setting_of(spec), self.kinds.get((config.env, config.method, config.preset)))


def rates(runs: Iterable[Path], plan: Plan | None = None) -> Rates:
    """What a step has taken in runs of before. What is damaged is passed over.

    Args:
        runs: directories.
        plan: whose methods are asked for; None: all.
    """
    specs = [job.spec for job in plan.jobs.values()] if plan is not None else []
    wanted = {(spec.config.env, spec.config.method) for spec in specs if spec is not None}
    settings, kinds = dict[str, list[float]](), dict[tuple[str, str, str], list[float]]()
    for path in runs:
        directory = RunDirectory(path)
        try:
            raw = read_json(path / CONFIG)
            if plan is not None and (raw.get("env"), raw.get("method")) not in wanted:
                continue
            rows = directory.rows() if directory.is_kept() else [last_row(directory.metrics_path)]
            spec, row = directory.spec(), rows[-1] if rows else None
        except (RunError, ValueError, OSError):
            continue
        config = spec.config
        if row and row.get("wall_time") and row["step"] > config.explorer.warm_up_steps:
            seconds = row["wall_time"] / row["step"] / config.num_seeds
            settings.setdefault(setting_of(spec), []).append(seconds)
            kinds.setdefault((config.env, config.method, config.preset), []).append(seconds)
    return Rates(_medians(settings), _medians(kinds))


def _medians(found: Mapping[Any, list[float]]) -> dict[Any, float]:
    return {key: sorted(values)[len(values) // 2] for key, values in found.items()}


def seconds_left(job: Job, standing: Standing, known: Rates) -> float | None:
    """How long a job still takes, from runs of before; None: there is none that tells."""
    if standing.state in (State.FINISHED, State.DIVERGED):
        return 0.0
    if job.spec is None:
        return None
    config, rate = job.spec.config, known.of(job.spec)
    return None if rate is None else rate * config.num_seeds * (config.steps - standing.step)


def describe(plan: Plan, standings: Mapping[str, Standing], known: Rates, at_a_time: int | None = None) -> str:
    """The plan as text: a line for the seeds of each setting, with the estimates of what is left.

    Args:
        plan: what is to be done.
        standings: where each job stands.
        known: what steps took in runs of before.
        at_a_time: how many run at once, at most; None: that is not known.
    """
    groups: dict[tuple[Any, ...], list[Job]] = {}
    for job in plan.jobs.values():
        what = job.name if job.spec is None else job.name.rpartition("-seed")[0]
        setting = setting_of(job.spec) if job.spec is not None else None
        groups.setdefault((what, setting, job.figures), []).append(job)
    head = ("run", "seeds", "steps", "state", "time left", "memory each", "figures")
    lines = [_line(what, figures, jobs, standings, known) for (what, _, figures), jobs in groups.items()]
    states = [one.state for one in standings.values()]
    text = [
        f"{len(plan.figures)} figures, preset {plan.preset}: {len(plan.jobs)} runs, "
        f"{states.count(State.FINISHED)} of them finished, "
        f"{states.count(State.PARTIAL)} partial, {states.count(State.DIVERGED)} diverged",
        markdown_table(head, lines),
    ]
    text += [f"{plan.jobs[key].name} diverged: {one.reason}" for key, one in standings.items() if one.reason]
    todo = open_jobs(plan, standings)
    if todo:
        text.append(_left(todo, standings, known, at_a_time))
    return "\n\n".join(text)


def _line(
    what: str, figures: tuple[str, ...], jobs: list[Job], standings: Mapping[str, Standing], known: Rates
) -> tuple[str, ...]:
    left = [seconds_left(job, standings[job.key], known) for job in jobs]
    counts = {state: sum(standings[job.key].state is state for job in jobs) for state in State}
    there = {one.value: count for one, count in counts.items() if count}
    state = ", ".join(f"{count} {name}" if len(jobs) > 1 else name for name, count in there.items())
    time = "no run to tell from" if any(one is None for one in left) else duration(sum(one or 0.0 for one in left))
    spec = jobs[0].spec
    seeds = spans([seed for job in jobs for seed in job.seeds]) or "-"
    steps = "-" if spec is None else f"{spec.config.steps:,}"
    return (what, seeds, steps, state, time, f"{size(jobs[0]).memory / 2**30:.1f} GiB", ", ".join(figures))


def _left(todo: list[Job], standings: Mapping[str, Standing], known: Rates, at_a_time: int | None) -> str:
    """What is left, in a line."""
    left = [seconds_left(job, standings[job.key], known) for job in todo]
    told = [one for one in left if one is not None]
    unknown, parts = len(left) - len(told), []
    if told:
        parts.append(f"{'at least ' if unknown else ''}{duration(sum(told))} of computing")
    if told and at_a_time:
        side = min(at_a_time, len(todo))
        # No run is shorter than itself, however many go side by side.
        parts[0] += f", {side} at a time: {duration(max(sum(told) / side, *told))}"
    if unknown:
        parts.append(f"{unknown} runs of a kind that has not been run here, so their time is not known")
    memory = max(size(job).memory for job in todo)
    return f"left: {'; '.join(parts)}; up to {memory / 2**30:.1f} GiB of memory each"
