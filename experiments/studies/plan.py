"""Figures as jobs: each run once, however many figures need it, parents before their children.

What a figure's line wants is seeds of a setting. Those that a finished run carries, wherever it lies and beside
whatever other seeds, are taken from there; what is left becomes jobs.
"""

import contextlib
import dataclasses
import enum
import functools
import json
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import envs
from experiments.runs import inherit, lock
from experiments.runs.config import RunConfig
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import read_json, write_text
from experiments.runs.metrics import last_row
from experiments.runs.spec import RunRef, RunSpec, to_json
from experiments.runs.status import Status
from experiments.studies.figures_of_paper import Cell, Figure, Part, Testbed, config_of
from experiments.studies.found import Found, find, seeds_of, setting_of
from experiments.training import build

RUNS, SETTINGS, LOGS, TESTBEDS, RECORD = "runs", "settings", "logs", "testbeds", "paper.json"
"""What the directory of a paper holds beside its page."""
SMOKE_TESTBED = ("--data=acrobot", "--fit-steps=20")


class State(enum.Enum):
    """Where a job stands."""

    TO_DO = "to do"
    PARTIAL = "partial"
    """It resumes."""
    FINISHED = "finished"
    DIVERGED = "diverged"


class Job(NamedTuple):
    """One run of the plan, here or, finished, elsewhere; or one belief on the testbed."""

    key: str
    """Its identity; of a testbed, its name."""
    name: str
    """Of its directory, or of its file."""
    path: Path
    """Where it is, or will be: among the plan's own runs, or where a finished run was found."""
    spec: RunSpec | None
    """None: a testbed."""
    words: tuple[str, ...] = ()
    """After the Python interpreter, of a testbed; a run's hang on where it stands (`command`)."""
    parent: str | None = None
    """The key of the job that it starts from."""
    figures: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    """Those of its seeds that figures take from it, or the runs that start from it."""


class Taken(NamedTuple):
    """What a line of a figure takes."""

    keys: tuple[str, ...]
    """Of the runs."""
    seeds: tuple[int, ...]
    """All that it wants, of whichever run."""


class Plan(NamedTuple):
    """All jobs, parents first, and who needs which."""

    preset: str
    out: Path
    figures: list[Figure]
    jobs: dict[str, Job]
    cells: dict[tuple[str, int, str], Taken]
    """Figure, part and label -> what it takes."""


class Standing(NamedTuple):
    """Where a job stands."""

    state: State
    step: int
    reason: str = ""
    """Of one that diverged."""


@dataclasses.dataclass
class _Setting:
    """Runs that differ in their seed alone, and what is wanted of them."""

    spec: RunSpec
    """Of its first seed; without the parent's identity."""
    parent: str | None
    """The key of the setting that it starts from."""
    together: bool
    """Whether its seeds go side by side in one run."""
    wanted: dict[str, set[int]] = dataclasses.field(default_factory=dict)
    """Figure -> seeds."""
    needs_walk: bool = False
    needs_returns: bool = False
    states: dict[int, set[int]] = dataclasses.field(default_factory=dict)
    """Seed -> steps whose checkpoints unfinished runs start from."""
    taken: dict[Found, set[int]] = dataclasses.field(default_factory=dict)
    """Runs that are there -> the seeds that are taken from each."""
    missing: set[int] = dataclasses.field(default_factory=set)
    """Seeds of runs that are still to be made."""
    jobs: list[Job] = dataclasses.field(default_factory=list)

    @property
    def seeds(self) -> set[int]:
        """All seeds that are wanted."""
        return set().union(*self.wanted.values())


