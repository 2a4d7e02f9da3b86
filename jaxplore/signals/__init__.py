"""Signals: how interesting a transition is."""

from jaxplore.signals import rewards
from jaxplore.signals.base import Reward, Score
from jaxplore.signals.distillation import RND, RNDConfig, make_rnd
from jaxplore.signals.task import NO_REWARD

__all__ = ["NO_REWARD", "RND", "RNDConfig", "Reward", "Score", "make_rnd", "rewards"]
