"""What an intrinsic reward is: a number for each transition, and its unit."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from jaxplore.dynamics import Normalizers, Prediction
from jaxplore.types import Array

Score: TypeAlias = Callable[[Prediction, Array, Normalizers], Array]
"""`score(prediction [M, N, O], delta [N, O], normalizers) -> [N]`, `delta` being the change that happened."""


class Reward(NamedTuple):
    """An intrinsic reward that is read off a belief's predictions."""

    score: Score
    """What each transition is worth. Differentiable in the prediction, for behaviours that climb its gradient."""
    unit: str
    """Of the score, for labels: `"nats"`."""
