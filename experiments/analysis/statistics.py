"""Runs as numbers that can be compared: outcomes by seed, groups by method."""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.analysis.intervals import Paired, paired
from experiments.analysis.load import LoadedRun, held, load, series
from experiments.runs.errors import RunError

POINTS = 100
"""Points of a comparison, evenly spaced: runs of different rounds meet there."""


MEASURES = (
    *("intrinsic_reward", "intrinsic_reward_p95", "policy/imagined_reward", "policy/imagined_reward_p95"),
    *("variance", "variance_p95", "divergence", "divergence_p95", "model_error"),
)
"""Fields of a run's rows about its belief, on the transitions just met and not learned from yet."""


class Outcome(NamedTuple):
    """One seed of one run."""

    seed: int
    cells: int
    """Coverage cells seen at the end."""
    reached: tuple[int, ...]
    """The step (end of its round) at which each further cell was seen: the first entry is the first cell's."""
    minutes: float
    """Wall time of its run; of seeds carried side by side, each one's share."""
    measures: dict[str, float]
    """`MEASURES`, those that there are: means over the rounds of the second half."""
    calibration: dict[str, Any] | None
    """What `experiments.calibrate` found of this seed at this step, if it was asked."""
    last_return: float | None
    """Of the last episode that ended; None: no task, or no episode ended."""
    final_return: float | None = None
    """Mean of the last evaluation; None: there was none."""


class Group(NamedTuple):
    """All seeds of one method."""

    label: str
    outcomes: list[Outcome]
    steps: np.ndarray
    """`[T]`"""
    coverage: np.ndarray
    """`[S, T]`, 0 to 1."""
    variance: np.ndarray
    """Equation 1 on the transitions just met, whatever the method's own reward, `[S, T]`; NaN without a belief."""
    evaluated: np.ndarray
    """Steps of the evaluations, `[E]`; empty where a seed has none."""
    returns: np.ndarray
    """Mean return of each evaluation, the last that there was, `[S, E]`."""

    @property
    def heights(self) -> dict[int, float]:
        """Seed -> mean height of its coverage curve, 0 to 1."""
        means = self.coverage.mean(axis=1).tolist()
        return {outcome.seed: mean for outcome, mean in zip(self.outcomes, means, strict=True)}


class Returns(NamedTuple):
    """What evaluations of one method, or of another library, earned."""

    label: str
    seeds: tuple[int, ...]
    steps: np.ndarray
    """`[E]`, those of parents included; empty where a seed has none."""
    values: np.ndarray
    """`[S, E]`"""


class PairedReturns(NamedTuple):
    """One method's returns against another's on the seeds that both have."""

    first: int
    """The first step at which both had been evaluated: one that starts from a parent begins later."""
    last: int
    """The last one."""
    final: Paired
    """At the last step."""
    mean: Paired
    """Mean over the evaluations from first to last: the area under the curve, over its length."""


def returns_of(group: Group) -> Returns:
    """The evaluations of a group."""
    return Returns(group.label, tuple(one.seed for one in group.outcomes), group.evaluated, group.returns)


def paired_returns(one: Returns, other: Returns) -> PairedReturns | None:
    """Returns compared seed by seed over the steps that both have; None where there are none, or no seed is in both.

    Where one was evaluated and the other was not, a straight line between its evaluations stands for it: runs with
    parents of 2,000 steps are evaluated at other steps than those without.
    """
    if not len(one.steps) or not len(other.steps):
        return None
    first, last = max(one.steps[0], other.steps[0]), min(one.steps[-1], other.steps[-1])
    steps = np.union1d(one.steps, other.steps)
    steps = steps[(steps >= first) & (steps <= last)]
    if not len(steps):
        return None
    own, others = (
        {seed: np.interp(steps, of.steps, line) for seed, line in zip(of.seeds, of.values, strict=True)}
        for of in (one, other)
    )
    final, mean = (
        paired(*({seed: float(part(line)) for seed, line in lines.items()} for lines in (own, others)))
        for part in (lambda line: line[-1], np.mean)
    )
    return PairedReturns(int(first), int(last), final, mean) if final and mean else None


def grid_of(first: int, last: int) -> np.ndarray:
    """Steps at which curves are compared, `[T]`: `POINTS` of them, evenly spaced up to the last, without those before
    the first row. Their mean over these is a curve's mean height.
    """
    grid = np.unique(np.linspace(last / POINTS, last, POINTS).round().astype(int))
    # A point before the first round has nothing to show: rounds are as long as the warm-up at most.
    return grid[grid >= first]


