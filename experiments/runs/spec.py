"""What decides a run: its configuration and its parent, as `config.json` holds them."""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from experiments.runs import modules, upgrades
from experiments.runs.config import RunConfig, replace, to_dict
from experiments.runs.errors import RunError
from experiments.runs.files import parse_json
from experiments.runs.presets import preset_config
from jaxplore.methods import METHODS
from jaxplore.validate import FieldError

FORMAT = 5
"""Of what `config.json` holds. Files without a format are of the first, 0."""

WITHOUT_EFFECT = ("preset", "checkpoint_every", "keep_at", "eval_every", "eval_episodes")
"""Fields of a configuration that change nothing in what a run comes to: where its settings started from, and when it is
saved and looked at."""

SINCE: dict[tuple[str, ...], Any] = {
    ("warm_up",): "uniform",
    ("explorer", "sac", "log_std_map"): "tanh",
    ("explorer", "task_sac", "log_std_map"): "tanh",
}
"""Fields that there were not always, and what runs did before: with that value they are no part of an identity, which
so stays what it was."""


@dataclass(frozen=True)
class RunRef:
    """A run as it stood at a step."""

    directory: str
    step: int | None = None
    """None: its latest checkpoint."""
    identity: str = ""
    """Of the run (`RunSpec.identity`), so that another one in the same place is noticed."""
    before: int = 0
    """Environment steps that it counts before its own first: those of its own parent, and so on."""

    @property
    def steps(self) -> int:
        """Environment steps behind its policy, those of its own parents included; 0 as long as `step` is None."""
        return self.before + (self.step or 0)

    @classmethod
    def parse(cls, text: str) -> "RunRef":
        """A reference as it is written: `DIRECTORY` or `DIRECTORY@STEP`.

        Raises:
            FieldError: the step is not a whole number.
        """
        directory, at, step = text.rpartition("@")
        if not at:
            return cls(text)
        if not directory or not step.isdecimal():
            raise FieldError("parent", text, "DIRECTORY or DIRECTORY@STEP, the step a whole number")
        return cls(directory, int(step))

    def __str__(self) -> str:
        """As it is written."""
        return self.directory if self.step is None else f"{self.directory}@{self.step}"


@dataclass(frozen=True)
class RunSpec:
    """Everything that decides what a run comes to, software and hardware aside."""

    config: RunConfig
    parent: RunRef | None = None
    """The run whose policy this one starts from."""
    imports: tuple[str, ...] = ()
    """Modules of a person's own that its method or environment comes from."""

    def __post_init__(self) -> None:
        if self.config.warm_up == "policy" and self.parent is None:
            raise FieldError("warm_up", "policy", "uniform, none, or with a parent", "has no parent whose policy acts")

    @property
    def identity(self) -> str:
        """A hash of what decides the result, 16 hexadecimal digits.

        Two specifications have the same one if they differ only in when the run is saved and looked at, or in settings
        that its method does not read.
        """
        config = to_dict(self.config)
        read = METHODS[self.config.method].reads(self.config.explorer) if self.config.method in METHODS else None
        for path, then in SINCE.items():
            *groups, name = path
            group = functools.reduce(dict.__getitem__, groups, config)
            if group[name] == then:
                del group[name]
        config["explorer"] = {name: v for name, v in config["explorer"].items() if read is None or name in read}
        deciding = {name: value for name, value in config.items() if name not in WITHOUT_EFFECT}
        if self.parent is not None:
            deciding["parent"] = [self.parent.identity or self.parent.directory, self.parent.step]
        return hashlib.sha256(json.dumps(deciding, sort_keys=True).encode()).hexdigest()[:16]


def to_json(spec: RunSpec) -> str:
    """A specification as indented JSON: the fields of the configuration, the format, the parent and the identity."""
    parent = dataclasses.asdict(spec.parent) if spec.parent else None
    extra = {"format": FORMAT, "identity": spec.identity, "parent": parent, "imports": list(spec.imports)}
    return json.dumps({**extra, **to_dict(spec.config)}, indent=2) + "\n"


def from_json(text: str, source: str, method: str | None = None, *, as_written: bool = False) -> RunSpec:
    """A specification from JSON; fields that are left out keep the defaults of the preset and the method it names.

    Args:
        text: JSON, as `to_json` of this or an older format writes it.
        source: where it came from, for messages.
        method: the method where the text names none.
        as_written: whether the file must be as it was written: its identity that of its settings.

    Raises:
        ValueError: not JSON, an unknown field (naming the nearest match), a value that a field refuses, or with
            `as_written` one that has been changed.
        RunError: a newer format, or a module that it needs and that has not been imported.
    """
    try:
        data = parse_json(text)
    except ValueError as error:
        raise ValueError(f"{source} is not JSON: {error}.") from error
    if not isinstance(data, dict):
        raise ValueError(f"{source} holds {type(data).__name__}. Allowed: an object with the fields of a run.")
    found = data.pop("format", 0)
    if type(found) is not int or not 0 <= found <= FORMAT:
        raise RunError(
            f"{source} has format {found!r}; this version reads formats 0 to {FORMAT}. What to do: use the version "
            "of jaxplore that wrote it, which versions.json beside it names."
        )
    identity, parent = data.pop("identity", None), data.pop("parent", None)
    imports = _imports(data.pop("imports", []), source)
    modules.check(dict.fromkeys([*imports, *modules.of_env(str(data.get("env", "")))]), source)
    try:
        names = (data.get("preset", "laptop"), data.get("env", "ant_maze"), data.get("method", method or "implicit"))
        start = preset_config(*names)
        spec = RunSpec(replace(start, upgrades.upgrade(data, start, found)), _parent(parent), imports)
    except FieldError as error:
        raise ValueError(f"{source}: {error.spell(error.field)}") from error
    # A file that lacks a field is of an older version, which did not hash it.
    if as_written and identity is not None and identity != spec.identity and not _lacks(data, to_dict(spec.config)):
        raise ValueError(
            f"{source} has been changed since it was written: its settings have the identity {spec.identity}, and it "
            f"says {identity}. Allowed: the file as it was. To run other settings, give a copy to --config."
        )
    return spec


def _imports(data: Any, source: str) -> tuple[str, ...]:
    if not isinstance(data, list) or not all(isinstance(name, str) and name for name in data):
        raise ValueError(f"{source}: imports={data!r}. Allowed: a list of names of modules.")
    return tuple(data)


def _lacks(data: Mapping[str, Any], whole: Mapping[str, Any]) -> bool:
    """Whether a field of `whole` is missing in `data`, however deep."""
    return any(
        name not in data or (isinstance(value, Mapping) and _lacks(data[name], value)) for name, value in whole.items()
    )


def _parent(data: Any) -> RunRef | None:
    if data is None:
        return None
    known = {item.name for item in dataclasses.fields(RunRef)}
    if not isinstance(data, Mapping) or not {"directory"} <= data.keys() <= known:
        raise FieldError("parent", data, "null, or an object with directory, step, identity and before")
    return RunRef(**data)
