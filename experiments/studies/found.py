"""Runs that are there already, by what they are but for their seeds."""

import contextlib
import dataclasses
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from experiments.runs.config import RunConfig
from experiments.runs.directory import CONFIG, RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.files import read_json
from experiments.runs.seeds import expand
from experiments.runs.spec import RunSpec
from experiments.runs.status import Status
from experiments.training import build

Kind = tuple[str, str]
"""Environment and method."""


def setting_of(spec: RunSpec) -> str:
    """What decides a run but for its seeds: an identity that all seeds of a setting share.

    A seed that is carried beside others ends as alone but for rounding, so how many there are does not matter. Where
    the environment draws itself from the first seed that one stays in it. Of a parent, which has seeds of its own, only
    the step is in it.
    """
    config = spec.config
    first = config.seed if build.draws_itself(config.env) else 0
    parent = dataclasses.replace(spec.parent, directory="", identity="") if spec.parent is not None else None
    return RunSpec(dataclasses.replace(config, seed=first, num_seeds=1), parent).identity


class Found(NamedTuple):
    """A run that is there."""

    path: Path
    """Absolute: a worker elsewhere has another working directory."""
    spec: RunSpec
    status: Status
    is_own: bool
    """Whether it lies among the plan's own runs."""

    @property
    def directory(self) -> RunDirectory:
        """Its directory."""
        return RunDirectory(self.path)

    @property
    def seeds(self) -> range:
        """All seeds that it carries."""
        return seeds_of(self.spec.config)

    def finished(self) -> list[int]:
        """Seeds that took all their steps. Raises `RunError` if the directory cannot be read."""
        if self.status is not Status.FINISHED:
            return []
        diverged = self.directory.diverged()
        return [seed for seed in self.seeds if seed not in diverged]


def seeds_of(config: RunConfig) -> range:
    """The seeds of a configuration."""
    return range(config.seed, config.seed + config.num_seeds)


def runs_in(places: Iterable[Path]) -> Iterator[Path]:
    """What lies in directories of runs; of several seeds' runs each."""
    for place in places:
        for path in sorted(place.iterdir()) if place.is_dir() else []:
            with contextlib.suppress(RunError, ValueError):
                yield from expand(path)


def find(own: Path, places: Iterable[Path], kinds: Collection[Kind]) -> dict[str, list[Found]]:
    """Runs by their setting: those of the plan's own directory, however far they are, and finished ones elsewhere. What
    is damaged is passed over.

    Args:
        own: the directory of the plan's own runs.
        places: other directories of runs.
        kinds: environments and methods that are looked for.

    Returns:
        Setting -> runs, the plan's own first.
    """
    found: dict[str, list[Found]] = {}
    for is_own, paths in ((True, runs_in([own])), (False, runs_in(places))):
        for path in paths:
            with contextlib.suppress(RunError, ValueError, OSError):
                raw = read_json(path / CONFIG)
                if (raw.get("env"), raw.get("method")) not in kinds:
                    continue
                directory = RunDirectory(path)
                one = Found(path.absolute(), directory.spec(), directory.status(), is_own)
                if is_own or one.status is Status.FINISHED:
                    found.setdefault(setting_of(one.spec), []).append(one)
    return found
