"""The command line: `python -m experiments.run --env=ant_maze`."""

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated

import jax
import tyro

from experiments import loop, report
from experiments.config import RunConfig, differences, from_json, preset_config, to_json
from experiments.errors import RunError, disk_error

RUNS = Path("runs")
PACKAGES = (
    *("jaxplore", "jax", "jaxlib", "flax", "optax", "distrax", "mujoco", "mujoco-mjx"),
    *("brax", "gymnasium", "numpy", "orbax-checkpoint"),
)


@dataclass(frozen=True)
class CommandLine:
    """What the program does beside the run itself."""

    out: str | None = None
    """Directory of the run. Default: a new one, runs/ENV-METHOD-PRESET-seedN."""
    resume: bool = False
    """Go on with the run in --out from its latest checkpoint."""
    config: str | None = None
    """A config.json to start from, as a run saves it; flags come on top."""
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
    if jax.config.jax_compilation_cache_dir is None:
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
    preset, env = _option(argv, "preset"), _option(argv, "env")
    saved = Path(out) / "config.json" if out and "--resume" in argv else None
    if config_path is None and saved is not None and saved.exists():
        config_path = str(saved)
    if config_path is not None:
        try:
            start = from_json(Path(config_path).read_text(), config_path)
        except (OSError, UnicodeDecodeError) as error:
            raise RunError(f"cannot read the configuration {config_path}: {error}.") from error
        if preset is not None and preset != start.preset:
            raise ValueError(f"--preset={preset} disagrees with {config_path}, which has {start.preset!r}. Give one.")
    else:
        start = preset_config(preset or "laptop", env or "ant_maze")

    @dataclass(frozen=True)
    class Arguments:
        run: Annotated[RunConfig, tyro.conf.arg(name="")]
        command: Annotated[CommandLine, tyro.conf.arg(name="")]

    parsed = tyro.cli(
        Arguments,
        prog="python -m experiments.run",
        description="Explore an environment by a belief's own uncertainty, and draw what was seen.",
        default=Arguments(start, CommandLine()),
        args=list(argv),
    )
    return parsed.command, parsed.run


def choose_directory(command: CommandLine, config: RunConfig) -> Path:
    """The run's directory, checked against what lies there; nothing is written.

    Raises:
        RunError: it holds another run and `--resume` is not given, or it cannot be resumed.
        ValueError: `--resume` without `--out`, or with a configuration that differs from the saved one.
    """
    if command.out is None:
        if command.resume:
            raise ValueError("--resume needs --out: the directory of the run to go on with.")
        base = RUNS / f"{config.env}-{config.method}-{config.preset}-seed{config.seed}"
        names = [base, *(base.with_name(f"{base.name}-{n}") for n in range(2, 10_000))]
        return next(path for path in names if not path.exists())
    out = Path(command.out)
    saved = out / "config.json"
    if not command.resume:
        if out.is_dir() and any(out.iterdir()):
            what = "another run" if saved.exists() else "other files"
            raise RunError(f"--out={out} holds {what}. Give another directory, or --resume to go on with the run.")
        return out
    if not out.is_dir():
        raise RunError(f"--out={out} is not there, so it cannot be resumed. Leave --resume out to start a run.")
    if saved.exists():
        changed = differences(from_json(saved.read_text(), str(saved)), config)
        if changed:
            raise ValueError(
                f"--resume: the configuration disagrees with {saved} in {'; '.join(changed)}. "
                "Resume with the saved values, or start a run in another --out."
            )
    elif any(entry.name != "config.json.tmp" for entry in out.iterdir()):
        raise RunError(f"--out={out} holds no run (no config.json). Give the directory of a run.")
    return out


def write_config(out: Path, config: RunConfig) -> None:
    """Save the configuration and the versions, whole or not at all.

    Raises:
        RunError: the disk is full or cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in (
            ("versions.json", json.dumps(versions(), indent=2) + "\n"),
            ("config.json", to_json(config)),
        ):
            draft = out / f"{name}.tmp"
            draft.write_text(text)
            draft.replace(out / name)
    except OSError as error:
        raise disk_error("start the run", out, error, "start it again") from error


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status is 0, 1 (the run failed), 2 (bad input) or 130 (interrupted)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        command, config = parse(argv)
        if command.version:
            print("\n".join(f"{name} {version}" for name, version in versions().items()))
            return 0
        out = choose_directory(command, config)
    except (ValueError, RunError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        return carry_out(config, out, resume=command.resume)
    except ValueError as error:  # The environment and the method refuse what they cannot do when they are built.
        print(f"error: {error}", file=sys.stderr)
        return 2
    except RunError as error:
        print(f"\nerror: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"\nStopped. Go on with: python -m experiments.run --out={out} --resume", file=sys.stderr)
        return 130


def carry_out(config: RunConfig, out: Path, *, resume: bool) -> int:
    """Build, run, draw, and close with the summary table."""
    use_compilation_cache()
    env = loop.make_environment(config)
    loop.make_run_explorer(config, env)  # Refuses here, before anything is written.
    write_config(out, config)
    seeds = str(config.seed) if config.num_seeds == 1 else f"{config.seed}-{config.seed + config.num_seeds - 1}"
    print(
        f"{config.method} on {config.env} ({config.preset} preset), seed {seeds}, {config.steps:,} steps; "
        f"physics: {env.backend}, device: {jax.devices()[0].device_kind}; writing to {out}"
    )
    loop.run(config, out, env=env, resume=resume)
    print("\n" + report.write(config, out, env))
    return 0


if __name__ == "__main__":
    sys.exit(main())
