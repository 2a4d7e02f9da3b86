"""How long a whole run takes, from the rounds of its beginning."""

import itertools
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from experiments.runs.config import RunConfig
from experiments.runs.schedule import rounds


class Round(NamedTuple):
    """A round in which a run learned."""

    step: int
    """At its end: transitions held."""
    seconds: float
    fit_steps: int
    """Gradient steps of its fit."""


def fit_steps(config: RunConfig, num_data: int) -> int:
    """Gradient steps of the belief in a round with `num_data` transitions; `FitConfig.num_steps` without JAX."""
    fit = config.explorer.fit
    return fit.epochs * max(num_data // fit.batch_size, 1) if fit.epochs else fit.steps


def learning_rounds(config: RunConfig, rows: Sequence[Mapping[str, Any]]) -> list[Round]:
    """The rounds of a run's first seed that learned, but for the first one, which waited for the compiler.

    Args:
        config: of the run.
        rows: of its `metrics.jsonl`.
    """
    own = [row for row in rows if row["seed"] == config.seed]
    learned = [pair for pair in itertools.pairwise(own) if pair[1]["step"] >= config.explorer.warm_up_steps]
    return [
        Round(row["step"], row["wall_time"] - before["wall_time"], fit_steps(config, row["step"]))
        for before, row in learned[1:]
    ]


def extrapolate(
    config: RunConfig, rows: Sequence[Mapping[str, Any]], seconds_per_fit_step: float | None = None
) -> dict[str, Any] | None:
    """What a whole run takes, where its rows show only the beginning.

    A round's fit grows with the data and the rest of it stays: so many gradient steps, each of a known time, and the
    median of what the measured rounds took beside them. Compiling is not part of it.

    Args:
        config: of the run.
        rows: of its `metrics.jsonl`, from the start.
        seconds_per_fit_step: as it was measured alone. None: the slope of the measured rounds, where their fits differ
            enough for one, and else 0, which makes the result a lower bound.

    Returns:
        `seconds` of all `rounds`, from how many `rounds_measured`, whether they are `extrapolated` or those of a run
        that has ended, and by what numbers. None: no round has been measured.
    """
    measured = learning_rounds(config, rows)
    own = [row for row in rows if row["seed"] == config.seed]
    planned = [end for _, end in rounds(config, 0)]
    if own and own[-1]["step"] >= config.steps:
        return {"extrapolated": False, "seconds": own[-1]["wall_time"], "rounds": len(planned)}
    if not measured:
        return None
    slope, source = seconds_per_fit_step, "measured alone"
    if slope is None:
        slope, source = _slope(measured), "slope of the measured rounds"
    if slope is None:
        slope, source = 0.0, "unknown and taken as 0: a lower bound where fits grow"
    beside = max(0.0, statistics.median(one.seconds - slope * one.fit_steps for one in measured))
    learning = [end for end in planned if end >= config.explorer.warm_up_steps]
    gradient_steps = sum(fit_steps(config, end) for end in learning)
    random_steps = [row for row in own if row["step"] < config.explorer.warm_up_steps]
    warm_up = random_steps[-1]["wall_time"] if random_steps else 0.0
    return {
        "extrapolated": True,
        "seconds": warm_up + beside * len(learning) + slope * gradient_steps,
        "rounds": len(planned),
        "rounds_measured": len(measured),
        "last_step_measured": measured[-1].step,
        "median_seconds_per_round": statistics.median(one.seconds for one in measured),
        "seconds_beside_the_fit": beside,
        "seconds_per_fit_step": slope,
        "seconds_per_fit_step_from": source,
        "fit_steps": gradient_steps,
    }


def _slope(measured: Sequence[Round]) -> float | None:
    """Seconds per gradient step by least squares; None where fits are too much alike to tell."""
    steps = [one.fit_steps for one in measured]
    if len(set(steps)) < 3 or max(steps) < 2 * min(steps):
        return None
    return max(0.0, statistics.linear_regression(steps, [one.seconds for one in measured]).slope)