def make(figures: Sequence[Figure], preset: str, out: Path, places: Iterable[Path] = ()) -> Plan:
    """The plan of some figures. Nothing is written.

    A seed is done if a finished run carries it whose settings are the same but for the seeds, in which it did not
    diverge, and which has what the figures need of it: a walk, evaluations, checkpoints for others to start from.

    Missing seeds of an environment on the device go side by side in one run, and so do all of the smoke preset, most of
    whose time is starting; others have a run each.

    Args:
        figures: in the order in which they are to be done.
        preset: `laptop`, `paper` or `smoke`.
        out: the directory that it is for.
        places: directories of other runs.

    Raises:
        ValueError: an environment cannot be made here, or a setting is refused.
        RunError: a run in `out` is finished and lacks something; says what.
    """
    # Absolute: a worker elsewhere has another working directory.
    out, settings = out.absolute(), dict[str, _Setting]()
    lines: dict[tuple[str, int, str], tuple[str, tuple[int, ...]]] = {}
    for figure in figures:
        for number, part in enumerate(figure.parts):
            for cell in part.of(preset):
                lines[figure.name, number, cell.label] = _want(cell, preset, settings, figure.name, part)
    kinds = {(one.spec.config.env, one.spec.config.method) for one in settings.values()}
    there = find(out / RUNS, places, kinds)
    runs = {key: there.get(setting_of(one.spec), []) for key, one in settings.items()}
    for key in reversed(settings):  # Children first: what is left of them decides on what their parents must have.
        _take(key, settings, runs)
    for key in settings:
        _plan_jobs(key, settings, out)
    jobs = {job.key: job for one in settings.values() for job in one.jobs}
    order = sorted(jobs.values(), key=lambda job: job.parent is not None)  # stable: the figures' order otherwise
    names = [figure.name for figure in figures]
    order = [job._replace(figures=tuple(sorted(job.figures, key=names.index))) for job in order]
    order += [_testbed(one, preset, out, figure.name) for figure in figures for one in figure.testbeds]
    cells = {line: _taken(settings[key], seeds) for line, (key, seeds) in lines.items()}
    return Plan(preset, out, list(figures), {job.key: job for job in order}, cells)


def _want(
    cell: Cell, preset: str, settings: dict[str, _Setting], figure: str, part: Part | None
) -> tuple[str, tuple[int, ...]]:
    """Put what a cell wants among the settings, its parent's before it, and give its key and the seeds. What is wanted
    of a parent is not known yet, and `part` is None.
    """
    config = config_of(cell, preset)
    env = environment(config)
    config, parent, ref = dataclasses.replace(config, backend=env.backend), None, None
    if cell.parent is not None:
        parent, _ = _want(cell.parent, preset, settings, figure, None)
        theirs = settings[parent].spec.config
        ref = RunRef("", cell.parent_at.get(preset) or theirs.steps)
        config = inherit.take_form(config, theirs)
    spec = RunSpec(config, ref)
    key = f"{setting_of(spec)} of {parent}"
    together = env.compiled or preset == "smoke"
    one = settings.setdefault(key, _Setting(spec, parent, together))
    seeds = tuple(seeds_of(config))
    if part is not None:
        one.wanted.setdefault(figure, set()).update(seeds)
        one.needs_walk |= part.measure.needs_walk
        one.needs_returns |= part.measure.needs_returns
    return key, seeds


@functools.cache
def _made(name: str, obs_noise: float) -> envs.Environment:
    return envs.make(name, obs_noise=obs_noise)


def environment(config: RunConfig) -> envs.Environment:
    """The environment of a configuration, made once for all that ask.

    Raises:
        ValueError: it cannot be made here.
    """
    try:
        return _made(config.env, config.obs_noise)
    except (ImportError, RunError) as error:
        raise ValueError(f"env={config.env} cannot be made here: {error}") from error


def _take(key: str, settings: Mapping[str, _Setting], runs: Mapping[str, Sequence[Found]]) -> None:
    """Take the seeds of a setting from the runs that have them, and ask its parent for what the others start from.

    Raises:
        RunError: one of the plan's own runs is finished and lacks something.
    """
    one = settings[key]
    own, missing = [run for run in runs[key] if _starts_right(run, key, settings, runs)], set(one.seeds)
    for run in own:
        seeds = {seed for seed in run.finished() if seed in missing and not _lacks(run, one, seed)}
        if seeds:
            one.taken[run] = seeds
            missing -= seeds
    from_parent = set(missing)
    for run in own:
        seeds = missing & set(run.seeds)
        if not run.is_own or not seeds:
            continue
        for seed in seeds & set(run.finished()):
            raise RunError(
                f"{run.path} is finished and has no {_lacks(run, one, seed)}, which {', '.join(one.wanted)} needs. "
                "What to do: move it away, or give another --out."
            )
        one.taken[run] = one.taken.get(run, set()) | seeds
        missing -= seeds
        # What is finished has diverged in these seeds; what has a checkpoint goes on from that.
        if run.status is not Status.PARTIAL or run.directory.checkpoints().steps():
            from_parent -= seeds
    one.missing = missing
    if one.parent is not None and one.spec.parent is not None:
        for figure, seeds in one.wanted.items():
            if seeds & from_parent:
                settings[one.parent].wanted.setdefault(figure, set()).update(seeds & from_parent)
        for seed in from_parent:
            settings[one.parent].states.setdefault(seed, set()).add(one.spec.parent.step or 0)


