"""The task's own reward: nothing is read off a belief."""

from jaxplore.dynamics import Normalizers, Prediction
from jaxplore.signals.base import Reward
from jaxplore.types import Array


def no_score(prediction: Prediction, delta: Array, normalizers: Normalizers) -> Array:
    """Zero for each transition, `[N]`."""
    return 0.0 * delta[..., 0]


NO_REWARD = Reward(no_score, "no intrinsic reward")
"""Of methods that learn from the environment's reward, or from nothing."""
