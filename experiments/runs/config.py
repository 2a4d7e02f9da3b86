"""The settings of a run: one frozen configuration that checks itself, and how its fields are called and changed."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import envs
from jaxplore import validate
from jaxplore.config import ExplorationConfig
from jaxplore.methods import METHODS
from jaxplore.validate import Checks, FieldError

Preset = Literal["laptop", "paper", "smoke"]
PRESETS: tuple[str, ...] = get_args(Preset)
WarmUp = Literal["uniform", "policy", "none"]

MOST_SEEDS = 2**32
"""How many seeds there are."""


@dataclass(frozen=True)
class RunConfig:
    """One run: an environment, a method, seeds, and every setting."""

    env: str = "ant_maze"
    """Environment to explore: one of ours, or `gymnasium:ID`, `gymnasium:MODULE:ID` (which imports the module first),
    `brax:NAME`, `playground:NAME`."""
    method: str = "implicit"
    """How to explore: a row of the methods table (`jaxplore/methods.py`), such as `implicit` (the paper's), `max`,
    `disagreement`, `icm` or `random` (uniform actions)."""
    preset: Preset = "laptop"
    """Where the other settings start from: `laptop` (10,000 steps in minutes on 2 CPU cores), `paper` (the paper's
    numbers), `smoke` (under a minute)."""
    seed: int = 0
    """First seed. A seed that is carried beside others ends as it would alone, but for rounding (on the device products
    of several seeds round otherwise), and in `nchain`, whose flip states are those of the first seed."""
    num_seeds: int = 1
    """How many seeds, counting up from the first: side by side in one program, or each in a process (`--processes`)."""
    steps: int = 10_000
    """Environment steps of each seed, the random ones at the start included. Those of a `--parent` come before: by
    default they are taken off, so that both together are as many, where that leaves any."""
    warm_up: WarmUp = "uniform"
    """Who acts in the first `warm_up_steps`, in which nothing is learned: `uniform` actions, the `policy` of the
    parent, drawn as it explores, or `none`, which learns from the first round on and has no such steps."""
    backend: str = "auto"
    """Physics: `mjx` (on the device), `mujoco` (C, on the host), or `auto` (`mujoco` on a CPU, else `mjx`)."""
    obs_noise: float = 0.0
    """Standard deviation of Gaussian noise on each observation, raw units."""
    checkpoint_every: int = 1_000
    """Steps between two checkpoints, of which the two latest are kept."""
    keep_at: tuple[int, ...] = ()
    """Steps whose checkpoints are kept for good, such as `2000,4000`, for other runs to start from: each the end of a
    round."""
    eval_every: int = 0
    """Steps between two evaluations: whole episodes without exploring, whose return is logged as `eval/return`. They
    change nothing else. 0: none. Only where there is a task."""
    eval_episodes: int = 5
    """Episodes of an evaluation."""
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
        if self.seed + self.num_seeds > MOST_SEEDS:
            # JAX's keys would take such a seed modulo 2**32, and be another seed's.
            allowed = f"at most {MOST_SEEDS - 1} (with num_seeds={self.num_seeds}: {MOST_SEEDS - self.num_seeds})"
            raise checks.refusal("seed", "is out of range", allowed)
        checks.at_least("eval_every", 0)
        checks.at_least("eval_episodes", 1)
        checks.in_range("obs_noise", 0.0)
        self._check_warm_up(checks)
        for step in self.keep_at:
            length, ends = self.explorer.steps_per_round, (self.explorer.warm_up_steps, self.steps)
            if type(step) is not int or not 0 < step <= self.steps or (step % length and step not in ends):
                allowed = f"ends of rounds up to {ends[1]}: multiples of steps_per_round={length}, {ends[0]}, {ends[1]}"
                raise FieldError("keep_at", step, allowed, "cannot be kept", "RunConfig")
        if self.steps < self.explorer.warm_up_steps:
            allowed = f"at least warm_up_steps={self.explorer.warm_up_steps}"
            raise checks.refusal("steps", "ends within the random steps at the start", allowed)

    def _check_warm_up(self, checks: Checks) -> None:
        checks.one_of("warm_up", get_args(WarmUp))
        if self.warm_up == "none":
            object.__setattr__(self, "explorer", dataclasses.replace(self.explorer, warm_up_steps=0))
        elif self.explorer.warm_up_steps == 0:
            raise checks.refusal("warm_up", "has no steps, as warm_up_steps=0", "none, or warm_up_steps of 1 or more")


def to_dict(config: Any) -> dict[str, Any]:
    """A configuration as nested dictionaries."""
    return dataclasses.asdict(config)


def replace(config: Any, data: Mapping[str, Any], prefix: str = "") -> Any:
    """`config` with the fields in `data`, nested ones too.

    Args:
        config: a configuration.
        data: field -> value, or a mapping of the same kind for a field that is a configuration.
        prefix: of the fields' paths in messages; for the recursion.

    Raises:
        FieldError: an unknown field, a value of the wrong type, or one that the configuration refuses. Its `field` is
            the path, such as `explorer.sac.lr`.
    """
    known = {item.name for item in dataclasses.fields(config)}
    changes = {}
    for name, value in data.items():
        path = f"{prefix}{name}"
        validate.one_of("field", path, [f"{prefix}{field}" for field in known])
        current = getattr(config, name)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise FieldError(path, value, "an object")
            changes[name] = replace(current, value, f"{path}.")
        else:
            changes[name] = _typed(path, value, current)
    try:
        return dataclasses.replace(config, **changes)
    except FieldError as error:
        # One of `config` itself: those of the configurations in it have their path already.
        raise error.at(prefix) if error.field in known else error from None


def _typed(path: str, value: Any, current: Any) -> Any:
    """`value` in the type of the field's present value."""
    if isinstance(current, tuple) and isinstance(value, list | tuple):
        return tuple(value)
    if isinstance(current, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(current):
        raise FieldError(path, value, f"a value of type {type(current).__name__}")
    return value


def flag(path: str) -> str:
    """The flag of a field: `explorer.sac.batch_size` is `--sac.batch-size`."""
    return "--" + path.removeprefix("explorer.").replace("_", "-")


def check_room(config: RunConfig) -> None:
    """Refuse a run whose replay does not hold all its steps.

    Raises:
        ValueError: names the capacity and what fits.
    """
    if config.explorer.data_capacity < config.steps:
        raise ValueError(
            f"--data-capacity={config.explorer.data_capacity} is less than the run's {config.steps} steps, so that the "
            f"oldest data would be lost. Allowed: {config.steps} or more."
        )


def path_of(config: RunConfig, error: FieldError) -> str | None:
    """The path of the field that an error is about; None where no configuration in `config` has it.

    What is refused while the parts of a run are built names the class (`PPOConfig.rollout_steps`), not the path.
    """

    def search(part: Any, prefix: str) -> str | None:
        for item in dataclasses.fields(part):
            value = getattr(part, item.name)
            if dataclasses.is_dataclass(value):
                found = search(value, f"{prefix}{item.name}.")
                if found:
                    return found
            elif (type(part).__name__, item.name) == (error.owner, error.field):
                return f"{prefix}{item.name}"
        return None

    # An environment refuses an option of its own by name, as any function does.
    if not error.owner and error.field in {item.name for item in dataclasses.fields(config)}:
        return error.field
    return search(config, "")


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
