"""Whether a claim holds: conditions on the numbers of a few seeds, each with its words."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from experiments.analysis.intervals import interval, paired
from experiments.analysis.pages.contents import Reason, Verdict
from experiments.analysis.tables import number

Answer = Literal["holds", "does not hold", "undecided", "not run"]
Scores = Mapping[str, Mapping[int, float]]
"""Label -> seed -> number."""
NONE: Mapping[str, Any] = {}


class Numbers(NamedTuple):
    """What conditions ask of one part of a figure."""

    scores: Scores = NONE
    """The measure's own, turned so that higher is better."""
    unit: str = ""
    """Of their differences, as words after a number."""
    ends: Scores = NONE
    """How high the curves end."""
    changes: Scores = NONE
    """How high the curves are later, as a multiple of how high they are at first."""
    rises: Scores = NONE
    """The same until all had been seen."""
    wanted: Mapping[str, int] = NONE
    """Label -> seeds that there are to be."""


class Condition(NamedTuple):
    """Something that must be so."""

    text: str
    part: int
    """Of the figure's parts, the one whose numbers are asked; testbeds come after them."""
    decide: Callable[[Numbers], tuple[Answer, str]]
    """The answer, and why."""


def ahead(first: str, second: str, part: int = 0) -> Condition:
    """One label is ahead of another on the seeds that both have: the 95 % interval of the mean difference is above 0.
    It does not hold where the interval is below 0.
    """

    def decide(numbers: Numbers) -> tuple[Answer, str]:
        scores, unit = numbers.scores, f" {numbers.unit}" if numbers.unit else ""
        missing = [name for name in (first, second) if not scores.get(name)]
        if missing:
            return "not run", f"no runs of {' and '.join(missing)}"
        found = paired(scores[first], scores[second])
        if found is None:
            return "undecided", f"{first} and {second} have no seed in common"
        mean, half = found.difference
        if half is None:
            return "undecided", f"by {number(mean)}{unit} on one seed"
        why = f"by {number(mean)} ± {number(half)}{unit} on {len(found.seeds)} seeds"
        return "holds" if mean - half > 0 else "does not hold" if mean + half < 0 else "undecided", why

    return Condition(f"{first} ahead of {second}", part, decide)


def at_most(label: str, most: float, part: int = 0) -> Condition:
    """The curve of every seed of a label ends at or below a value; it does not hold if one ends above."""

    def decide(numbers: Numbers) -> tuple[Answer, str]:
        return _on_every_seed(label, numbers, lambda end: end <= most + 1e-6, "highest", max)

    return Condition(f"{label} at {most:.0%} or less on every seed", part, decide)


def at_least(label: str, least: float, part: int = 0) -> Condition:
    """The curve of every seed of a label comes to a value; it does not hold if one does not."""

    def decide(numbers: Numbers) -> tuple[Answer, str]:
        return _on_every_seed(label, numbers, lambda end: end >= least - 1e-6, "lowest", min)

    return Condition(f"{label} at {least:.0%} on every seed", part, decide)


def _on_every_seed(
    label: str, numbers: Numbers, is_so: Callable[[float], bool], worst: str, of: Callable[[list[float]], float]
) -> tuple[Answer, str]:
    values = list(numbers.ends.get(label, {}).values())
    if not values:
        return "not run", f"no runs of {label}"
    there, missing = sum(map(is_so, values)), numbers.wanted.get(label, 0) - len(values)
    why = f"on {there} of {len(values)} seeds, the {worst} at {of(values):.0%}"
    if there < len(values):
        return "does not hold", why
    return ("undecided", f"{why}; {missing} more are not there") if missing > 0 else ("holds", why)


def falls(label: str, part: int = 0) -> Condition:
    """A label's curves are lower later than at first, on average: the 95 % interval of later over at first is below 1.
    It does not hold where the interval is above.
    """

    def decide(numbers: Numbers) -> tuple[Answer, str]:
        return _beside(label, numbers.changes, lambda low, high: (high < 1.0, low >= 1.0))

    return Condition(f"{label} lower in the second half than in the first", part, decide)


def rises(label: str, part: int = 0) -> Condition:
    """A label's curves are higher later than at first, on average, of the steps until all had been seen: the 95 %
    interval of later over at first is above 1. It does not hold where the interval is below.
    """

    def decide(numbers: Numbers) -> tuple[Answer, str]:
        return _beside(label, numbers.rises, lambda low, high: (low > 1.0, high <= 1.0))

    return Condition(f"{label} higher later than at first, until all had been seen", part, decide)


def ranks(label: str, part: int = 0) -> Condition:
    """A belief's variance ranks its errors, on every kind of transitions in every fit: the rank correlation, here the
    lowest of a fit, is above 0.
    """

    def decide(numbers: Numbers) -> tuple[Answer, str]:
        values = list(numbers.scores.get(label, {}).values())
        if not values:
            return "not run", f"no fits of {label}"
        there = sum(value > 0 for value in values)
        why = f"in {there} of {len(values)} fits; the lowest is {number(min(values))}"
        return "holds" if there == len(values) else "does not hold", why

    return Condition(f"{label}'s variance and errors correlated by rank", part, decide)


def _beside(label: str, scores: Scores, compare: Callable[[float, float], tuple[bool, bool]]) -> tuple[Answer, str]:
    values = np.array([value for value in scores.get(label, {}).values() if np.isfinite(value)])
    if not len(values):
        return "not run", f"no runs of {label}"
    mean, half = interval(values)
    if half is None:
        return "undecided", f"{number(mean)} times as high on one seed"
    good, bad = compare(mean - half, mean + half)
    why = f"{number(mean)} ± {number(half)} times as high on {len(values)} seeds"
    return "holds" if good else "does not hold" if bad else "undecided", why


def judge(conditions: Sequence[Condition], numbers: Sequence[Numbers]) -> tuple[Verdict, tuple[Reason, ...]]:
    """The claim's answer, and what became of each condition.

    It holds if every condition does, and does not hold if one of them does not. Where there is nothing to ask, it was
    not run; where only some of it is there, it is undecided. Without conditions nothing was asked.

    Args:
        conditions: all of the claim's.
        numbers: of each part.
    """
    if not conditions:
        return "not asked", ()
    reasons = tuple(Reason(one.text, *one.decide(numbers[one.part])) for one in conditions)
    answers = {reason.verdict for reason in reasons}
    if "does not hold" in answers:
        return "does not hold", reasons
    if answers == {"not run"}:
        return "not run", reasons
    return "holds" if answers == {"holds"} else "undecided", reasons