def outcomes(run: LoadedRun) -> list[Outcome]:
    """What became of each seed of a run."""
    config, rows, found = run.config, run.rows, []
    calibrated = run.directory.calibration() or {"step": None, "seeds": []}
    own_steps = config.steps - run.before
    asked = {one["seed"]: one for one in calibrated["seeds"]} if calibrated["step"] == own_steps else {}
    for seed in range(config.seed, config.seed + config.num_seeds):
        own = [row for row in rows if row["seed"] == seed]
        cells = own[-1]["cells"]
        reached = tuple(next(row["step"] for row in own if row["cells"] >= count) for count in range(1, cells + 1))
        late = [row for row in own if 2 * (row["step"] - run.before) > own_steps]
        measures = {name: [row[name] for row in late if row.get(name) is not None] for name in MEASURES}
        means = {name: float(np.mean(values)) for name, values in measures.items() if values}
        minutes = own[-1]["wall_time"] / 60 / config.num_seeds
        returns = [row["episode_return"] for row in own if row.get("episode_return") is not None]
        last_return = returns[-1] if returns else None
        evaluated = [row["eval/return"] for row in own if row.get("eval/return") is not None]
        final = evaluated[-1] if evaluated else None
        found.append(Outcome(seed, cells, reached, minutes, means, asked.get(seed), last_return, final))
    return found


def _parents(run: LoadedRun) -> str:
    return f" ({run.before} of them its parents')" if run.before else ""


def evaluations(runs: Sequence[LoadedRun]) -> tuple[np.ndarray, np.ndarray]:
    """Evaluations of all seeds of some runs, on common steps: `(steps [E], returns [S, E])`, where a seed has none its
    last one. They begin where all seeds have one; without any in one of the runs there are none.
    """
    told = [series([row for row in run.rows if row.get("eval/return") is not None], "eval/return") for run in runs]
    num_seeds = sum(run.config.num_seeds for run in runs)
    if not all(len(steps) for steps, _ in told) or sum(len(values) for _, values in told) < num_seeds:
        return np.zeros(0, int), np.zeros((num_seeds, 0))
    steps = np.unique(np.concatenate([steps for steps, _ in told]))
    steps = steps[steps >= max(own[0] for own, _ in told)]
    at = [np.searchsorted(own, steps, side="right") - 1 for own, _ in told]
    return steps, np.concatenate([held(values)[:, index] for (_, values), index in zip(told, at, strict=True)])


def group(
    runs: Sequence[Path], until: int | None = None, names: Sequence[str | None] | None = None
) -> tuple[LoadedRun, list[Group]]:
    """The runs by name, in the order in which the names come; of each the first `until` steps, or all. Steps count
    those of a run's parents.

    Args:
        runs: directories.
        until: steps to compare.
        names: of each run, what it counts under; None: its method.

    Returns:
        The first run, and a group for each name.

    Raises:
        RunError: runs differ in environment or number of steps, or a seed of a method comes twice.
    """
    loaded = [load(run, until) for run in runs]
    first = loaded[0].config
    named = [name or one.config.method for name, one in zip(names or [None] * len(loaded), loaded, strict=True)]
    labels = list(dict.fromkeys(named))
    grid = grid_of(max(min(row["step"] for row in one.rows) for one in loaded), first.steps)
    groups = []
    for label in labels:
        own: list[Outcome] = []
        curves, variances = [], []
        for path, name, run in zip(runs, named, loaded, strict=True):
            config = run.config
            if (config.env, config.steps) != (first.env, first.steps):
                raise RunError(
                    f"{path} is of {config.env} over {config.steps} steps{_parents(run)}, "
                    f"{runs[0]} of {first.env} over {first.steps}. "
                    "Compare runs of one environment and one length."
                )
            if name != label:
                continue
            steps, covered = series(run.rows, "coverage")
            at = np.searchsorted(steps, grid, side="right") - 1
            curves.append(held(covered)[:, at])
            variances.append(series(run.rows, "variance")[1][:, at])
            own += outcomes(run)
        seeds = [outcome.seed for outcome in own]
        if len(set(seeds)) < len(seeds):
            raise RunError(
                f"{label}: seed {statistics.mode(seeds)} comes twice. Give each seed of a method once, "
                "or NAME=RUN to compare settings."
            )
        evaluated = evaluations([run for name, run in zip(named, loaded, strict=True) if name == label])
        groups.append(Group(label, own, grid, np.concatenate(curves), np.concatenate(variances), *evaluated))
    return loaded[0], groups
