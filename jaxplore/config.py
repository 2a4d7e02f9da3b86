"""Every setting of an exploring agent, and what it must know of an environment."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple, get_args

from jaxplore.behaviours.gradient import GradientPolicyConfig
from jaxplore.behaviours.imagination import ImaginationConfig
from jaxplore.behaviours.mcts import MCTSConfig
from jaxplore.behaviours.real_data import ModelFreeConfig, ReactiveConfig
from jaxplore.beliefs.base import FitConfig
from jaxplore.beliefs.ensemble import EnsembleConfig
from jaxplore.beliefs.generator import GeneratorConfig
from jaxplore.beliefs.svgd import SVGDConfig
from jaxplore.dynamics import DynamicsConfig
from jaxplore.learners.ddpg import DDPGConfig
from jaxplore.learners.ddqn import DDQNConfig
from jaxplore.learners.maxinfo import InformationConfig
from jaxplore.learners.ppo import PPOConfig
from jaxplore.learners.sac import SACConfig
from jaxplore.signals.distillation import RNDConfig
from jaxplore.validate import Checks

RewardUnits = Literal["normalized", "raw"]
ErrorUnits = Literal["obs", "delta"]
Planner = Literal["sac", "mcts"]

TASK_SAC = SACConfig(
    activation="relu",
    init="xavier",
    lr=3e-4,
    batch_size=256,
    alpha=1.0,
    reward_scale=5.0,
    log_std_map="clip",
    policy_penalty=0.0,
    grad_clip=1e6,
)
"""SAC as its authors run it on the half cheetah (haarnoja/sac), which are the paper's settings: ReLU, Xavier's uniform
weights, a standard deviation of 1 at the start, nothing added to the policy's loss, no gradient clipped. But the policy
seeks the smaller of both action values, where haarnoja/sac takes the first."""


@dataclass(frozen=True)
class ExplorationConfig:
    """Every setting of a method and of the loop around it. The defaults are the paper's."""

    warm_up_steps: int = 256
    """Steps before the first round, by uniform actions unless a run says otherwise. 0: the first round comes with its
    first steps. nnaisense/max: 256."""
    steps_per_round: int = 25
    """Real steps between two rounds. nnaisense/max: 25."""
    data_capacity: int = 10_001
    """Real transitions kept; the oldest make room for more. nnaisense/max: the number of steps, plus one."""
    reward_units: RewardUnits = "normalized"
    """Units of the variance reward: normalised delta, or the observation's own (`raw`)."""
    error_units: ErrorUnits = "obs"
    """Units of the prediction error: standard deviations of the observation (`obs`, nnaisense/max), or of its change
    (`delta`)."""
    renyi_decay: float = 0.1
    """How much of what Gaussian networks' variances differ by the Jensen-Renyi divergence sees, (0, 1].
    nnaisense/max: 0.1."""
    planner: Planner = "sac"
    """How models and reward become behaviour: `sac`, trained in imagination (double DQN where actions are discrete), or
    `mcts`, tree search at each real step, for one-hot observations and discrete actions. Paper: `mcts` for the
    chain."""
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    ensemble: EnsembleConfig = field(default_factory=EnsembleConfig)
    generator: GeneratorConfig = field(default_factory=GeneratorConfig)
    svgd: SVGDConfig = field(default_factory=SVGDConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    imagination: ImaginationConfig = field(default_factory=ImaginationConfig)
    reactive: ReactiveConfig = field(default_factory=ReactiveConfig)
    sac: SACConfig = field(default_factory=SACConfig)
    gradient: GradientPolicyConfig = field(default_factory=GradientPolicyConfig)
    rnd: RNDConfig = field(default_factory=RNDConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    mcts: MCTSConfig = field(default_factory=MCTSConfig)
    model_free: ModelFreeConfig = field(default_factory=ModelFreeConfig)
    ddqn: DDQNConfig = field(default_factory=DDQNConfig)
    """Double DQN, on the task's reward or, where actions are discrete, in place of `sac`."""
    ddpg: DDPGConfig = field(default_factory=DDPGConfig)
    task_sac: SACConfig = TASK_SAC
    """SAC on the task's reward. `sac_v2`, `maxinfo` and `maxinfo_implicit` learn `alpha` and leave the reward as it
    is."""
    information: InformationConfig = field(default_factory=InformationConfig)
    """What is sought beside the task's reward."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.at_least("warm_up_steps", 0)
        checks.at_least("steps_per_round", 1)
        checks.at_least("data_capacity", self.steps_per_round)
        checks.one_of("reward_units", get_args(RewardUnits))
        checks.one_of("error_units", get_args(ErrorUnits))
        checks.in_range("renyi_decay", 0.0, 1.0, open_low=True)
        checks.one_of("planner", get_args(Planner))
        if self.reward_units == "raw" and self.dynamics.target == "one_hot":
            problem = "does not fit dynamics.target='one_hot', whose predictions are probabilities"
            raise checks.refusal("reward_units", problem, "'normalized'")


class Sizes(NamedTuple):
    """What a method must know of an environment."""

    obs: int
    """`O`."""
    action: int
    """`A`."""
    discrete: bool = False
    """Whether an action is one of `A` choices, as a one-hot vector; otherwise entries are numbers in [-1, 1]."""
    one_hot_obs: bool = False
    """Whether an observation is one of `O` states, as a one-hot vector."""
    has_reward: bool = False
    """Whether there is a task whose reward can be learned from."""
