"""jaxplore: exploration in reinforcement learning by implicit posteriors over dynamics models, in JAX.

The pieces work alone: `make_generator` (networks from noise), `make_amortized_svgd` (a posterior over any Flax
network), `rewards`, `rollout` (imagination), `make_sac`, and `make_explorer`, which puts them together.
"""

from jaxplore import dynamics, normalizer, replay
from jaxplore.behaviours import (
    Behaviour,
    Experience,
    GradientPolicyConfig,
    ImaginationConfig,
    MCTSConfig,
    ModelFreeConfig,
    ReactiveConfig,
    World,
    make_gradient_policy,
    make_imagination,
    make_mcts,
    make_model_free,
    make_reactive,
    make_rnd_learner,
    make_rnd_ppo,
    make_tree_search,
    make_uniform,
    rollout,
)
from jaxplore.beliefs import (
    AmortizedSVGD,
    Belief,
    EnsembleConfig,
    FitConfig,
    Generator,
    GeneratorConfig,
    Judgement,
    SVGDConfig,
    make_amortized_svgd,
    make_ensemble_belief,
    make_generator,
    make_generator_belief,
    make_no_belief,
    state_shardings,
    stein_direction,
)
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import DynamicsConfig, Normalizers, Prediction
from jaxplore.exploration import Actor, Explorer, ExplorerState, make_explorer
from jaxplore.learners import (
    PPO,
    DDPGConfig,
    DDQNConfig,
    Learner,
    PPOConfig,
    SACConfig,
    make_ddpg,
    make_ddqn,
    make_ppo,
    make_sac,
)
from jaxplore.methods import METHODS, Method, get_method
from jaxplore.policies import load_policy
from jaxplore.replay import Replay
from jaxplore.signals import RND, Reward, RNDConfig, make_rnd, rewards
from jaxplore.types import Transition
from jaxplore.validate import FieldError

__version__ = "0.1.0"

__all__ = [
    "METHODS",
    "PPO",
    "RND",
    "Actor",
    "AmortizedSVGD",
    "Behaviour",
    "Belief",
    "DDPGConfig",
    "DDQNConfig",
    "DynamicsConfig",
    "EnsembleConfig",
    "Experience",
    "ExplorationConfig",
    "Explorer",
    "ExplorerState",
    "FieldError",
    "FitConfig",
    "Generator",
    "GeneratorConfig",
    "GradientPolicyConfig",
    "ImaginationConfig",
    "Judgement",
    "Learner",
    "MCTSConfig",
    "Method",
    "ModelFreeConfig",
    "Normalizers",
    "PPOConfig",
    "Prediction",
    "RNDConfig",
    "ReactiveConfig",
    "Replay",
    "Reward",
    "SACConfig",
    "SVGDConfig",
    "Sizes",
    "Transition",
    "World",
    "dynamics",
    "get_method",
    "load_policy",
    "make_amortized_svgd",
    "make_ddpg",
    "make_ddqn",
    "make_ensemble_belief",
    "make_explorer",
    "make_generator",
    "make_generator_belief",
    "make_gradient_policy",
    "make_imagination",
    "make_mcts",
    "make_model_free",
    "make_no_belief",
    "make_ppo",
    "make_reactive",
    "make_rnd",
    "make_rnd_learner",
    "make_rnd_ppo",
    "make_sac",
    "make_tree_search",
    "make_uniform",
    "normalizer",
    "replay",
    "rewards",
    "rollout",
    "state_shardings",
    "stein_direction",
]
