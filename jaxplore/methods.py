"""The methods table: a method is a belief, an intrinsic reward, and a way to turn the reward into behaviour.

Everything else is shared. To add a method, add a row; what it needs and nothing here offers is one new factory.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, get_args

from jaxplore import behaviours, beliefs, planning, rewards, validate
from jaxplore.behaviours import Behaviour, ImaginationConfig, ModelFreeConfig
from jaxplore.beliefs import Belief, FitConfig
from jaxplore.ddqn import DDQNConfig, make_ddqn
from jaxplore.dynamics import DynamicsConfig
from jaxplore.generator import GeneratorConfig
from jaxplore.imagination import Reward
from jaxplore.mcts import MCTSConfig
from jaxplore.sac import SACConfig, make_sac
from jaxplore.svgd import SVGDConfig
from jaxplore.validate import Checks

RewardUnits = Literal["normalized", "raw"]
Planner = Literal["sac", "mcts"]
Actions = Literal["any", "continuous", "discrete"]


@dataclass(frozen=True)
class ExplorationConfig:
    """Every setting of a method and of the loop around it. The defaults are the paper's."""

    warm_up_steps: int = 256
    """Uniform random actions before the first round. nnaisense/max: 256."""
    steps_per_round: int = 25
    """Real steps between two rounds. nnaisense/max: 25."""
    data_capacity: int = 10_001
    """Real transitions kept. nnaisense/max: the number of steps, plus one."""
    reward_units: RewardUnits = "normalized"
    """Units of the variance reward: normalised delta, or the observation's own (`raw`)."""
    planner: Planner = "sac"
    """How models and reward become behaviour: `sac`, trained in imagination, or `mcts`, tree search at each real step,
    for one-hot observations and discrete actions. Paper: `mcts` for the chain."""
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    generator: GeneratorConfig = field(default_factory=GeneratorConfig)
    svgd: SVGDConfig = field(default_factory=SVGDConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    imagination: ImaginationConfig = field(default_factory=ImaginationConfig)
    sac: SACConfig = field(default_factory=SACConfig)
    mcts: MCTSConfig = field(default_factory=MCTSConfig)
    model_free: ModelFreeConfig = field(default_factory=ModelFreeConfig)
    ddqn: DDQNConfig = field(default_factory=DDQNConfig)

    def __post_init__(self) -> None:
        checks = Checks(self)
        for name in ("warm_up_steps", "steps_per_round"):
            checks.at_least(name, 1)
        checks.at_least("data_capacity", self.steps_per_round)
        checks.one_of("reward_units", get_args(RewardUnits))
        checks.one_of("planner", get_args(Planner))
        if self.reward_units == "raw" and self.dynamics.target == "one_hot":
            raise ValueError(
                "reward_units='raw' does not fit dynamics.target='one_hot', whose predictions are probabilities. "
                "Allowed: 'normalized'."
            )


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


class Method(NamedTuple):
    """One row of the table. Each entry makes its part from the configuration."""

    summary: str
    """What it is, for `--help` and tables."""
    belief: Callable[[Sizes, ExplorationConfig], Belief]
    reward: Callable[[ExplorationConfig], Reward]
    behaviour: Callable[[Sizes, ExplorationConfig, Belief, Reward], Behaviour]
    needs_reward: bool = False
    """Whether it learns from the environment's own reward."""
    actions: Actions = "any"
    """Which actions it can choose."""

    def fits(self, sizes: Sizes) -> bool:
        """Whether it can run in an environment of these sizes, as far as this row says."""
        kind = "discrete" if sizes.discrete else "continuous"
        return self.actions in ("any", kind) and (sizes.has_reward or not self.needs_reward)


def generator_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """The generator of dynamics networks, trained by amortised SVGD."""
    return beliefs.make_generator_belief(
        sizes.obs, sizes.action, config.dynamics, config.generator, config.svgd, config.fit
    )


def no_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """No model of the environment."""
    return beliefs.make_no_belief()


def variance_reward(config: ExplorationConfig) -> Reward:
    """Equation 1, in the units that the configuration names."""
    raw = config.reward_units == "raw"
    return lambda prediction, delta, normalizers: rewards.variance(prediction, normalizers.delta.std if raw else None)


def no_reward(config: ExplorationConfig) -> Reward:
    """Zero."""
    return lambda prediction, delta, normalizers: 0.0 * delta[..., 0]


def sac_in_imagination(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """SAC, trained in rollouts that the belief's models imagine. Refuses discrete actions."""
    if sizes.discrete:
        raise ValueError(
            f"planner='sac' acts by numbers in [-1, 1]; here an action is one of {sizes.action} choices. "
            "Allowed: planner='mcts' where observations are one-hot, or a method without SAC, such as random."
        )
    sac = make_sac(sizes.obs, sizes.action, config.sac)
    return behaviours.make_imagination(belief, reward, sac, sizes.obs, sizes.action, config.imagination)


def tree_search(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """Tree search in the belief's models at each real step. Refuses all but finitely many states and actions."""
    if not (sizes.discrete and sizes.one_hot_obs):
        raise ValueError(
            "planner='mcts' searches finitely many states and actions; here actions are numbers or observations are "
            "not one-hot. Allowed: planner='sac' where actions are numbers."
        )
    num_models = config.imagination.num_models
    return planning.make_tree_search(belief, reward, sizes.obs, sizes.action, num_models, config.mcts)


PLANNERS: dict[str, Callable[[Sizes, ExplorationConfig, Belief, Reward], Behaviour]] = {
    "sac": sac_in_imagination,
    "mcts": tree_search,
}
"""`ExplorationConfig.planner` -> behaviour."""


def planned(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """The behaviour that the configuration names, for methods that plan in their models."""
    return PLANNERS[config.planner](sizes, config, belief, reward)


def uniform_actions(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """Uniform random actions."""
    return behaviours.make_uniform(sizes.action, sizes.discrete)


def ddqn_on_task_reward(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """Double DQN on real transitions, with the environment's own reward."""
    model_free = dataclasses.replace(
        config.model_free, normalize_obs=config.model_free.normalize_obs and not sizes.one_hot_obs
    )
    return behaviours.make_model_free(
        make_ddqn(sizes.obs, sizes.action, config.ddqn), sizes.obs, sizes.action, model_free
    )


METHODS: dict[str, Method] = {
    "implicit": Method(
        "generator of models trained by amortised SVGD, variance reward, SAC in imagination or tree search",
        generator_belief,
        variance_reward,
        planned,
    ),
    "ddqn": Method(
        "double DQN with epsilon-greedy actions on the environment's own reward, for discrete actions",
        no_belief,
        no_reward,
        ddqn_on_task_reward,
        needs_reward=True,
        actions="discrete",
    ),
    "random": Method("uniform random actions", no_belief, no_reward, uniform_actions),
}
"""Name -> method. Add your own with `METHODS["mine"] = Method(...)`."""


def check_fits(method: Method, sizes: Sizes) -> None:
    """Raise unless `method` can run in an environment of these sizes, as far as its row says.

    Raises:
        ValueError: names what it needs, and the methods that fit.
    """
    if method.fits(sizes):
        return
    name = next((f"method={name!r}" for name, row in METHODS.items() if row is method), "this method")
    fitting = ", ".join(name for name, row in METHODS.items() if row.fits(sizes))
    if method.needs_reward and not sizes.has_reward:
        raise ValueError(
            f"{name} learns from the environment's own reward, and this environment has none. "
            f"Allowed: an environment with a reward (EnvSpec.has_reward), or one of the methods {fitting}."
        )
    wanted = "one of several choices" if method.actions == "discrete" else "numbers in [-1, 1]"
    given = f"one of {sizes.action} choices" if sizes.discrete else f"numbers in [-1, 1], {sizes.action} of them"
    raise ValueError(
        f"{name} takes actions that are {wanted}; here an action is {given}. "
        f"Allowed: an environment with {method.actions} actions, or one of the methods {fitting}."
    )


def get_method(name: str) -> Method:
    """The method called `name`.

    Raises:
        ValueError: no such method; names the nearest and lists all.
    """
    validate.one_of("method", name, METHODS)
    return METHODS[name]
