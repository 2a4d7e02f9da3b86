"""The command line: `python -m experiments.run --env=ant_maze`."""

import dataclasses
import json
import os
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

import envs
from envs.base import ENGINES, Environment
from experiments import flags, loop, report
from experiments.config import RunConfig, differences, flag, from_json, preset_config, replace, to_json
from experiments.errors import RunError, disk_error
from jaxplore.methods import METHODS
from jaxplore.networks import ACTIVATIONS, INITIALIZERS

PROGRAM = "python -m experiments.run"
RUNS = Path("runs")
SCRAPS = {"versions.json", "versions.json.tmp", "config.json.tmp"}
"""What a run that was killed while it started may have left."""
PACKAGES = (
    *("jaxplore", "jax", "jaxlib", "flax", "optax", "distrax", "mujoco", "mujoco-mjx"),
    *("brax", "gymnasium", "numpy", "orbax-checkpoint"),
)


@dataclass(frozen=True)
class CommandLine:
    """What the program does beside the run itself."""

    out: str | None = None
    """Directory of the run. By default a new one: runs/ENV-METHOD-PRESET-seedN."""
    resume: bool = False
    """Go on with the run in --out from its latest checkpoint."""
    config: str | None = None
    """A config.json to start from, as every run saves it; other flags come on top."""
    version: bool = False
    """Print the versions of everything that results depend on, and stop."""


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    found = {"python": sys.version.split()[0]}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's own cache directory, unless JAX has been told of another."""
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    directory = Path(base) / "jaxplore" / "jax"
    try:
        # Compiled code is run without being checked: nobody else may write here.
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _option(argv: Sequence[str], name: str) -> str | None:
    """The value of `--name VALUE` or `--name=VALUE`; the last one given."""
    found = None
    for i, word in enumerate(argv):
        if word == f"--{name}" and i + 1 < len(argv):
            found = argv[i + 1]
        elif word.startswith(f"--{name}="):
            found = word.partition("=")[2]
    return found


def parse(argv: Sequence[str]) -> tuple[CommandLine, RunConfig]:
    """What a command line asks for.

    Args:
        argv: the words after the program's name.

    Returns:
        The invocation and the run's configuration: the preset's (or `--config`'s, or with `--resume` the saved run's),
        changed by the flags.

    Raises:
        ValueError: bad input, with the field, the value and what is allowed.
        RunError: `--config` or the run to resume cannot be read.
        SystemExit: `--help`, or a flag that does not exist.
    """
    out, config_path = _option(argv, "out"), _option(argv, "config")
    preset, env, method = _option(argv, "preset"), _option(argv, "env"), _option(argv, "method")
    resumed = config_path is None and out and "--resume" in argv and os.path.exists(Path(out) / "config.json")
    if resumed:
        config_path = str(Path(str(out)) / "config.json")
    if config_path is not None:
        start = _read_config(Path(config_path), method if method in METHODS else None)
        # Other settings hang on these two, and the file has settled them. Of a run to resume, another method is told
        # beside all else that differs.
        for name, given, saved in (("preset", preset, start.preset), ("method", method, start.method)):
            if given is not None and given != saved and not (resumed and name == "method"):
                raise ValueError(f"--{name}={given} disagrees with {config_path}, which has {saved!r}. Give one.")
    else:
        # One that is not known is refused with the other flags.
        start = preset_config(preset or "laptop", env or "ant_maze", method if method in METHODS else "implicit")
    command, changes = flags.parse(
        argv,
        (CommandLine(), start),
        prog=PROGRAM,
        description=(
            "Explore an environment by a belief's own uncertainty, and draw what was seen.\n\n"
            "The defaults below are those of the preset; --preset=paper --help shows the paper's."
        ),
        unprefixed=["explorer"],
        choices={
            "env": [*envs.FACTORIES, *(f"{package}:NAME" for package in envs.ADAPTERS)],
            "method": list(METHODS),
            "backend": ["auto", *ENGINES],
            "activation": list(ACTIVATIONS),
            "init": list(INITIALIZERS),
        },
    )
    command = {name: value or None if name in ("out", "config") else value for name, value in command.items()}
    return CommandLine(**command), replace(start, changes, flag)


