"""Whether a claim holds: conditions on the numbers of a few seeds, each with its words."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from experiments.analysis.intervals import interval, paired
from experiments.analysis.tables import number

Answer = Literal["holds", "does not hold", "undecided", "not run"]
Scores = Mapping[str, Mapping[int, float]]
"""Label -> seed -> number, turned so that higher is better."""


class Condition(NamedTuple):
    """Something that must be so."""

    text: str
    part: int
    """Of the figure's parts, the one whose numbers are asked."""
    decide: Callable[[Scores], tuple[Answer, str]]
    """The answer, and why."""
    of_ends: bool = False
    """Whether it asks how high the curves end, and not for the measure's own number."""


def ahead(first: str, second: str, part: int = 0) -> Condition:
    """One label is ahead of another on the seeds that both have: the 95 % interval of the mean difference is above 0.
    It does not hold where the interval is below 0.
    """

    def decide(scores: Scores) -> tuple[Answer, str]:
        missing = [name for name in (first, second) if not scores.get(name)]
        if missing:
            return "not run", f"no runs of {' and '.join(missing)}"
        found = paired(scores[first], scores[second])
        if found is None:
            return "undecided", f"{first} and {second} have no seed in common"
        mean, half = found.difference
        if half is None:
            return "undecided", f"{first} less {second}: {number(mean)} on one seed"
        why = f"{first} less {second}: {number(mean)} ± {number(half)} on {len(found.seeds)} seeds"
        return "holds" if mean - half > 0 else "does not hold" if mean + half < 0 else "undecided", why

    return Condition(f"{first} ahead of {second}", part, decide)


def at_most(label: str, most: float, part: int = 0) -> Condition:
    """A label's curves end at or below a value, on average: the mean's 95 % interval is. It does not hold where the
    interval is above.
    """

    def decide(scores: Scores) -> tuple[Answer, str]:
        return _beside(label, scores, lambda low, high: (high <= most, low > most))

    return Condition(f"{label} at {most:.0%} or less", part, decide, of_ends=True)


def at_least(label: str, least: float, part: int = 0) -> Condition:
    """The curve of every seed of a label comes to a value; it does not hold where none does."""

    def decide(scores: Scores) -> tuple[Answer, str]:
        values = list(scores.get(label, {}).values())
        if not values:
            return "not run", f"no runs of {label}"
        there = sum(value >= least - 1e-6 for value in values)
        answer = "holds" if there == len(values) else "does not hold" if there == 0 else "undecided"
        return answer, f"{label} comes to {least:.0%} on {there} of {len(values)} seeds"

    return Condition(f"{label} at {least:.0%} on every seed", part, decide, of_ends=True)


def stays(label: str, part: int = 0) -> Condition:
    """A label's curves are as high later as at first, on average: the 95 % interval of the measure's number, later over
    at first, is at or above 1. It does not hold where the interval is below.
    """

    def decide(scores: Scores) -> tuple[Answer, str]:
        return _beside(label, scores, lambda low, high: (low >= 1.0, high < 1.0))

    return Condition(f"{label} as high later as at first", part, decide)


def _beside(label: str, scores: Scores, compare: Callable[[float, float], tuple[bool, bool]]) -> tuple[Answer, str]:
    values = np.array(list(scores.get(label, {}).values()))
    if not len(values):
        return "not run", f"no runs of {label}"
    mean, half = interval(values)
    good, bad = compare(mean - (half or 0.0), mean + (half or 0.0))
    width = "" if half is None else f" ± {number(half)}"
    return "holds" if good else "does not hold" if bad else "undecided", f"{label}: {number(mean)}{width}"


def judge(conditions: Sequence[Condition], scores: Sequence[Scores], ends: Sequence[Scores]) -> tuple[Answer, str]:
    """The claim's answer, and the reasons of all conditions.

    It holds if every condition does, and does not hold if one of them does not. Where there is nothing to ask, it was
    not run; where only some of it is there, it is undecided.

    Args:
        conditions: all of the claim's.
        scores: of each part, turned so that higher is better.
        ends: of each part, as they are.
    """
    if not conditions:
        return "undecided", "no rule decides this one: see the table"
    found = [condition.decide((ends if condition.of_ends else scores)[condition.part]) for condition in conditions]
    answers = [answer for answer, _ in found]
    why = "; ".join(f"{one.text}: {answer} ({how})" for one, (answer, how) in zip(conditions, found, strict=True))
    if "does not hold" in answers:
        return "does not hold", why
    if all(answer == "not run" for answer in answers):
        return "not run", why
    return "holds" if all(answer == "holds" for answer in answers) else "undecided", why
