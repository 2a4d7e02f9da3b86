"""Behaviours: ways to turn an intrinsic reward into actions."""

from jaxplore.behaviours.base import Behaviour, Experience
from jaxplore.behaviours.gradient import GradientPolicyConfig, make_gradient_policy
from jaxplore.behaviours.imagination import ImaginationConfig, make_imagination
from jaxplore.behaviours.mcts import MCTSConfig, make_mcts
from jaxplore.behaviours.on_policy import make_on_policy
from jaxplore.behaviours.real_data import (
    ModelFreeConfig,
    ReactiveConfig,
    make_informed,
    make_model_free,
    make_reactive,
)
from jaxplore.behaviours.rollout import World, rollout
from jaxplore.behaviours.tree_search import make_tree_search
from jaxplore.behaviours.uniform import make_uniform, uniform_actions

__all__ = [
    "Behaviour",
    "Experience",
    "GradientPolicyConfig",
    "ImaginationConfig",
    "MCTSConfig",
    "ModelFreeConfig",
    "ReactiveConfig",
    "World",
    "make_gradient_policy",
    "make_imagination",
    "make_informed",
    "make_mcts",
    "make_model_free",
    "make_on_policy",
    "make_reactive",
    "make_tree_search",
    "make_uniform",
    "rollout",
    "uniform_actions",
]
