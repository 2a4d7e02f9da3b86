"""jaxplore: exploration in reinforcement learning by implicit posteriors over dynamics models, in JAX.

The pieces work alone: `make_generator` (networks from noise), `make_amortized_svgd` (a posterior over any Flax
network), `rewards`, `rollout` (imagination), `make_sac`, and `make_explorer`, which puts them together.
"""

from jaxplore import rewards
from jaxplore.behaviours import ImaginationConfig, ModelFreeConfig
from jaxplore.beliefs import Belief, FitConfig, make_generator_belief
from jaxplore.ddpg import DDPGConfig, make_ddpg
from jaxplore.ddqn import DDQNConfig, make_ddqn
from jaxplore.dynamics import DynamicsConfig, Prediction
from jaxplore.ensemble import EnsembleConfig, make_ensemble_belief
from jaxplore.exploration import Explorer, ExplorerState, make_explorer
from jaxplore.generator import Generator, GeneratorConfig, make_generator
from jaxplore.gradient_policy import GradientPolicyConfig, make_gradient_policy
from jaxplore.imagination import rollout
from jaxplore.learner import Learner
from jaxplore.mcts import MCTSConfig, make_mcts
from jaxplore.methods import METHODS, ExplorationConfig, Method, Sizes, get_method
from jaxplore.planning import make_tree_search
from jaxplore.ppo import PPO, PPOConfig, make_ppo
from jaxplore.rnd import RNDConfig, make_rnd
from jaxplore.sac import SACConfig, make_sac
from jaxplore.svgd import (
    AmortizedSVGD,
    SVGDConfig,
    make_amortized_svgd,
    stein_direction,
)
from jaxplore.types import Transition

__version__ = "0.1.0"

__all__ = [
    "METHODS",
    "PPO",
    "AmortizedSVGD",
    "Belief",
    "DDPGConfig",
    "DDQNConfig",
    "DynamicsConfig",
    "EnsembleConfig",
    "ExplorationConfig",
    "Explorer",
    "ExplorerState",
    "FitConfig",
    "Generator",
    "GeneratorConfig",
    "GradientPolicyConfig",
    "ImaginationConfig",
    "Learner",
    "MCTSConfig",
    "Method",
    "ModelFreeConfig",
    "PPOConfig",
    "Prediction",
    "RNDConfig",
    "SACConfig",
    "SVGDConfig",
    "Sizes",
    "Transition",
    "get_method",
    "make_amortized_svgd",
    "make_ddpg",
    "make_ddqn",
    "make_ensemble_belief",
    "make_explorer",
    "make_generator",
    "make_generator_belief",
    "make_gradient_policy",
    "make_mcts",
    "make_ppo",
    "make_rnd",
    "make_sac",
    "make_tree_search",
    "rewards",
    "rollout",
    "stein_direction",
]