def _starts_right(run: Found, key: str, settings: Mapping[str, _Setting], runs: Mapping[str, Sequence[Found]]) -> bool:
    """Whether a run of a setting starts from a run of the parent that is meant, each seed from the same one."""
    parent = settings[key].parent
    if parent is None or run.spec.parent is None:
        return parent is None
    theirs = [
        other.spec.identity
        for other in runs[parent]
        if other.seeds[0] == run.seeds[0] and len(other.seeds) >= len(run.seeds)
        if _starts_right(other, parent, settings, runs)
    ]
    return run.spec.parent.identity in (_identity(parent, settings, run.seeds), *theirs)


def _identity(key: str, settings: Mapping[str, _Setting], seeds: range) -> str:
    """The identity that a run of these seeds would have, its parent a run of the same."""
    one = settings[key]
    ref = one.spec.parent
    if one.parent is not None and ref is not None:
        ref = dataclasses.replace(ref, identity=_identity(one.parent, settings, seeds))
    return RunSpec(dataclasses.replace(one.spec.config, seed=seeds[0], num_seeds=len(seeds)), ref).identity


def _lacks(run: Found, one: _Setting, seed: int) -> str:
    """What a finished run has not that is needed of a seed; empty: nothing."""
    if one.needs_walk and not run.directory.has_walk():
        return "walk"
    if one.needs_returns and one.spec.config.eval_every and not run.spec.config.eval_every:
        return "evaluations"
    gone = one.states.get(seed, set()).difference(run.directory.checkpoints().steps())
    return f"checkpoint of step {min(gone):,}" if gone else ""


def _plan_jobs(key: str, settings: Mapping[str, _Setting], out: Path) -> None:
    """The jobs of a setting, those of its parent being known: runs that were found, and those that are missing."""
    one = settings[key]
    parents = settings[one.parent].jobs if one.parent is not None else []
    before = f"-from-{settings[one.parent].spec.config.method}" if one.parent is not None else ""
    for run, seeds in one.taken.items():
        parent = None
        if run.status is Status.PARTIAL:
            parent = next((job.key for job in parents if run.seeds[0] in job.seeds), None)
        one.jobs.append(_job(run.spec, run.path, before, one, seeds, parent))
    for group in _groups(one, parents):
        config, ref = dataclasses.replace(one.spec.config, seed=group[0], num_seeds=len(group)), one.spec.parent
        parent = next((job for job in parents if group[0] in job.seeds), None)
        if ref is not None and parent is not None:
            ref = dataclasses.replace(ref, directory=str(parent.path), identity=parent.key)
        job = _job(RunSpec(config, ref), None, before, one, one.missing & set(group), parent and parent.key)
        one.jobs.append(job._replace(path=out / RUNS / job.name))
    one.jobs.sort(key=lambda job: job.seeds)


def _groups(one: _Setting, parents: Sequence[Job]) -> list[range]:
    """Missing seeds, as the runs that they go in."""
    missing = sorted(one.missing)
    if parents:
        # A seed takes over from the one with its place, so seeds are together as they are in their parent.
        both = [(seeds_of(job.spec.config), one.missing & set(job.seeds)) for job in parents if job.spec is not None]
        return [range(theirs[0], max(own) + 1) for theirs, own in both if own]
    if not one.together:
        return [range(seed, seed + 1) for seed in missing]
    if missing and build.draws_itself(one.spec.config.env):
        return [range(one.spec.config.seed, missing[-1] + 1)]
    starts = [seed for seed in missing if seed - 1 not in one.missing]
    ends = [seed + 1 for seed in missing if seed + 1 not in one.missing]
    return [range(*pair) for pair in zip(starts, ends, strict=True)]


