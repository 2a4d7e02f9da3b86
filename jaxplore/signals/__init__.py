"""Signals: how interesting a transition is."""

from jaxplore.signals import rewards
from jaxplore.signals.base import Reward, Score, Seen, Signal, make_belief_signal
from jaxplore.signals.distillation import RND, RNDConfig, make_distillation, make_rnd
from jaxplore.signals.task import TASK

__all__ = [
    "RND",
    "TASK",
    "RNDConfig",
    "Reward",
    "Score",
    "Seen",
    "Signal",
    "make_belief_signal",
    "make_distillation",
    "make_rnd",
    "rewards",
]
