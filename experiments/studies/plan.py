"""Figures as jobs: each run once, however many figures need it, parents before their children."""

import contextlib
import dataclasses
import enum
import functools
import json
import math
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

import envs
from experiments.analysis.tables import duration, markdown_table
from experiments.runs import inherit, lock
from experiments.runs.config import RunConfig
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import read_json, write_text
from experiments.runs.metrics import last_row
from experiments.runs.seeds import expand
from experiments.runs.spec import RunRef, RunSpec, to_json
from experiments.runs.status import Status
from experiments.studies.figures_of_paper import Cell, Figure, Testbed, config_of
from experiments.studies.seeds import PER_STATE, PROCESS
from experiments.training import build
from experiments.training.programs import make_programs

RUNS, SETTINGS, LOGS, TESTBEDS, RECORD = "runs", "settings", "logs", "testbeds", "paper.json"
"""What the directory of a paper holds beside its page."""
STATE = 32 * 2**20
"""Bytes of a seed's state without its transitions, at the most that the small presets have (5 to 26 MiB were seen)."""
ROW = 2_000
"""Bytes that a round leaves on the disk: its row, and the same as TensorBoard events."""
SMOKE_TESTBED = ("--data=acrobot", "--fit-steps=20")


class State(enum.Enum):
    """Where a job stands."""

    TO_DO = "to do"
    PARTIAL = "partial"
    """It resumes."""
    FINISHED = "finished"
    DIVERGED = "diverged"


class Job(NamedTuple):
    """One run of the plan, or one belief on the testbed."""

    key: str
    """Its identity; of a testbed, its name."""
    name: str
    """Of its directory, or of its file."""
    path: Path
    spec: RunSpec | None
    """None: a testbed."""
    words: tuple[str, ...] = ()
    """After the Python interpreter, of a testbed; a run's hang on where it stands (`command`)."""
    parent: str | None = None
    """The key of the job that it starts from."""
    figures: tuple[str, ...] = ()
    needs_walk: bool = False
    is_parent: bool = False
    """Whether another job starts from its checkpoints."""

    @property
    def seeds(self) -> range:
        """The seeds that it carries."""
        return range(0) if self.spec is None else range(self.spec.config.seed, _end(self.spec.config))


def _end(config: RunConfig) -> int:
    return config.seed + config.num_seeds


class Plan(NamedTuple):
    """All jobs, parents first, and who needs which."""

    preset: str
    out: Path
    figures: list[Figure]
    jobs: dict[str, Job]
    cells: dict[tuple[str, int, str], tuple[str, ...]]
    """Figure, part and label -> keys of its runs."""


class Standing(NamedTuple):
    """Where a job stands."""

    state: State
    step: int
    path: Path
    """Where it is: in the plan's own directory, or a finished run elsewhere."""
    reason: str = ""
    """Of one that diverged."""


def make(figures: Sequence[Figure], preset: str, out: Path) -> Plan:
    """The plan of some figures. Nothing is written.

    Seeds of an environment on the device go side by side in one run, and so do all of the smoke preset, most of whose
    time is starting; others have a run each.

    Args:
        figures: in the order in which they are to be done.
        preset: `laptop`, `paper` or `smoke`.
        out: the directory that it is for.

    Raises:
        ValueError: an environment cannot be made here, or a setting is refused.
    """
    # Absolute: a worker elsewhere has another working directory.
    out, jobs = out.absolute(), dict[str, Job]()
    cells: dict[tuple[str, int, str], tuple[str, ...]] = {}
    for figure in figures:
        for number, part in enumerate(figure.parts):
            for cell in part.of(preset):
                keys = _add(cell, preset, out, jobs, figure.name, needs_walk=part.measure.needs_walk)
                cells[figure.name, number, cell.label] = keys
        for testbed in figure.testbeds:
            job = _testbed(testbed, preset, out, figure.name)
            jobs[job.key] = job
    order = sorted(jobs.values(), key=lambda job: job.parent is not None)  # stable: the figures' order otherwise
    return Plan(preset, out, list(figures), {job.key: job for job in order}, cells)


