"""Where a run is written: chosen, checked against what lies there, and owned while it runs."""

import contextlib
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

from experiments.runs import lock
from experiments.runs.config import RunConfig, check_room, differences
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.schedule import on_schedule
from experiments.runs.seeds import SeedRuns
from experiments.runs.spec import RunSpec
from experiments.runs.status import Status

RUNS = Path("runs")
"""Where runs go that are given no place."""


def choose(out: str | None, spec: RunSpec, *, resume: bool) -> RunDirectory:
    """The directory of a run, or of several seeds, checked against what lies there; nothing is written.

    Args:
        out: where the run is to go; None: to a new directory below `RUNS`.
        spec: the run.
        resume: whether it is to continue what lies there.

    Raises:
        RunError: it holds another run and `resume` is not set, or it cannot be resumed.
        ValueError: `resume` without `out`, or with a configuration that differs from the saved one.
    """
    if out is None:
        if resume:
            raise ValueError("--resume needs --out: the directory of the run to continue.")
        return _unused(spec)
    directory, all_seeds = RunDirectory(out), SeedRuns(out)
    there, status = directory.entries(), directory.status()
    if not resume:
        if there:
            what = "another run" if status is not Status.ABSENT or all_seeds.exists() else "other files"
            raise RunError(f"--out={out} holds {what}. Give another directory, or --resume to continue the run.")
        return directory
    if there is None:
        raise RunError(f"--out={out} is not there, so it cannot be resumed. Leave --resume out to start a run.")
    if all_seeds.exists():
        _check_more(all_seeds, spec)
        return directory
    if status is Status.ABSENT:
        if not directory.holds_only_scraps():
            raise RunError(f"--out={out} holds no run (no config.json). Give the directory of a run.")
        return directory
    _check_resume(directory, status, spec)
    return directory


def is_there(out: str | None) -> bool:
    """Whether a run, or several seeds' runs, lie in a directory: what is resumed there goes on as it was begun."""
    return out is not None and (SeedRuns(out).exists() or RunDirectory(out).status() is not Status.ABSENT)


def _unused(spec: RunSpec) -> RunDirectory:
    config = spec.config
    env = re.sub(r"[^\w.-]", "-", config.env)
    last = config.seed + config.num_seeds - 1
    seeds = f"seed{last}" if config.num_seeds == 1 else f"seeds{config.seed}-{last}"
    base = RUNS / f"{env}-{config.method}-{config.preset}-{seeds}"
    names = [base, *(base.with_name(f"{base.name}-{n}") for n in range(2, 10_000))]
    return RunDirectory(next(path for path in names if not path.exists()))


def _check_more(all_seeds: SeedRuns, spec: RunSpec) -> None:
    """Seeds that have a run each may become more, and their runs longer; each run is checked by its own process."""
    was, config = all_seeds.spec(), spec.config
    num_seeds = max(was.config.num_seeds, config.num_seeds)
    allowed = dataclasses.replace(longer_config(was.config, config), num_seeds=num_seeds)
    changed = differences(was.config, config) if allowed != config else []
    if not changed and config.steps > was.config.steps:
        _check_longer(all_seeds.path, was.config, config)
    _refuse(all_seeds.path, was, spec, changed, "more steps or seeds")


def _refuse(path: Path, was: RunSpec, spec: RunSpec, changed: list[str], more: str) -> None:
    """Refuse to resume what differs from what was saved."""
    if was.parent != spec.parent:
        changed.append(f"parent: {was.parent} -> {spec.parent}")
    if changed:
        raise ValueError(
            f"--resume: the configuration disagrees with the one saved in {path} in {'; '.join(changed)}. "
            f"Resume with the saved values (or {more}), or start a run in another --out."
        )


def _check_resume(directory: RunDirectory, status: Status, spec: RunSpec) -> None:
    if status is Status.DIVERGED:
        raise RunError(
            f"--out={directory} diverged: every seed came out with numbers that are not finite, and --resume would "
            "repeat that to the bit. Start a run with other settings in another --out."
        )
    longer = lengthens(directory, spec)
    if longer:
        _check_longer(directory.path, directory.config(), spec.config)
    if directory.is_kept() and (longer or status is not Status.FINISHED):
        raise RunError(
            f"--out={directory} is what was kept of a run, without checkpoints: it can be compared, not resumed."
        )
    changed = [] if longer else differences(directory.config(), spec.config)
    _refuse(directory.path, directory.spec(), spec, changed, "more steps")
    steps = directory.checkpoints().steps()
    if longer and steps and on_schedule(spec.config, steps) is None:
        length = spec.config.explorer.steps_per_round
        raise RunError(
            f"--out={directory} cannot be made longer: its checkpoints, of steps {', '.join(map(str, steps))}, are not "
            f"where a longer run's rounds of {length} steps end. Start a longer run in another --out."
        )


def lengthens(directory: RunDirectory, spec: RunSpec) -> bool:
    """Whether a specification is that of the run in a directory, but with more steps, and perhaps a larger replay."""
    saved = directory.config()
    return longer_config(saved, spec.config) == spec.config and spec.config.steps > saved.steps


def longer_config(saved: RunConfig, wanted: RunConfig) -> RunConfig:
    """A saved configuration with as many steps, and as large a replay, as another one, where that has more."""
    capacity = max(saved.explorer.data_capacity, wanted.explorer.data_capacity)
    explorer = dataclasses.replace(saved.explorer, data_capacity=capacity)
    return dataclasses.replace(saved, steps=max(saved.steps, wanted.steps), explorer=explorer)


def _check_longer(path: Path, saved: RunConfig, config: RunConfig) -> None:
    """A run that is made longer still has all its data, and room for more."""
    if saved.explorer.data_capacity < saved.steps:
        raise RunError(
            f"--out={path} cannot be made longer: of its {saved.steps:,} steps it keeps only the latest "
            f"{saved.explorer.data_capacity:,}, and a longer run keeps all. Start a longer run in another --out."
        )
    check_room(config)


@contextlib.contextmanager
def owned(out: str | None, spec: RunSpec, directory: RunDirectory, *, resume: bool) -> Iterator[RunDirectory]:
    """Own the directory that `choose` chose while the block runs. A new one that another process has taken since is
    passed over for the next.

    Raises:
        RunError: another process owns it, or has put a run there since.
    """
    if directory.is_kept():  # Only looked at, and perhaps not to be written to.
        yield directory
        return
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(lock.claimed(directory.path, new=out is None))
                break
            except FileExistsError:
                directory = _unused(spec)
        if out is not None:
            try:
                choose(out, spec, resume=resume)
            except ValueError as error:
                raise RunError(str(error)) from error
        yield directory
