"""The command line: `python -m experiments.run --env=ant_maze`."""

import dataclasses
import os
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax

import envs
from envs.base import ENGINES, Environment
from experiments import runtime
from experiments.analysis import report
from experiments.runs import flags
from experiments.runs.config import RunConfig, differences, flag, path_of, replace
from experiments.runs.directory import RunDirectory, Status
from experiments.runs.errors import RunError
from experiments.runs.presets import preset_config
from experiments.runs.spec import RunRef, RunSpec, from_json
from experiments.runs.upgrades import MOVED
from experiments.training import build, loop, parent
from jaxplore.exploration import Explorer
from jaxplore.methods import METHODS
from jaxplore.networks import ACTIVATIONS, INITIALIZERS
from jaxplore.validate import FieldError

PROGRAM = "python -m experiments.run"
RUNS = Path("runs")


@dataclass(frozen=True)
class CommandLine:
    """What the program does beside the run itself."""

    out: str | None = None
    """Directory of the run. By default a new one: runs/ENV-METHOD-PRESET-seedN."""
    resume: bool = False
    """Continue the run in --out from its latest checkpoint."""
    config: str | None = None
    """A config.json to start from, as every run saves it; other flags come on top."""
    parent: str | None = None
    """Start from the policy of another run: DIRECTORY or DIRECTORY@STEP (by default its latest checkpoint). Its
    observation statistics come with it; critics are new and there are no data. For methods on the task's reward."""
    version: bool = False
    """Print the versions of everything that results depend on, and stop."""


def parse(argv: Sequence[str]) -> tuple[CommandLine, RunSpec]:
    """What a command line asks for.

    Args:
        argv: the words after the program's name.

    Returns:
        The invocation and the run: the preset's (or `--config`'s, or with `--resume` the saved one), changed by the
        flags.

    Raises:
        ValueError: bad input, with the field, the value and what is allowed.
        RunError: `--config` or the run to resume cannot be read.
        SystemExit: `--help`, or a flag that does not exist.
    """
    start = _start(argv)
    method = METHODS[start.config.method]
    layout = flags.Layout(
        unprefixed=["explorer"],
        choices={
            "env": [*envs.FACTORIES, *(f"{package}:NAME" for package in envs.ADAPTERS)],
            "method": list(METHODS),
            "backend": ["auto", *ENGINES],
            "activation": list(ACTIVATIONS),
            "init": list(INITIALIZERS),
        },
        first=method.reads(start.config.explorer),
        moved={flag(f"explorer.{old}"): new for old, new in MOVED.items()},
    )
    description = (
        "Explore an environment by a belief's own uncertainty, and draw what was seen.\n\n"
        "The defaults below are those of the preset; --preset=paper --help shows the paper's.\n\n"
        f"Settings that {start.config.method} reads come first; one that the chosen method does not read is refused."
    )
    command, changes = flags.parse(
        argv, (CommandLine(), start.config), prog=PROGRAM, description=description, layout=layout
    )
    words = {name: command[name] or None for name in ("out", "config", "parent")}
    try:
        ref = RunRef.parse(words["parent"]) if words["parent"] else start.parent
        config: RunConfig = replace(start.config, changes)
        check_read(argv, config)
    except FieldError as error:
        raise ValueError(error.spell(flag(error.field))) from error
    return CommandLine(**{**command, **words}), RunSpec(config, ref)


def _start(argv: Sequence[str]) -> RunSpec:
    """The run that the other flags change."""
    given = {name: flags.option(argv, name) for name in ("out", "config", "preset", "env", "method")}
    known = given["method"] if given["method"] in METHODS else None
    saved = Path(str(given["out"])) / "config.json"
    if given["out"] and given["config"] is None and "--resume" in argv and os.path.exists(saved):
        spec, source, settled = RunDirectory(str(given["out"])).spec(), str(saved), ("preset",)
    elif given["config"] is not None:
        spec, source, settled = _read(Path(given["config"]), known), given["config"], ("preset", "method")
    else:
        # One that is not known is refused with the other flags.
        preset, env = given["preset"] or "laptop", given["env"] or "ant_maze"
        return RunSpec(preset_config(preset, env, known or "implicit"))
    # Other settings hang on these, and the file has settled them.
    for name in settled:
        if given[name] is not None and given[name] != getattr(spec.config, name):
            has = getattr(spec.config, name)
            raise ValueError(f"--{name}={given[name]} disagrees with {source}, which has {has!r}. Give one.")
    return spec


def _read(path: Path, method: str | None) -> RunSpec:
    try:
        return from_json(path.read_text(), str(path), method)
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"cannot read the configuration {path}: {error}.") from error


def check_read(argv: Sequence[str], config: RunConfig) -> None:
    """Refuse a flag that the chosen method does not read: it would do nothing.

    Raises:
        ValueError: names the flag and the methods that read it.
    """
    explorer, method = config.explorer, METHODS[config.method]
    fields = {item.name for item in dataclasses.fields(explorer)}
    for name in flags.given(argv):
        field = name.partition(".")[0]
        if field not in fields or field in method.reads(explorer):
            continue
        variants = [dataclasses.replace(explorer, planner=planner) for planner in ("sac", "mcts")]
        reading = [known for known, row in METHODS.items() if any(field in row.reads(one) for one in variants)]
        if config.method in reading:
            other = next(one.planner for one in variants if field in method.reads(one))
            raise ValueError(
                f"--{name.replace('_', '-')} does nothing with --planner={explorer.planner}. "
                f"Allowed: with --planner={other}."
            )
        raise ValueError(
            f"--{name.replace('_', '-')} does nothing with method={config.method!r}, which does not read it. "
            f"Allowed: with one of the methods {', '.join(reading)}."
        )