def _add(
    cell: Cell,
    preset: str,
    out: Path,
    jobs: dict[str, Job],
    figure: str,
    *,
    needs_walk: bool = False,
) -> tuple[str, ...]:
    """Put the runs of a cell among the jobs, its parent's before them, and give their keys."""
    config = config_of(cell, preset)
    env = _environment(config)
    config = dataclasses.replace(config, backend=env.backend)
    parents: tuple[str, ...] = ()
    at = cell.parent_at.get(preset)
    if cell.parent is not None:
        parents = _add(cell.parent, preset, out, jobs, figure)
    together = env.compiled or preset == "smoke"
    first = dataclasses.replace(config, num_seeds=1)
    seeds = range(config.seed, _end(config))
    configs = [config] if together else [dataclasses.replace(first, seed=seed) for seed in seeds]
    keys = []
    for i, one in enumerate(configs):
        parent = jobs[parents[i]] if parents else None
        ref = None
        if parent is not None and parent.spec is not None:
            ref = RunRef(str(parent.path), at or parent.spec.config.steps, parent.key)
            one = inherit.take_form(one, parent.spec.config)
            jobs[parent.key] = parent._replace(is_parent=True)
        job = _job(RunSpec(one, ref), out, parent)
        known = jobs.get(job.key, job)
        names = tuple(dict.fromkeys([*known.figures, figure]))
        jobs[job.key] = known._replace(figures=names, needs_walk=known.needs_walk or needs_walk)
        keys.append(job.key)
    return tuple(keys)


@functools.cache
def _made(name: str, obs_noise: float) -> envs.Environment:
    return envs.make(name, obs_noise=obs_noise)


def _environment(config: RunConfig) -> envs.Environment:
    try:
        return _made(config.env, config.obs_noise)
    except (ImportError, RunError) as error:
        raise ValueError(f"env={config.env} cannot be made here: {error}") from error


def _job(spec: RunSpec, out: Path, parent: Job | None) -> Job:
    config, key = spec.config, spec.identity
    last = _end(config) - 1
    seeds = f"seed{last}" if config.num_seeds == 1 else f"seeds{config.seed}-{last}"
    before = f"-from-{parent.spec.config.method}" if parent is not None and parent.spec is not None else ""
    name = f"{config.env.replace(':', '-')}-{config.method}{before}-{seeds}-{key[:8]}"
    return Job(key, name, out / RUNS / name, spec, parent=parent and parent.key)


def _testbed(testbed: Testbed, preset: str, out: Path, figure: str) -> Job:
    path = out / TESTBEDS / f"{testbed.label}.json"
    own = SMOKE_TESTBED if preset == "smoke" else ("--fits=3",)
    words = ("-m", "benchmarks.beliefs", f"--method={testbed.method}", f"--preset={preset}", *own, f"--json={path}")
    return Job(f"testbed-{testbed.label}", f"testbed-{testbed.label}", path, None, words, figures=(figure,))


# Where jobs stand.


def find(places: Iterable[Path], wanted: Collection[str]) -> dict[str, Path]:
    """Finished runs in directories of runs, of these identities: identity -> where. What is damaged there is passed
    over.
    """
    found = {}
    for path in runs_in(places):
        directory = RunDirectory(path)
        with contextlib.suppress(RunError, ValueError):
            identity = directory.spec().identity
            if identity in wanted and directory.status() is Status.FINISHED:
                found.setdefault(identity, path)
    return found


def runs_in(places: Iterable[Path]) -> Iterator[Path]:
    """What lies in directories of runs; of several seeds' runs each."""
    for place in places:
        for path in sorted(place.iterdir()) if place.is_dir() else []:
            with contextlib.suppress(RunError, ValueError):
                yield from expand(path)


def look(job: Job, finished: Mapping[str, Path] | None = None) -> Standing:
    """Where a job stands: in its own directory, or finished elsewhere.

    A run that was only kept has no checkpoints, and stands in for no parent; nor where a walk is needed that it lacks.

    Args:
        job: of a plan.
        finished: runs elsewhere (`find`).

    Raises:
        RunError: its directory holds another run, or cannot be read.
        ValueError: its configuration is damaged.
    """
    if job.spec is None:
        return Standing(State.FINISHED if _is_whole(job.path) else State.TO_DO, 0, job.path)
    config, directory = job.spec.config, RunDirectory(job.path)
    status = directory.status()
    if status is not Status.ABSENT:
        found = directory.spec()
        if job.parent is None and found.identity != job.key:
            raise RunError(
                f"{job.path} holds a run of other settings (identity {found.identity}, and the plan's is {job.key}). "
                "What to do: move it away, or give another --out."
            )
    if status is Status.FINISHED:
        return Standing(State.FINISHED, config.steps, job.path)
    elsewhere = (finished or {}).get(job.key)
    if elsewhere is not None:
        other = RunDirectory(elsewhere)
        lacks_state, lacks_walk = job.is_parent and other.is_kept(), job.needs_walk and not other.has_walk()
        if not lacks_state and not lacks_walk:
            return Standing(State.FINISHED, config.steps, elsewhere)
    row = last_row(directory.metrics_path)
    step = row["step"] if row else 0
    if status is Status.DIVERGED:
        what = (row or {}).get("diverged")
        return Standing(State.DIVERGED, step, job.path, f"not finite was {what}")
    return Standing(State.PARTIAL if status is Status.PARTIAL else State.TO_DO, step, job.path)