def _job(
    spec: RunSpec, path: Path | None, before: str, one: _Setting, seeds: Collection[int], parent: str | None
) -> Job:
    config, key = spec.config, spec.identity
    first, last = seeds_of(config)[0], seeds_of(config)[-1]
    name = f"{config.env.replace(':', '-')}-{config.method}{before}-"
    name += f"seed{last}-{key[:8]}" if config.num_seeds == 1 else f"seeds{first}-{last}-{key[:8]}"
    figures = tuple(figure for figure, wanted in one.wanted.items() if wanted & set(seeds))
    return Job(key, name, path or Path(), spec, parent=parent, figures=figures, seeds=tuple(sorted(seeds)))


def _taken(setting: _Setting, seeds: tuple[int, ...]) -> Taken:
    return Taken(tuple(job.key for job in setting.jobs if set(seeds) & set(job.seeds)), seeds)


def _testbed(testbed: Testbed, preset: str, out: Path, figure: str) -> Job:
    path = out / TESTBEDS / f"{testbed.label}.json"
    own = SMOKE_TESTBED if preset == "smoke" else ("--fits=3",)
    words = ("-m", "benchmarks.beliefs", f"--method={testbed.method}", f"--preset={preset}", *own, f"--json={path}")
    return Job(f"testbed-{testbed.label}", f"testbed-{testbed.label}", path, None, words, figures=(figure,))


# Where jobs stand.


def look(job: Job) -> Standing:
    """Where a job stands.

    Raises:
        RunError: its directory holds another run, or cannot be read.
        ValueError: its configuration is damaged.
    """
    if job.spec is None:
        return Standing(State.FINISHED if _is_whole(job.path) else State.TO_DO, 0)
    config, directory = job.spec.config, RunDirectory(job.path)
    status = directory.status()
    if status is not Status.ABSENT:
        found = directory.spec()
        if found.identity != job.key:
            raise RunError(
                f"{job.path} holds a run of other settings (identity {found.identity}, and the plan's is {job.key}). "
                "What to do: move it away, or give another --out."
            )
    if status is Status.FINISHED:
        return Standing(State.FINISHED, config.steps)
    row = last_row(directory.metrics_path)
    step = row["step"] if row else 0
    if status is Status.DIVERGED:
        what = " and ".join(dict.fromkeys(str(how["what"]) for how in directory.diverged().values()))
        return Standing(State.DIVERGED, step, f"not finite was {what or (row or {}).get('diverged')}")
    return Standing(State.PARTIAL if status is Status.PARTIAL else State.TO_DO, step)


def _is_whole(path: Path) -> bool:
    """Whether a testbed's file is there, and not half written."""
    with contextlib.suppress(OSError, ValueError):
        return bool(read_json(path))
    return False


def step_of(job: Job) -> int:
    """How far a run has come, by its rows."""
    row = last_row(RunDirectory(job.path).metrics_path) if job.spec is not None else None
    return row["step"] if row else 0


def look_all(plan: Plan) -> dict[str, Standing]:
    """Where all jobs of a plan stand. Raises as `look`."""
    return {key: look(job) for key, job in plan.jobs.items()}


def open_jobs(plan: Plan, standings: Mapping[str, Standing]) -> list[Job]:
    """Those that are still to be done, or to be finished."""
    return [plan.jobs[key] for key, one in standings.items() if one.state in (State.TO_DO, State.PARTIAL)]


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


def write_record(plan: Plan) -> None:
    """Make the plan's directory a paper's: with its record, later commands know it for one.

    Raises:
        RunError: it cannot be written.
    """
    try:
        plan.out.mkdir(parents=True, exist_ok=True)
        write_text(plan.out / RECORD, json.dumps({"format": 1, "preset": plan.preset}) + "\n")
    except OSError as error:
        raise disk_error("start the paper", plan.out, error, "start it again") from error


def write_settings(plan: Plan, standings: Mapping[str, Standing]) -> None:
    """Make the plan's directory, with the settings of every run that is still to be done.

    Raises:
        RunError: it cannot be written.
    """
    write_record(plan)  # First: with it, the directory is a paper's.
    try:
        for name in (RUNS, SETTINGS, LOGS, TESTBEDS):
            (plan.out / name).mkdir(exist_ok=True)
        for job in open_jobs(plan, standings):
            if job.spec is not None:
                write_text(settings_of(job), to_json(job.spec))
    except OSError as error:
        raise disk_error("start the paper", plan.out, error, "start it again") from error
