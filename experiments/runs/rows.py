"""The schema of a run's rows: every field of `metrics.jsonl`, its unit and what it means.

A row is one round of one seed. Fields that a method has no use for are left out. `fit/` are a belief's own words on its
last gradient step of the round, `policy/` a behaviour's on its last update, and those of a signal that learns without a
belief, `eval/` an evaluation's.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxplore.validate import FieldError

REWARD = "reward"
"""Stands for the unit of the method's intrinsic reward, which the run's scene names."""
TASK = "task reward"
"""Stands for the unit of the environment's own reward, which only the environment knows."""
PREDICTION = "per entry of a prediction, squared"


class Field(NamedTuple):
    """One field of a row."""

    name: str
    unit: str
    meaning: str
    group: str
    """Where TensorBoard shows it."""


def _fields(group: str, *fields: tuple[str, str, str]) -> list[Field]:
    return [Field(name, unit, meaning, group) for name, unit, meaning in fields]


FIELDS: dict[str, Field] = {
    field.name: field
    for field in [
        *_fields(
            "exploration",
            ("step", "environment steps", "end of the round, the random steps at the start included"),
            ("seed", "", "whose row it is"),
            ("coverage", "0 to 1", "share of the coverage cells seen so far"),
            ("cells", "cells", "coverage cells seen so far"),
            ("dropped", "steps", "of the round: physics that diverged, which is no data"),
            ("diverged", "names", "what was not finite in this round, the seed's last; left out of all other rows"),
            ("episode_return", TASK, "sum of rewards of an episode; mean over those that ended in the round"),
            ("episode_length", "steps", "of the same episodes"),
            ("intrinsic_reward", REWARD, "mean over the round's transitions, before they are learned from"),
            ("intrinsic_reward_p95", REWARD, "95th percentile of the same"),
        ),
        *_fields(
            "model",
            ("variance", "normalised delta or probability, squared", "equation 1 on the round's transitions"),
            ("variance_p95", "normalised delta or probability, squared", "95th percentile of the same"),
            (
                "variance_within",
                "normalised delta or probability, squared",
                "of `variance`, what is among networks of one of several generators; 0: they are one network",
            ),
            ("variance_within_p95", "normalised delta or probability, squared", "95th percentile of the same"),
            ("divergence", "nats", "Jensen-Renyi divergence there (of probabilities Jensen-Shannon)"),
            ("divergence_p95", "nats", "95th percentile of the same"),
            ("model_error", PREDICTION, "squared error of the models' mean on the round's transitions"),
        ),
        *_fields(
            "time",
            ("wall_time", "s", "since the run began, stops left out"),
            ("steps_per_second", "1/s", "of the round, each seed's"),
        ),
        *_fields(
            "eval",
            ("eval/return", TASK, "of whole episodes without exploring, mean"),
            ("eval/return_std", TASK, "their standard deviation"),
            ("eval/length", "steps", "their mean length"),
        ),
        *_fields(
            "fit",
            ("fit/loss", "the belief's own", "what the fit minimises, on its minibatch"),
            ("fit/squared_error", PREDICTION, "of each member on its minibatch, mean"),
            ("fit/variance", PREDICTION, "over particles on the minibatch"),
            ("fit/repulsion_variance", PREDICTION, "over particles on the repulsion points"),
            ("fit/bandwidth", PREDICTION, "h of the kernel"),
            ("fit/kernel_mean", "0 to 1", "mean of the kernel over pairs of particles"),
            ("fit/likelihood_std", "per entry of a prediction", "sigma, mean over entries"),
            ("fit/gradient_norm", "", "of the generator's gradient"),
            ("fit/dead_features", "0 to 1", "share of the generator's features that are the same for every z"),
        ),
        *_fields(
            "policy",
            ("policy/imagined_reward", REWARD, "of the last rollout, mean"),
            ("policy/imagined_reward_p95", REWARD, "95th percentile of the same"),
            ("policy/invalid_imagined", "0 to 1", "share of it that was not finite, and dropped"),
            ("policy/imagined_return", REWARD, "discounted sum over the imagined horizon"),
            ("policy/saturation", "0 to 1", "mean absolute action of the squashed mean"),
            ("policy/gradient", "", "norm of the policy's gradient"),
            ("policy/q_loss", "", "of the action values"),
            ("policy/v_loss", "", "of the value network"),
            ("policy/policy_loss", "", "of the policy"),
            ("policy/value_loss", "", "of PPO's values"),
            ("policy/loss", "", "of the action values"),
            ("policy/q", "scaled reward", "mean action value of the batch"),
            ("policy/epsilon", "0 to 1", "share of random actions"),
            ("policy/entropy", "nats", "of the policy on the batch"),
            ("policy/alpha", "", "weight of the entropy, where it is learned"),
            ("policy/information", REWARD, "that the policy's actions give on the batch, mean"),
            ("policy/slow_information", REWARD, "that the actions of its slow copy give there"),
            ("policy/information_weight", "", "weight of the information, where it is learned"),
            ("policy/kl", "nats", "from PPO's policy before the update"),
            ("policy/clipped", "0 to 1", "share of steps whose ratio PPO clips"),
            ("policy/noise_std", "", "of the noise on the policy's parameters"),
            ("policy/distance", "", "that it makes in actions"),
            ("policy/extrinsic_value", "scaled reward", "PPO's value of the task's reward"),
            ("policy/intrinsic_value", "scaled reward", "PPO's value of the bonus"),
            ("policy/rnd_error", "squared distillation error", "of the last distillation step"),
            ("policy/updated", "0 or 1", "whether PPO learned in this round"),
            ("policy/intrinsic_reward", "scaled reward", "bonus of the round's transitions as the policy gets it"),
            ("policy/intrinsic_reward_p95", "scaled reward", "95th percentile of the same"),
            ("policy/utility", REWARD, "mean over all states and actions"),
            ("policy/utility_max", REWARD, "largest over all states and actions"),
            ("policy/agreement", "0 to 1", "share of states and actions where all models agree on the successor"),
        ),
    ]
}
"""Every field by its name. A method that reports more adds its own: `FIELDS["policy/mine"] = Field(...)`."""

