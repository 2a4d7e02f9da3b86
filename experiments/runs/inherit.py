"""What a run takes over from the configuration of its parent: the form of the policy's network, and how many steps are
left.
"""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

from experiments.runs import seeds
from experiments.runs.config import RunConfig, replace
from experiments.runs.spec import RunSpec
from experiments.runs.status import Status
from jaxplore.methods import METHODS
from jaxplore.networks import TanhGaussianPolicy

NETWORK = ("hidden", "activation", "log_std_map", "log_std_min", "log_std_max")
"""Settings of SAC that decide on what its policy's parameters mean."""
LEARNERS = ("task_sac", "sac", "gradient")
"""Groups of the explorer that describe a policy which can be handed on. Gradient ascent's is the same network as SAC's,
without a choice of `log_std_map`."""


def form_of(config: RunConfig) -> dict[str, Any]:
    """What decides on what the parameters of a run's policy mean: `NETWORK`, and `normalize_obs`. Empty where it has no
    policy that could be handed on.
    """
    group = _learner(config)
    if group is None:
        return {}
    learner = getattr(config.explorer, group)
    lasting = "model_free" in METHODS[config.method].reads(config.explorer)
    seen = config.explorer.model_free.normalize_obs if lasting else True
    fixed = {"log_std_map": TanhGaussianPolicy.log_std_map}
    return {**fixed, **{name: getattr(learner, name) for name in _names(learner)}, "normalize_obs": seen}


def paths_of_form(config: RunConfig) -> dict[str, str]:
    """Where a run has the settings of its policy's form: name -> path below the explorer. What it cannot choose has
    none.
    """
    group = _learner(config)
    if group is None:
        return {}
    paths = {name: f"{group}.{name}" for name in _names(getattr(config.explorer, group))}
    lasting = "model_free" in METHODS[config.method].reads(config.explorer)
    return {**paths, "normalize_obs": "model_free.normalize_obs"} if lasting else paths


def _names(learner: Any) -> list[str]:
    """Which of `NETWORK` can be chosen."""
    return [name for name in NETWORK if hasattr(learner, name)]


def _learner(config: RunConfig) -> str | None:
    read = METHODS[config.method].reads(config.explorer)
    return next((name for name in LEARNERS if name in read), None)


def take_form(config: RunConfig, parent: RunConfig, given: Collection[str] = ()) -> RunConfig:
    """A run's configuration with the form of its parent's policy, but for the paths in `given`."""
    theirs, changes = form_of(parent), {}
    for name, path in paths_of_form(config).items():
        if name in theirs and path not in given:
            group, _, field = path.partition(".")
            changes.setdefault(group, {})[field] = theirs[name]
    return replace(config, {"explorer": changes})


def inherit(spec: RunSpec, given: Collection[str]) -> RunSpec:
    """A run with what its parent decides on: the form of the policy, and as many steps less as it took, where that
    leaves more than the warm-up.

    Args:
        spec: of the run. One without a parent, or with one that is not there and will be refused, stays as it is.
        given: paths of settings that a person has chosen, as `flags.given` has them, which stay as they are.

    Raises:
        RunError: the parent cannot be read.
        ValueError: its configuration is damaged.
    """
    if spec.parent is None:
        return spec
    directory = seeds.one(spec.parent.directory)
    if directory.status() is Status.ABSENT:
        return spec
    parent = directory.spec()
    config = take_form(spec.config, parent.config, given)
    left = config.steps - (_before(parent) + (spec.parent.step or parent.config.steps))
    if "steps" not in given and left > config.explorer.warm_up_steps:
        config = dataclasses.replace(config, steps=left)
    return dataclasses.replace(spec, config=config)


def _before(spec: RunSpec) -> int:
    return spec.parent.steps if spec.parent else 0


def conflicts(own: RunConfig, parent: RunConfig) -> Mapping[str, tuple[Any, Any]]:
    """Where the form of a run's policy is not the parent's: path below the explorer -> the parent's and its own."""
    here, there, paths = form_of(own), form_of(parent), paths_of_form(own)
    return {
        paths.get(name, name): (value, here[name])
        for name, value in there.items()
        if name in here and here[name] != value
    }