def _is_whole(path: Path) -> bool:
    """Whether a testbed's file is there, and not half written."""
    with contextlib.suppress(OSError, ValueError):
        return bool(read_json(path))
    return False


def step_of(job: Job) -> int:
    """How far a run has come, by its rows."""
    row = last_row(RunDirectory(job.path).metrics_path) if job.spec is not None else None
    return row["step"] if row else 0


def look_all(plan: Plan, places: Iterable[Path] = ()) -> dict[str, Standing]:
    """Where all jobs of a plan stand; `places` are directories of other runs. Raises as `look`."""
    finished = find(places, plan.jobs)
    return {key: look(job, finished) for key, job in plan.jobs.items()}


def command(job: Job) -> list[str]:
    """The words after the Python interpreter that start a job, or go on with it.

    Raises:
        RunError: its directory cannot be read, or belongs to another process.
    """
    if job.spec is None:
        return list(job.words)
    directory, settings = RunDirectory(job.path), settings_of(job)
    words = ["-m", "experiments.run", f"--out={job.path}", "--processes=1"]
    if directory.status() is not Status.ABSENT:
        return [*words, "--resume"]
    if directory.entries():
        if not directory.holds_only_scraps():
            raise RunError(f"{job.path} holds other files than a run. What to do: move them, or give another --out.")
        # What a run that was killed while it started has left.
        with lock.claimed(job.path):
            for path in job.path.iterdir():
                if path.name != lock.NAME:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
    return [*words, f"--config={settings}"]


def settings_of(job: Job) -> Path:
    """The file that holds a run's settings before it starts."""
    return job.path.parent.parent / SETTINGS / f"{job.name}.json"


def log_of(job: Job) -> Path:
    """The file that a job prints to."""
    return job.path.parent.parent / LOGS / f"{job.name}.log"


def is_free(job: Job) -> bool:
    """Whether no process owns a run's directory."""
    if job.spec is None or not (job.path / lock.NAME).exists():
        return True
    try:
        with lock.claimed(job.path):
            return True
    except RunError:
        return False