def choose_directory(command: CommandLine, config: RunConfig) -> Path:
    """The run's directory, checked against what lies there; nothing is written.

    Raises:
        RunError: it holds another run and `--resume` is not given, or it cannot be resumed.
        ValueError: `--resume` without `--out`, or with a configuration that differs from the saved one.
    """
    if command.out is None:
        if command.resume:
            raise ValueError("--resume needs --out: the directory of the run to go on with.")
        env = re.sub(r"[^\w.-]", "-", config.env)
        base = RUNS / f"{env}-{config.method}-{config.preset}-seed{config.seed}"
        names = [base, *(base.with_name(f"{base.name}-{n}") for n in range(2, 10_000))]
        return next(path for path in names if not path.exists())
    out = Path(command.out)
    saved = out / "config.json"
    try:
        there = {entry.name for entry in out.iterdir()} if out.is_dir() else None
    except OSError as error:
        raise disk_error("look for a run", out, error) from error
    if not command.resume:
        if there:
            what = "another run" if saved.name in there else "other files"
            raise RunError(f"--out={out} holds {what}. Give another directory, or --resume to go on with the run.")
        return out
    if there is None:
        raise RunError(f"--out={out} is not there, so it cannot be resumed. Leave --resume out to start a run.")
    if saved.name in there:
        changed = differences(_read_config(saved), config)
        if changed:
            raise ValueError(
                f"--resume: the configuration disagrees with {saved} in {'; '.join(changed)}. "
                "Resume with the saved values, or start a run in another --out."
            )
    elif there - SCRAPS:
        raise RunError(f"--out={out} holds no run (no config.json). Give the directory of a run.")
    return out


def _read_config(path: Path, method: str | None = None) -> RunConfig:
    try:
        return from_json(path.read_text(), str(path), method)
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"cannot read the configuration {path}: {error}.") from error


def write_config(out: Path, config: RunConfig) -> None:
    """Save the configuration and the versions, whole or not at all; those of a run that goes on stay as they are.

    Raises:
        RunError: the disk is full or cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in (
            ("versions.json", json.dumps(versions(), indent=2) + "\n"),
            ("config.json", to_json(config)),
        ):
            if not (out / name).exists():
                draft = out / f"{name}.tmp"
                draft.write_text(text)
                draft.replace(out / name)
    except OSError as error:
        raise disk_error("start the run", out, error, "start it again") from error


def changed_versions(out: Path) -> list[str]:
    """What has another version now than when the run in `out` began, as `name: then -> now`."""
    try:
        then: dict[str, Any] = json.loads((out / "versions.json").read_text())
    except (OSError, ValueError):
        return []
    return [f"{name}: {then[name]} -> {now}" for name, now in versions().items() if then.get(name, now) != now]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status is 0, 1 (the run failed), 2 (bad input) or 130 (interrupted)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        command, config = parse(argv)
        if command.version:
            print("\n".join(f"{name} {version}" for name, version in versions().items()))
            return 0
        # The environment and the method refuse what they cannot do when they are built: before anything is written.
        env = loop.make_environment(config)
        config = dataclasses.replace(config, backend=env.backend)  # So that another machine takes the same.
        loop.make_run_explorer(config, env)
        out = choose_directory(command, config)
    except (ValueError, RunError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        return carry_out(config, out, env, resume=command.resume)
    except RunError as error:
        print(f"\nerror: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        again = f"{PROGRAM} --out={shlex.quote(str(out))} --resume"
        print(f"\nStopped. To go on from the latest checkpoint: {again}", file=sys.stderr)
        return 130


def carry_out(config: RunConfig, out: Path, env: Environment, *, resume: bool) -> int:
    """Run, draw, and close with the summary table."""
    use_compilation_cache()
    if resume and (changed := changed_versions(out)):
        print(f"Versions have changed, so not to the bit: {'; '.join(changed)}", file=sys.stderr)
    write_config(out, config)
    if resume and loop.is_finished(out):
        print(f"The run in {out} is finished: drawing it again.", flush=True)
    else:
        last = config.seed + config.num_seeds - 1
        seeds = f"seed {config.seed}" if config.num_seeds == 1 else f"seeds {config.seed} to {last}"
        print(
            f"{config.method} on {config.env}: {config.preset} preset, {seeds}, {config.steps:,} steps\n"
            f"physics: {env.backend}, learning: {jax.devices()[0].device_kind}\n"
            f"writing to {out}",
            flush=True,
        )
        loop.run(config, out, env=env, resume=resume)
    print("\n" + report.write(config, out, env))
    return 0


if __name__ == "__main__":
    sys.exit(main())
