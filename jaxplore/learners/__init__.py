"""Learners: pure functions that turn transitions with rewards into a policy."""

from jaxplore.learners.base import Learner
from jaxplore.learners.ddpg import DDPGConfig, make_ddpg
from jaxplore.learners.ddqn import DDQNConfig, make_ddqn
from jaxplore.learners.maxinfo import InformationConfig, make_maxinfo_sac
from jaxplore.learners.ppo import PPO, PPOConfig, make_ppo
from jaxplore.learners.sac import SACConfig, make_sac

__all__ = [
    "PPO",
    "DDPGConfig",
    "DDQNConfig",
    "InformationConfig",
    "Learner",
    "PPOConfig",
    "SACConfig",
    "make_ddpg",
    "make_ddqn",
    "make_maxinfo_sac",
    "make_ppo",
    "make_sac",
]