def check_out(out: Path, preset: str) -> None:
    """Refuse a directory that holds something else, or the paper in another preset; nothing is written.

    Raises:
        RunError: says what it holds.
    """
    record = out / RECORD
    if record.is_file():
        try:
            was = json.loads(record.read_text())["preset"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunError(f"cannot read {record}: {error}. What to do: give another --out.") from error
        if was != preset:
            raise RunError(f"--out={out} holds the paper with preset={was}. Allowed: --preset={was}, or another --out.")
        return
    there = {name for name in RunDirectory(out).entries() or () if ".tmp" not in name}
    if there:
        raise RunError(f"--out={out} holds other files ({', '.join(sorted(there)[:3])}). Give another directory.")


def write_settings(plan: Plan, standings: Mapping[str, Standing]) -> None:
    """Make the plan's directory, with the settings of every run; parents are where they were found.

    Raises:
        RunError: it cannot be written.
    """
    try:
        plan.out.mkdir(parents=True, exist_ok=True)
        # First: with it, the directory is a paper's.
        write_text(plan.out / RECORD, json.dumps({"format": 1, "preset": plan.preset}) + "\n")
        for name in (RUNS, SETTINGS, LOGS, TESTBEDS):
            (plan.out / name).mkdir(exist_ok=True)
        for job in plan.jobs.values():
            if job.spec is not None:
                spec = job.spec
                if spec.parent is not None and job.parent is not None:
                    ref = dataclasses.replace(spec.parent, directory=str(standings[job.parent].path.absolute()))
                    spec = dataclasses.replace(spec, parent=ref)
                write_text(settings_of(job), to_json(spec))
    except OSError as error:
        raise disk_error("start the paper", plan.out, error, "start it again") from error


# What it will take.


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
    spec = _environment(config).spec
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
    todo = [plan.jobs[key] for key, one in standings.items() if one.state in (State.TO_DO, State.PARTIAL)]
    need = sum(size(job).disk for job in todo)
    place = next(path for path in (plan.out.resolve(), *plan.out.resolve().parents) if path.exists())
    free = shutil.disk_usage(place).free
    if need > free:
        raise ValueError(
            f"--out={plan.out}: {len(todo)} runs need {need / 2**30:,.1f} GiB of disk at the most, and there are "
            f"{free / 2**30:,.1f} GiB. Allowed: fewer figures, a smaller --preset, or an --out on a larger disk."
        )


Rates = Mapping[tuple[str, str, str], float]
"""Environment, method and preset -> seconds for a step of a seed."""


def rates(runs: Iterable[Path], plan: Plan | None = None) -> dict[tuple[str, str, str], float]:
    """What a step has taken in runs of before, by environment, method and preset: medians. What is damaged is passed
    over.

    Args:
        runs: directories.
        plan: whose methods are asked for; None: all.
    """
    specs = [job.spec for job in plan.jobs.values()] if plan is not None else []
    wanted = {(spec.config.env, spec.config.method) for spec in specs if spec is not None}
    found: dict[tuple[str, str, str], list[float]] = {}
    for path in runs:
        directory = RunDirectory(path)
        try:
            raw = read_json(path / "config.json")
            if plan is not None and (raw.get("env"), raw.get("method")) not in wanted:
                continue
            rows = directory.rows() if directory.is_kept() else [last_row(directory.metrics_path)]
            config, row = directory.config(), rows[-1] if rows else None
        except (RunError, ValueError, OSError):
            continue
        if row and row.get("wall_time") and row["step"] > config.explorer.warm_up_steps:
            seconds = row["wall_time"] / row["step"] / config.num_seeds
            found.setdefault((config.env, config.method, config.preset), []).append(seconds)
    return {key: sorted(values)[len(values) // 2] for key, values in found.items()}


def seconds_left(job: Job, standing: Standing, known: Rates) -> float | None:
    """How long a job still takes, from runs of before; None: there is none of its environment, method and preset."""
    if standing.state in (State.FINISHED, State.DIVERGED):
        return 0.0
    if job.spec is None:
        return None
    config = job.spec.config
    rate = known.get((config.env, config.method, config.preset))
    return None if rate is None else rate * config.num_seeds * (config.steps - standing.step)


def describe(plan: Plan, standings: Mapping[str, Standing], known: Rates, at_a_time: int | None = None) -> str:
    """The plan as text: a line for the seeds of each setting, with the estimates of what is left."""
    groups: dict[tuple[Any, ...], list[Job]] = {}
    for job in plan.jobs.values():
        what = job.name if job.spec is None else job.name.rpartition("-seed")[0]
        settings = _settings_key(job.spec) if job.spec is not None else None
        groups.setdefault((what, settings, job.figures), []).append(job)
    head = ("run", "seeds", "steps", "state", "time left", "memory each", "figures")
    lines, total, unknown, largest = [], 0.0, 0, 0
    for (what, _, figures), jobs in groups.items():
        left = [seconds_left(job, standings[job.key], known) for job in jobs]
        need = size(jobs[0]).memory
        todo = [job for job in jobs if standings[job.key].state in (State.TO_DO, State.PARTIAL)]
        total += sum(one or 0.0 for one in left)
        unknown += sum(one is None for one in left)
        largest = max(largest, need if todo else 0)
        counts = {state: sum(standings[job.key].state is state for job in jobs) for state in State}
        seeds = [seed for job in jobs for seed in job.seeds]
        steps = "-" if jobs[0].spec is None else f"{jobs[0].spec.config.steps:,}"
        there = {one.value: count for one, count in counts.items() if count}
        state = ", ".join(f"{count} {name}" if len(jobs) > 1 else name for name, count in there.items())
        time = "no run to tell from" if any(one is None for one in left) else duration(sum(one or 0.0 for one in left))
        seen = f"{min(seeds)} to {max(seeds)}" if seeds else "-"
        lines.append((what, seen, steps, state, time, f"{need / 2**30:.1f} GiB", ", ".join(figures)))
    states = [one.state for one in standings.values()]
    done = states.count(State.FINISHED)
    text = [
        f"{len(plan.figures)} figures, preset {plan.preset}: {len(plan.jobs)} runs, {done} of them finished, "
        f"{states.count(State.PARTIAL)} partial, {states.count(State.DIVERGED)} diverged",
        markdown_table(head, lines),
    ]
    text += [f"{plan.jobs[key].name} diverged: {one.reason}" for key, one in standings.items() if one.reason]
    if len(plan.jobs) > done:
        side = f", {at_a_time} at a time: {duration(total / at_a_time)}" if at_a_time else ""
        parts = [f"{duration(total)} of computing{side}"] if total else []
        parts += [f"{unknown} runs of a kind that has not been run here, so their time is not known"] if unknown else []
        text.append(f"left: {'; '.join(parts)}; up to {largest / 2**30:.1f} GiB of memory each")
    return "\n\n".join(text)


def _settings_key(spec: RunSpec) -> str:
    """The identity that all seeds of a setting would share."""
    parent = dataclasses.replace(spec.parent, directory="", identity="") if spec.parent is not None else None
    return RunSpec(dataclasses.replace(spec.config, seed=0), parent).identity
