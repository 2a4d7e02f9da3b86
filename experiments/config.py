"""What a run is: one frozen, validated configuration, its presets, and its JSON form."""

import dataclasses
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, cast, get_args

import envs
from experiments import presets
from jaxplore import validate
from jaxplore.methods import METHODS, ExplorationConfig
from jaxplore.validate import Checks

Preset = Literal["laptop", "paper", "smoke"]
PRESETS: tuple[str, ...] = get_args(Preset)


@dataclass(frozen=True)
class RunConfig:
    """One run: an environment, a method, seeds, and every setting."""

    env: str = "ant_maze"
    """Environment to explore: one of ours, or `gymnasium:ID`, `brax:NAME`, `playground:NAME`."""
    method: str = "implicit"
    """How to explore: a row of the methods table (`jaxplore/methods.py`), such as `implicit` (the paper's), `max`,
    `disagreement`, `icm` or `random` (uniform actions)."""
    preset: Preset = "laptop"
    """Where the other settings start from: `laptop` (10,000 steps in minutes on 2 CPU cores), `paper` (the paper's
    numbers), `smoke` (under a minute)."""
    seed: int = 0
    """First seed."""
    num_seeds: int = 1
    """Seeds carried side by side: seed, seed + 1, ..."""
    steps: int = 10_000
    """Environment steps of each seed, the random ones at the start included."""
    backend: str = "auto"
    """Physics: `mjx` (on the device), `mujoco` (C, on the host), or `auto` (`mujoco` on a CPU, else `mjx`)."""
    obs_noise: float = 0.0
    """Standard deviation of Gaussian noise on each observation, raw units."""
    checkpoint_every: int = 1_000
    """Steps between two checkpoints."""
    coverage_dims: tuple[str, ...] = ()
    """Count coverage over these one to three observation entries, by index or name (`0,1`), in place of the
    environment's own cells."""
    explorer: ExplorationConfig = field(default_factory=ExplorationConfig)

    def __post_init__(self) -> None:
        checks = Checks(self)
        entries = tuple(part.strip() for entry in self.coverage_dims for part in str(entry).split(","))
        object.__setattr__(self, "coverage_dims", entries)
        envs.check_name(self.env)
        validate.one_of("method", self.method, METHODS)
        validate.one_of("preset", self.preset, PRESETS)
        checks.at_least("seed", 0)
        for name in ("num_seeds", "steps", "checkpoint_every"):
            checks.at_least(name, 1)
        checks.in_range("obs_noise", 0.0)
        if self.steps < self.explorer.warm_up_steps:
            raise ValueError(
                f"RunConfig.steps={self.steps} ends within the random steps at the start. "
                f"Allowed: at least warm_up_steps={self.explorer.warm_up_steps}."
            )


def preset_config(preset: str, env: str = "ant_maze", method: str = "implicit") -> RunConfig:
    """The configuration that a preset stands for, with the settings that the method departs in.

    Raises:
        ValueError: unknown `preset`, `env` or `method`, naming the nearest match.
    """
    validate.one_of("preset", preset, PRESETS)
    validate.one_of("method", method, METHODS)
    envs.check_name(env)
    config = RunConfig(env=env, method=method, preset=cast(Preset, preset), **presets.settings(preset, env))
    return dataclasses.replace(config, explorer=METHODS[method].settings(config.explorer))


def to_json(config: Any) -> str:
    """A configuration as indented JSON."""
    return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def from_json(text: str, source: str, method: str | None = None) -> RunConfig:
    """A configuration from JSON; fields that are left out keep the defaults of the preset and the method it names.

    Args:
        text: JSON, as `to_json` writes it.
        source: where it came from, for messages.
        method: the method where the text names none.

    Raises:
        ValueError: not JSON, an unknown field (naming the nearest match), or a value that a field refuses.
    """
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{source} is not JSON: {error}.") from error
    if not isinstance(data, dict):
        raise ValueError(f"{source} holds {type(data).__name__}. Allowed: an object with the fields of a run.")
    try:
        start = preset_config(
            data.get("preset", "laptop"), data.get("env", "ant_maze"), data.get("method", method or "implicit")
        )
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    return replace(start, data, lambda path: f"{source}: {path}")


def replace(config: Any, data: Mapping[str, Any], spell: Callable[[str], str], prefix: str = "") -> Any:
    """`config` with the fields in `data`, nested ones too.

    Args:
        config: a configuration.
        data: field -> value, or a mapping of the same kind for a field that is a configuration.
        spell: what a message calls the field with a path such as `explorer.sac.lr`.
        prefix: of the paths; for the recursion.

    Raises:
        ValueError: an unknown field, a value of the wrong type, or one that the configuration refuses.
    """
    known = {item.name for item in dataclasses.fields(config)}
    changes = {}
    for name, value in data.items():
        path = f"{prefix}{name}"
        validate.one_of(spell("field"), path, [f"{prefix}{field}" for field in known])
        current = getattr(config, name)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ValueError(f"{spell(path)}={value!r}. Allowed: an object.")
            changes[name] = replace(current, value, spell, f"{path}.")
        else:
            changes[name] = _typed(spell(path), value, current)
    try:
        return dataclasses.replace(config, **changes)
    except ValueError as error:
        text, count = re.subn(rf"\b{type(config).__name__}\.(\w+)", lambda m: spell(prefix + m[1]), str(error))
        if count == 0:  # A check between fields, or one that does not say which configuration it is of.
            text = re.sub(r"^(\w+)(?==)", lambda m: spell(prefix + m[1]) if m[1] in known else m[1], text)
        raise ValueError(text) from error


def _typed(name: str, value: Any, current: Any) -> Any:
    """`value` in the type of the field's present value."""
    if isinstance(current, tuple) and isinstance(value, list | tuple):
        return tuple(value)
    if isinstance(current, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(current):
        raise ValueError(f"{name}={value!r}. Allowed: a value of type {type(current).__name__}.")
    return value


def flag(path: str) -> str:
    """The flag of a field: `explorer.sac.batch_size` is `--sac.batch-size`."""
    return "--" + path.removeprefix("explorer.").replace("_", "-")


def differences(saved: RunConfig, wanted: RunConfig) -> list[str]:
    """The fields in which two configurations differ, as `name: saved -> wanted`."""

    def walk(a: Any, b: Any, prefix: str) -> list[str]:
        lines = []
        for item in dataclasses.fields(a):
            left, right = getattr(a, item.name), getattr(b, item.name)
            if dataclasses.is_dataclass(left):
                lines += walk(left, right, "" if item.name == "explorer" else f"{prefix}{item.name}.")
            elif left != right:
                lines.append(f"{prefix}{item.name}: {left!r} -> {right!r}")
        return lines

    return walk(saved, wanted, "")
