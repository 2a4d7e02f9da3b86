"""What a command line of `experiments.run` asks for: its flags, as a run's specification and what is done beside it."""

import dataclasses
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import envs
from envs.base import ENGINES
from experiments.runs import flags, modules
from experiments.runs.config import RunConfig, flag, replace
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.presets import preset_config
from experiments.runs.seeds import SeedRuns
from experiments.runs.spec import RunRef, RunSpec, from_json
from experiments.runs.upgrades import MOVED
from jaxplore.config import Sizes
from jaxplore.methods import METHODS, SHARED
from jaxplore.networks import ACTIVATIONS, INITIALIZERS
from jaxplore.validate import FieldError

PROGRAM = "python -m experiments.run"
DESCRIPTION = "Explore an environment by a belief's own uncertainty, and draw what was seen."
NOTES = f"--import=MODULE: {modules.HELP}."


@dataclass(frozen=True)
class CommandLine:
    """What the program does beside the run itself."""

    out: str | None = None
    """Directory of the run. By default a new one: runs/ENV-METHOD-PRESET-seedN."""
    resume: bool = False
    """Continue the run in --out from its latest checkpoint; with more steps, make it that much longer."""
    config: str | None = None
    """A config.json to start from, as every run saves it; other flags come on top."""
    parent: str | None = None
    """Start from the policy of another run: DIRECTORY, once it is finished, or DIRECTORY@STEP, any checkpoint of it.
    With it come the form of its network and its observation statistics, which stay as they are; critics are new and
    there are no data. The parent's steps are not among this run's, which by default are the preset's less those.
    For methods on the task's reward."""
    wandb: str | None = None
    """Also log to this project of Weights & Biases; WANDB_MODE=offline keeps it on this machine."""
    processes: int = 0
    """How many seeds run at a time, each in a process and a directory of its own below --out; 1: all side by side in
    one program and one directory; 0: where the environment runs on the host and learning on the CPU, as many as cores
    and memory allow, elsewhere 1."""
    debug: bool = False
    """Show the traceback below the message of an error."""
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
        RunError: `--config` or the run to resume cannot be read, or a module cannot be imported.
        SystemExit: `--help`, or a flag that does not exist.
    """
    named, argv = modules.take(argv)
    named += modules.of_env(flags.option(argv, "env"))
    modules.load(named)
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
    if "-h" in argv or "--help" in argv:
        print(flags.brief((start.config, CommandLine()), PROGRAM, DESCRIPTION, layout, NOTES))
        raise SystemExit(0)
    description = (
        f"{DESCRIPTION}\n\n"
        "The defaults below are those of the preset; --preset=paper --help=all shows the paper's.\n\n"
        f"Settings that {start.config.method} reads come first; one that the chosen method does not read is "
        f"refused.\n\n{NOTES}"
    )
    words = ["--help" if word == "--help=all" else word for word in argv]
    command, changes = flags.parse(
        words, (CommandLine(), start.config), prog=PROGRAM, description=description, layout=layout
    )
    if command["processes"] < 0:
        raise ValueError(
            f"--processes={command['processes']} is out of range. Allowed: a whole number, 1 or more, or 0 for as many "
            "as cores and memory allow."
        )
    paths = {name: command[name] or None for name in ("out", "config", "parent", "wandb")}
    imports = tuple(dict.fromkeys((*start.imports, *named)))
    try:
        ref = RunRef.parse(paths["parent"]) if paths["parent"] else start.parent
        config: RunConfig = with_room(replace(start.config, changes), given=flags.given(argv))
        _check_warm_up(config, changes["explorer"]["warm_up_steps"], flags.given(argv))
        check_read(argv, config)
        spec = RunSpec(config, ref, imports)
    except FieldError as error:
        raise ValueError(error.spell(flag(error.field))) from error
    return CommandLine(**{**command, **paths}), spec


def with_room(config: RunConfig, given: Collection[str]) -> RunConfig:
    """A configuration whose replay holds all steps, where a person has said how many there are (`given`, names of
    flags), and not how many it holds.
    """
    if "steps" not in given or "data_capacity" in given or config.explorer.data_capacity >= config.steps:
        return config
    explorer = dataclasses.replace(config.explorer, data_capacity=config.steps + 1)
    return dataclasses.replace(config, explorer=explorer)


def _check_warm_up(config: RunConfig, steps: int, given: Collection[str]) -> None:
    if config.warm_up == "none" and "warm_up_steps" in given and steps > 0:
        raise FieldError("warm_up_steps", steps, "0, or another --warm-up", "has nobody to act, with warm_up='none'")


def _start(argv: Sequence[str]) -> RunSpec:
    """The run that the other flags change."""
    given = {name: flags.option(argv, name) for name in ("out", "config", "preset", "env", "method")}
    known = given["method"] if given["method"] in METHODS else None
    saved = Path(str(given["out"])) / "config.json"
    resumes = given["out"] and given["config"] is None and "--resume" in argv
    if resumes and os.path.exists(saved):
        spec, source, settled = RunDirectory(str(given["out"])).spec(), str(saved), ("preset",)
    elif resumes and SeedRuns(str(given["out"])).exists():
        spec, source, settled = SeedRuns(str(given["out"])).spec(), str(given["out"]), ("preset",)
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


def check_read(argv: Sequence[str], config: RunConfig, sizes: Sizes | None = None) -> None:
    """Refuse a flag that the chosen method does not read: it would do nothing.

    Args:
        argv: the words after the program's name.
        config: what they come to.
        sizes: of the environment, where it has been made: whether actions are discrete decides on the learner.

    Raises:
        ValueError: names the flag and the methods that read it.
    """
    explorer, method = config.explorer, METHODS[config.method]
    read = method.reads(explorer, sizes)
    if sizes is None and method.actions == "any":  # A value that is the default is read, too, where they are choices.
        read |= method.reads(explorer, Sizes(1, 1, discrete=True))
    fields = {item.name for item in dataclasses.fields(explorer)}
    for name in flags.given(argv):
        field = name.partition(".")[0]
        if field not in fields or field in read:
            continue
        if sizes is not None:
            kind = "discrete" if sizes.discrete else "numbers"
            others = [known for known in method.reads(explorer, sizes) - set(SHARED) if hasattr(explorer, known)]
            raise ValueError(
                f"--{name.replace('_', '-')} does nothing with method={config.method!r} in {config.env}, where actions "
                f"are {kind}. Allowed: settings of {', '.join(sorted(others))}."
            )
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
