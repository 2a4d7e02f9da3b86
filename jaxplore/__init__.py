"""jaxplore: exploration in reinforcement learning by implicit posteriors over dynamics models, in JAX.

The pieces work alone: `make_generator` (networks from noise), `make_amortized_svgd` (a posterior over any Flax
network), `rewards`, `rollout` (imagination), `make_sac`, and `make_explorer`, which puts them together.
"""

from jaxplore import rewards
from jaxplore.behaviours import ImaginationConfig, ModelFreeConfig
from jaxplore.beliefs import Belief, FitConfig, make_generator_belief
from jaxplore.ddqn import DDQNConfig, make_ddqn
from jaxplore.dynamics import DynamicsConfig, Prediction
from jaxplore.exploration import Explorer, ExplorerState, make_explorer
from jaxplore.generator import Generator, GeneratorConfig, make_generator
from jaxplore.imagination import rollout
from jaxplore.learner import Learner
from jaxplore.methods import METHODS, ExplorationConfig, Method, Sizes, get_method
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
    "AmortizedSVGD",
    "Belief",
    "DDQNConfig",
    "DynamicsConfig",
    "ExplorationConfig",
    "Explorer",
    "ExplorerState",
    "FitConfig",
    "Generator",
    "GeneratorConfig",
    "ImaginationConfig",
    "Learner",
    "Method",
    "ModelFreeConfig",
    "Prediction",
    "SACConfig",
    "SVGDConfig",
    "Sizes",
    "Transition",
    "get_method",
    "make_amortized_svgd",
    "make_ddqn",
    "make_explorer",
    "make_generator",
    "make_generator_belief",
    "make_sac",
    "rewards",
    "rollout",
    "stein_direction",
]
