"""The command line: `python -m experiments.run --env=ant_maze`."""

import dataclasses
import functools
import shlex
import sys
from collections.abc import Sequence

import jax

from envs.base import Environment
from experiments import process, runtime
from experiments.analysis import report
from experiments.runs import flags, place
from experiments.runs.command import PROGRAM, CommandLine, check_read, parse
from experiments.runs.config import RunConfig, check_room, flag, path_of
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.inherit import inherit
from experiments.runs.schedule import on_schedule
from experiments.runs.seeds import SeedRuns
from experiments.runs.spec import RunSpec
from experiments.runs.status import Status
from experiments.studies import seeds
from experiments.training import build, loop, memory, parent
from experiments.training.programs import Programs, make_programs
from jaxplore.exploration import Explorer
from jaxplore.validate import FieldError


def main(argv: Sequence[str] | None = None, *, is_command: bool = False) -> int:
    """Run the command line.

    Args:
        argv: its words; None: those of this process.
        is_command: whether this process is the command, and no program that has registered something of its own. Seeds
            may then be spread over processes unasked.

    Returns:
        The exit status: 0, 1 (the run failed), 2 (bad input), 130 (interrupted) or 143 (terminated).
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    debug, directory = "--debug" in argv, None
    try:
        try:
            command, spec = parse(argv)
            resumes = command.resume and place.is_there(command.out)
            if command.config is None and not resumes:
                spec = inherited(spec, argv)
            if command.version:
                print("\n".join(f"{name} {version}" for name, version in runtime.versions().items()))
                return 0
            if command.processes > 1 or (command.resume and SeedRuns(command.out or "").exists()):
                runtime.share_device()
            env, agent, spec = prepare(spec, resume=resumes)
            check_read(argv, spec.config, build.sizes_of(env))
            split = seeds.are_split(command, spec, env, is_command=is_command)
            chosen = place.choose(command.out, spec, resume=command.resume)
            if resumes and starts_over(chosen, spec):
                with_parent(spec, env, agent)
            ready = (
                seeds.plan(command, spec, env, agent)
                if split
                else make_programs_that_fit(spec.config, env, agent, resume=resumes)
            )
        except (ValueError, RunError) as error:
            print(f"error: {error}", file=sys.stderr)
            process.show_cause(error, debug=debug)
            return 2
        with place.owned(command.out, spec, chosen, resume=command.resume) as directory:
            if isinstance(ready, seeds.Plan):
                return seeds.carry_out(ready, SeedRuns(directory.path), env, command)
            return carry_out(spec, directory, env, agent, ready, command)
    except RunError as error:
        print(f"\nerror: {error}", file=sys.stderr)
        process.show_cause(error, debug=debug)
        return 1
    except KeyboardInterrupt as stop:
        again = f"{PROGRAM} --out={shlex.quote(str(directory))} --resume"
        how = f" To continue from the latest checkpoint: {again}" if directory is not None else ""
        print(f"\nStopped.{how}", file=sys.stderr)
        return process.status_of(stop)


def inherited(spec: RunSpec, argv: Sequence[str]) -> RunSpec:
    """A run with what its parent decides on, where no flag does.

    Raises:
        ValueError: what is left of the steps does not go with a flag; names that.
    """
    try:
        return inherit(spec, flags.given(argv))
    except FieldError as error:
        raise ValueError(error.spell(flag(error.field))) from error


def prepare(spec: RunSpec, *, resume: bool) -> tuple[Environment, Explorer, RunSpec]:
    """Environment and agent, which refuse what they cannot do when they are built: before anything is written.

    A run that is resumed has its parent's policy in its checkpoints, if it has any (`starts_over`). What each seed
    takes of several seeds' runs is found out by `seeds.plan`.

    Returns:
        Them, and the specification with the physics engine that was chosen, so that another machine takes the same.

    Raises:
        ValueError: what is refused, by its flag.
        RunError: the parent's files cannot be read, or its checkpoint is damaged.
    """
    try:
        env = build.make_env(spec.config)
        spec = dataclasses.replace(spec, config=dataclasses.replace(spec.config, backend=env.backend))
        agent = build.make_agent(spec.config, env)
    except FieldError as error:
        path = path_of(spec.config, error)
        raise ValueError(error.spell(flag(path)) if path else str(error)) from error
    if spec.parent is not None and not resume:
        spec = with_parent(spec, env, agent)
    return env, agent, spec


def with_parent(spec: RunSpec, env: Environment, agent: Explorer) -> RunSpec:
    """The specification with all that is known of its parent, which is checked; of several seeds' runs, which they are.

    Raises:
        ValueError: the parent is refused, or is no longer the run that was started from.
        RunError: its files cannot be read, or its checkpoint is damaged.
    """
    assert spec.parent is not None
    found = SeedRuns(spec.parent.directory)
    try:
        if found.exists():
            parent.check_recorded(spec.parent, found.spec().identity)
            return spec
        return dataclasses.replace(spec, parent=parent.resolve(spec.parent, env, agent, spec.config))
    except FieldError as error:
        raise ValueError(error.spell(flag("parent"))) from error


def starts_over(directory: RunDirectory, spec: RunSpec) -> bool:
    """Whether a run that is resumed has no checkpoint to continue from, and so needs its parent once more."""
    if spec.parent is None or directory.status() is Status.ABSENT:
        return False
    is_open = directory.status() is Status.PARTIAL or place.lengthens(directory, spec)
    return is_open and on_schedule(spec.config, directory.checkpoints().steps()) is None


def make_programs_that_fit(config: RunConfig, env: Environment, agent: Explorer, *, resume: bool) -> Programs:
    """The programs of a run. One that does not fit into memory, or whose replay does not hold its steps, is refused;
    what is resumed has fitted before.

    Raises:
        ValueError: it does not fit; names the sizes.
    """
    if not resume:
        check_room(config)
    memory.check_steps(config)
    programs = make_programs(config, env, agent)
    if not resume:
        memory.check_arrays(config, env, programs)
    return programs


def carry_out(
    spec: RunSpec,
    directory: RunDirectory,
    env: Environment,
    agent: Explorer,
    programs: Programs,
    command: CommandLine,
) -> int:
    """Run, draw, and close with the summary table."""
    config = spec.config
    runtime.use_compilation_cache()
    if command.resume and (changed := directory.changed_versions()):
        print(f"Versions have changed, so not to the bit: {'; '.join(changed)}", file=sys.stderr)
    if directory.status() is not Status.ABSENT and place.lengthens(directory, spec):
        directory.extend(spec)
    status = directory.status()
    if not directory.is_kept():
        directory.begin(spec, build.make_scene(config, env, agent))
    if status is Status.FINISHED:
        print(f"The run in {directory} is finished: drawing it again.", flush=True)
    else:
        last = config.seed + config.num_seeds - 1
        which = f"seed {config.seed}" if config.num_seeds == 1 else f"seeds {config.seed} to {last}"
        after = f" after {spec.parent.steps:,} of {spec.parent}" if spec.parent else ""
        print(
            f"{config.method} on {config.env}: {config.preset} preset, {which}, {config.steps:,} steps{after}\n"
            f"physics: {env.backend}, learning: {jax.devices()[0].device_kind}\n"
            f"writing to {directory}",
            flush=True,
        )
        loop.run(spec, directory, env, agent, programs, resume=command.resume, wandb=command.wandb)
    print("\n" + report.write(directory))
    return 0


if __name__ == "__main__":
    process.carry_out(functools.partial(main, is_command=True))