TIMES = ("wall_time", "steps_per_second")
"""Fields that differ between two runs that are the same."""


NEEDED = ("coverage", "cells", "wall_time")
"""Fields that every row has, beside its step and its seed."""


def check(row: Mapping[str, Any], num_cells: int) -> None:
    """Refuse a row that no run writes: one that reports cannot show.

    Args:
        row: as it was read.
        num_cells: coverage cells that there are.

    Raises:
        FieldError: names the field.
    """
    for name in NEEDED:
        if name not in row:
            raise FieldError(name, None, "a number")
    for name, value in row.items():
        # `diverged` is text; what is not finite was written as null.
        number = isinstance(value, int | float) and math.isfinite(value)
        if name != "diverged" and not number and (value is not None or name in NEEDED):
            raise FieldError(name, value, "a finite number" + ("" if name in NEEDED else " or null"))
    if not isinstance(row["cells"], int) or not 0 <= row["cells"] <= num_cells:
        raise FieldError("cells", row["cells"], f"a whole number, 0 to {num_cells}")


def unit_of(name: str, reward_unit: str | None) -> str:
    """The unit of a field, for labels; `reward_unit` is that of the method's intrinsic reward."""
    unit = FIELDS[name].unit if name in FIELDS else ""
    return (reward_unit or "no intrinsic reward") if unit == REWARD else unit


def tensorboard_tag(name: str) -> str:
    """What TensorBoard calls a field: its group, a slash, and its name. A field with a slash stays as it is."""
    if "/" in name:
        return name
    group = FIELDS[name].group if name in FIELDS else "other"
    return f"{group}/{name.removeprefix(f'{group}_')}"


def in_order(found: Iterable[str], first: Sequence[str] = ()) -> list[str]:
    """Names of columns, each once: `first`, then the schema's in its order, then what it does not know, such as a
    method's own fields. Only those that were `found`.
    """
    names = dict.fromkeys(found)
    return list(dict.fromkeys([*(name for name in (*first, *FIELDS) if name in names), *names]))
