"""Beliefs over the dynamics: what a method knows of the environment, and how it learns from data."""

from jaxplore.beliefs.base import Belief, FitConfig, Judgement, fit, make_no_belief, make_optimizer
from jaxplore.beliefs.ensemble import EnsembleConfig, make_ensemble_belief
from jaxplore.beliefs.generator import Generator, GeneratorConfig, make_generator
from jaxplore.beliefs.implicit import make_generator_belief
from jaxplore.beliefs.sharding import state_shardings
from jaxplore.beliefs.svgd import AmortizedSVGD, SVGDConfig, make_amortized_svgd, stein_direction

__all__ = [
    "AmortizedSVGD",
    "Belief",
    "EnsembleConfig",
    "FitConfig",
    "Generator",
    "GeneratorConfig",
    "Judgement",
    "SVGDConfig",
    "fit",
    "make_amortized_svgd",
    "make_ensemble_belief",
    "make_generator",
    "make_generator_belief",
    "make_no_belief",
    "make_optimizer",
    "state_shardings",
    "stein_direction",
]
