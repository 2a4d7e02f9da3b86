"""Configurations of older formats, as today's.

Format 0, until November 2026: m stood twice (`imagination.num_models` beside `svgd.num_particles`, and for static
networks alone), and `imagination` also configured methods that imagine nothing.
Format 1, of that month: a belief had one generator, and its features were ReLU's.
Format 2, of that month: what a policy had imagined stayed as long as the policy lived.
Format 3, of that month: a generator's networks met on one batch, all data counted alike, and nothing was added to them.
Format 4, of that month: of SAC's policies all had one map to the log standard deviation.
"""

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

from experiments.runs.config import RunConfig
from jaxplore.methods import METHODS
from jaxplore.validate import FieldError

MOVED = {
    "imagination.num_models": "svgd.num_particles (the generator's m) or ensemble.num_members (static networks)",
    "reactive_updates": "reactive.updates",
}
"""Fields of the explorer that format 0 had -> where they are now."""

OLD_GENERATOR = {"noise_size", "hidden", "noise", "init_std", "constant_fraction", "bias_std"}
"""Fields of a generator before format 2."""

UNTIL_FORMAT_4: dict[str, dict[str, Any]] = {
    "generator": {"bootstrap": "none", "bootstrap_std": 1.0, "prior_scale": 0.0},
    "svgd": {"batches": "shared"},
    "ensemble": {"bootstrap_std": 1.0},
}
"""Group of the explorer -> settings that it did not have before format 4, as they then were."""

UNTIL_FORMAT_5: dict[str, dict[str, Any]] = {"sac": {"log_std_map": "tanh"}, "task_sac": {"log_std_map": "tanh"}}
"""The same of format 5."""

OLD_SAC = {"hidden", "activation", "init", "lr", "batch_size", "alpha", "discount", "tau", "reward_scale"}
"""Fields of SAC that a whole one had at all times."""

OLD_IMAGINATION = {"num_actors", "horizon", "num_rollouts", "replay_capacity", "restart_every", "act_greedily"}
"""Fields of imagination that a whole one had before format 3."""


def upgrade(data: Mapping[str, Any], start: RunConfig, found: int) -> dict[str, Any]:
    """The fields of a configuration of format `found`, as today's format has them.

    Args:
        data: field -> value, as the file has it; what it leaves out is that of `start`.
        start: the configuration that `data` changes.
        found: its format.

    Raises:
        FieldError: a setting that cannot be expressed any more.
    """
    data = copy.deepcopy(dict(data))
    explorer = data.get("explorer")
    if not isinstance(explorer, dict):
        return data
    if found < 2:
        then = {"activation": "relu", "normalize": False, "num_generators": 1}
        _as_they_were(explorer, "generator", OLD_GENERATOR, then)
    if found < 3:
        _as_they_were(explorer, "imagination", OLD_IMAGINATION, {"keep_imagined": True})
    if found < 4:
        for group, then in UNTIL_FORMAT_4.items():
            fields = {field.name for field in dataclasses.fields(getattr(start.explorer, group))}
            _as_they_were(explorer, group, fields - then.keys(), then)
    if found < 5:
        for group, then in UNTIL_FORMAT_5.items():
            _as_they_were(explorer, group, OLD_SAC, then)
    if found > 0:
        return data
    imagination = explorer.get("imagination", {})
    if isinstance(imagination, dict):
        _upgrade_models(explorer, imagination, start)
        _upgrade_reactive(explorer, imagination, start)
    return data


def _as_they_were(explorer: dict[str, Any], group: str, whole: set[str], then: dict[str, Any]) -> None:
    """Settings that a group did not have yet, as they `then` were, whatever a preset has now. A group without all of
    its `whole` fields was written by a person, who leaves the rest to the preset.
    """
    own = explorer.get(group)
    if isinstance(own, dict) and own.keys() >= whole:
        explorer[group] = {**then, **own}


def _upgrade_models(explorer: dict[str, Any], imagination: dict[str, Any], start: RunConfig) -> None:
    """m stands once: particles of the generator, members of an ensemble."""
    num = imagination.pop("num_models", None)
    if num is None:
        return
    particles = explorer.get("svgd", {}).get("num_particles", start.explorer.svgd.num_particles)
    reads = METHODS[start.method].reads(start.explorer)
    if "svgd" in reads and num != particles:
        allowed = f"explorer.svgd.num_particles={particles}, which is now the only m of a generator"
        raise FieldError("explorer.imagination.num_models", num, allowed)
    explorer.setdefault("ensemble", {}).setdefault("num_members", num)


def _upgrade_reactive(explorer: dict[str, Any], imagination: dict[str, Any], start: RunConfig) -> None:
    """Methods that imagine nothing have a configuration of their own."""
    updates = explorer.pop("reactive_updates", None)
    if "reactive" in explorer or (updates is None and not imagination):
        return
    old, now = start.explorer.imagination, start.explorer.reactive
    was = {name: imagination.get(name, getattr(old, name)) for name in old.__dataclass_fields__}
    # 0 stood for as many updates as imagination comes to.
    if updates == 0 or (updates is None and now.updates == _num_updates(old.__dict__)):
        updates = _num_updates(was)
    explorer["reactive"] = {
        "updates": now.updates if updates is None else max(1, updates),
        **{name: was[name] for name in ("restart_every", "normalize_reward", "act_greedily")},
    }


def _num_updates(imagination: Mapping[str, Any]) -> int:
    """Updates of the policy in a round, on real and on imagined data."""
    trained = max(0, imagination["num_rollouts"] - imagination["num_random_rollouts"])
    return imagination["real_updates"] + trained * imagination["updates_per_rollout"]