def choose_directory(command: CommandLine, spec: RunSpec) -> RunDirectory:
    """The run's directory, checked against what lies there; nothing is written.

    Raises:
        RunError: it holds another run and `--resume` is not given, or it cannot be resumed.
        ValueError: `--resume` without `--out`, or with a configuration that differs from the saved one.
    """
    config = spec.config
    if command.out is None:
        if command.resume:
            raise ValueError("--resume needs --out: the directory of the run to continue.")
        env = re.sub(r"[^\w.-]", "-", config.env)
        base = RUNS / f"{env}-{config.method}-{config.preset}-seed{config.seed}"
        names = [base, *(base.with_name(f"{base.name}-{n}") for n in range(2, 10_000))]
        return RunDirectory(next(path for path in names if not path.exists()))
    out = RunDirectory(command.out)
    there, status = out.entries(), out.status()
    if not command.resume:
        if there:
            what = "another run" if status is not Status.ABSENT else "other files"
            raise RunError(f"--out={out} holds {what}. Give another directory, or --resume to continue the run.")
        return out
    if there is None:
        raise RunError(f"--out={out} is not there, so it cannot be resumed. Leave --resume out to start a run.")
    if status is Status.ABSENT:
        if not out.holds_only_scraps():
            raise RunError(f"--out={out} holds no run (no config.json). Give the directory of a run.")
        return out
    if status is Status.DIVERGED:
        raise RunError(
            f"--out={out} diverged: every seed came out with numbers that are not finite, and --resume would repeat "
            "that to the bit. Start a run with other settings in another --out."
        )
    changed = differences(out.config(), config)
    was = out.spec().parent
    if was != spec.parent:
        changed.append(f"parent: {was} -> {spec.parent}")
    if changed:
        raise ValueError(
            f"--resume: the configuration disagrees with the one saved in {out} in {'; '.join(changed)}. "
            "Resume with the saved values, or start a run in another --out."
        )
    if out.is_kept() and status is not Status.FINISHED:
        raise RunError(f"--out={out} is what was kept of a run, without checkpoints: it can be compared, not resumed.")
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status is 0, 1 (the run failed), 2 (bad input) or 130 (interrupted)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        command, spec = parse(argv)
        if command.version:
            print("\n".join(f"{name} {version}" for name, version in runtime.versions().items()))
            return 0
        env, agent, spec = prepare(spec, resume=command.resume)
        directory = choose_directory(command, spec)
    except (ValueError, RunError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        return carry_out(spec, directory, env, agent, resume=command.resume)
    except RunError as error:
        print(f"\nerror: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        again = f"{PROGRAM} --out={shlex.quote(str(directory))} --resume"
        print(f"\nStopped. To continue from the latest checkpoint: {again}", file=sys.stderr)
        return 130


def prepare(spec: RunSpec, *, resume: bool) -> tuple[Environment, Explorer, RunSpec]:
    """Environment and agent, which refuse what they cannot do when they are built: before anything is written.

    A run that is resumed has its parent's policy in its checkpoints.

    Returns:
        Them, and the specification with the physics engine that was chosen, so that another machine takes the same.

    Raises:
        ValueError: what is refused, by its flag.
    """
    try:
        env = build.make_env(spec.config)
        spec = dataclasses.replace(spec, config=dataclasses.replace(spec.config, backend=env.backend))
        agent = build.make_agent(spec.config, env)
        if spec.parent is not None and not resume:
            spec = dataclasses.replace(spec, parent=parent.resolve(spec.parent, env, agent))
        return env, agent, spec
    except FieldError as error:
        path = "parent" if error.field == "parent" else path_of(spec.config, error)
        raise ValueError(error.spell(flag(path)) if path else str(error)) from error


def carry_out(spec: RunSpec, directory: RunDirectory, env: Environment, agent: Explorer, *, resume: bool) -> int:
    """Run, draw, and close with the summary table."""
    config = spec.config
    runtime.use_compilation_cache()
    if resume and (changed := directory.changed_versions()):
        print(f"Versions have changed, so not to the bit: {'; '.join(changed)}", file=sys.stderr)
    status = directory.status()
    if not directory.is_kept():
        directory.begin(spec, build.make_scene(config, env, agent))
    if status is Status.FINISHED:
        print(f"The run in {directory} is finished: drawing it again.", flush=True)
    else:
        last = config.seed + config.num_seeds - 1
        seeds = f"seed {config.seed}" if config.num_seeds == 1 else f"seeds {config.seed} to {last}"
        print(
            f"{config.method} on {config.env}: {config.preset} preset, {seeds}, {config.steps:,} steps\n"
            f"physics: {env.backend}, learning: {jax.devices()[0].device_kind}\n"
            f"writing to {directory}",
            flush=True,
        )
        loop.run(spec, directory, env, agent, resume=resume)
    print("\n" + report.write(directory))
    return 0


if __name__ == "__main__":
    sys.exit(main())
