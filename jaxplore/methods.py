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
from jaxplore.ddpg import DDPGConfig, make_ddpg
from jaxplore.ddqn import DDQNConfig, make_ddqn
from jaxplore.dynamics import DynamicsConfig, Normalizers, Prediction
from jaxplore.ensemble import EnsembleConfig, make_ensemble_belief
from jaxplore.generator import GeneratorConfig
from jaxplore.gradient_policy import GradientPolicyConfig, make_gradient_policy
from jaxplore.imagination import Reward
from jaxplore.learner import Learner
from jaxplore.mcts import MCTSConfig
from jaxplore.ppo import PPOConfig
from jaxplore.rnd import RNDConfig, make_rnd_learner, make_rnd_ppo
from jaxplore.sac import SACConfig, make_sac
from jaxplore.svgd import SVGDConfig
from jaxplore.types import Array
from jaxplore.validate import Checks

RewardUnits = Literal["normalized", "raw"]
ErrorUnits = Literal["obs", "delta"]
Planner = Literal["sac", "mcts"]
Actions = Literal["any", "continuous", "discrete"]


TASK_SAC = SACConfig(
    activation="relu",
    init="xavier",
    lr=3e-4,
    batch_size=256,
    alpha=1.0,
    reward_scale=5.0,
    policy_penalty=0.0,
    grad_clip=1e6,
)
"""SAC as its authors run it on the half cheetah (haarnoja/sac), which are the paper's settings; but the policy seeks
the smaller of both action values, where haarnoja/sac takes the first."""


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
    error_units: ErrorUnits = "obs"
    """Units of the prediction error: standard deviations of the observation (`obs`, nnaisense/max), or of its change
    (`delta`)."""
    renyi_decay: float = 0.1
    """How much of what Gaussian networks' variances differ by the Jensen-Renyi divergence sees, (0, 1].
    nnaisense/max: 0.1."""
    reactive_updates: int = 0
    """Updates of a policy in each round on re-labelled real data, for methods that imagine nothing. 0: as many as the
    `imagination` settings come to for those that do."""
    planner: Planner = "sac"
    """How models and reward become behaviour: `sac`, trained in imagination, or `mcts`, tree search at each real step,
    for one-hot observations and discrete actions. Paper: `mcts` for the chain."""
    dynamics: DynamicsConfig = field(default_factory=DynamicsConfig)
    ensemble: EnsembleConfig = field(default_factory=EnsembleConfig)
    generator: GeneratorConfig = field(default_factory=GeneratorConfig)
    svgd: SVGDConfig = field(default_factory=SVGDConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    imagination: ImaginationConfig = field(default_factory=ImaginationConfig)
    sac: SACConfig = field(default_factory=SACConfig)
    gradient: GradientPolicyConfig = field(default_factory=GradientPolicyConfig)
    rnd: RNDConfig = field(default_factory=RNDConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    mcts: MCTSConfig = field(default_factory=MCTSConfig)
    model_free: ModelFreeConfig = field(default_factory=ModelFreeConfig)
    ddqn: DDQNConfig = field(default_factory=DDQNConfig)
    ddpg: DDPGConfig = field(default_factory=DDPGConfig)
    task_sac: SACConfig = TASK_SAC
    """SAC on the task's reward. `sac_v2` learns `alpha` and leaves the reward as it is."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        for name in ("warm_up_steps", "steps_per_round"):
            checks.at_least(name, 1)
        checks.at_least("data_capacity", self.steps_per_round)
        checks.one_of("reward_units", get_args(RewardUnits))
        checks.one_of("error_units", get_args(ErrorUnits))
        checks.in_range("renyi_decay", 0.0, 1.0, open_low=True)
        checks.at_least("reactive_updates", 0)
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
    settings: Callable[[ExplorationConfig], ExplorationConfig] = lambda config: config
    """Where it departs from the settings that all share, as its authors have it; what a user sets comes on top."""

    def fits(self, sizes: Sizes) -> bool:
        """Whether it can run in an environment of these sizes, as far as this row says."""
        kind = "discrete" if sizes.discrete else "continuous"
        return self.actions in ("any", kind) and (sizes.has_reward or not self.needs_reward)


def generator_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """The generator of dynamics networks, trained by amortised SVGD."""
    return beliefs.make_generator_belief(
        sizes.obs, sizes.action, config.dynamics, config.generator, config.svgd, config.fit
    )


def static_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """Networks of their own, deterministic."""
    return _ensemble(sizes, config, gaussian=False)


def gaussian_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """Networks of their own that state a variance; where they predict probabilities, deterministic ones."""
    return _ensemble(sizes, config, gaussian=config.dynamics.target == "delta")


def _ensemble(sizes: Sizes, config: ExplorationConfig, *, gaussian: bool) -> Belief:
    return make_ensemble_belief(
        sizes.obs,
        sizes.action,
        config.imagination.num_models,
        gaussian=gaussian,
        dynamics_config=config.dynamics,
        ensemble_config=config.ensemble,
        fit_config=config.fit,
    )


def no_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """No model of the environment."""
    return beliefs.make_no_belief()


def variance_reward(config: ExplorationConfig) -> Reward:
    """Equation 1, in the units that the configuration names."""
    raw = config.reward_units == "raw"
    return lambda prediction, delta, normalizers: rewards.variance(prediction, normalizers.delta.std if raw else None)


def divergence_reward(config: ExplorationConfig) -> Reward:
    """Jensen-Renyi divergence of what the models predict; Jensen-Shannon where that is probabilities."""
    if config.dynamics.target == "one_hot":
        return lambda prediction, delta, normalizers: rewards.jensen_shannon(prediction)
    return lambda prediction, delta, normalizers: rewards.jensen_renyi(prediction, config.renyi_decay)


def error_reward(config: ExplorationConfig) -> Reward:
    """Squared error of the models' mean, in the units that the configuration names."""

    def reward(prediction: Prediction, delta: Array, normalizers: Normalizers) -> Array:
        in_obs_units = config.error_units == "obs" and config.dynamics.target == "delta"
        scale = normalizers.delta.std / normalizers.obs.std if in_obs_units else None
        return rewards.prediction_error(prediction, delta, scale)

    return reward


def spread_reward(config: ExplorationConfig) -> Reward:
    """How far apart the actors' changes are."""
    return lambda prediction, delta, normalizers: rewards.trajectory_spread(delta)


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


def sac_on_real_data(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """SAC on real transitions, labelled anew in each round; nothing is imagined."""
    sac = make_sac(sizes.obs, sizes.action, config.sac)
    return behaviours.make_reactive(
        belief, reward, sac, sizes.obs, sizes.action, config.imagination, config.reactive_updates
    )


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


def reward_gradient(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """A policy by gradient ascent on the reward, through the belief's models."""
    return make_gradient_policy(belief, reward, sizes.obs, sizes.action, config.gradient)


def distillation_with_ppo(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """Random network distillation as published: PPO on the real steps of its own policy."""
    _check_replay_keeps_a_round(config)
    return make_rnd_ppo(sizes.obs, sizes.action, config.steps_per_round, config.warm_up_steps, config.ppo, config.rnd)


def distillation_with_sac(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """Random network distillation with SAC on all real transitions, as many updates as other methods have."""
    _check_replay_keeps_a_round(config)
    sac, imagination = make_sac(sizes.obs, sizes.action, config.sac), config.imagination
    num_updates = config.reactive_updates or imagination.num_updates
    return make_rnd_learner(sac, sizes.obs, config.steps_per_round, imagination, num_updates, config.rnd)


def _check_replay_keeps_a_round(config: ExplorationConfig) -> None:
    """What came last is told by where the replay writes, which must not come round within a round."""
    if config.data_capacity <= config.steps_per_round:
        raise ValueError(
            f"data_capacity={config.data_capacity} holds no more than a round. "
            f"Allowed: at least steps_per_round + 1 = {config.steps_per_round + 1}."
        )


def uniform_actions(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """Uniform random actions."""
    return behaviours.make_uniform(sizes.action, sizes.discrete)


def on_task_reward(learner: Learner, sizes: Sizes, config: ExplorationConfig) -> Behaviour:
    """A learner on real transitions, with the environment's own reward. One-hot observations stay as they are."""
    model_free = dataclasses.replace(
        config.model_free, normalize_obs=config.model_free.normalize_obs and not sizes.one_hot_obs
    )
    return behaviours.make_model_free(learner, sizes.obs, sizes.action, model_free)


def ddqn_on_task_reward(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """Double DQN on the environment's own reward."""
    return on_task_reward(make_ddqn(sizes.obs, sizes.action, config.ddqn), sizes, config)


def ddpg_on_task_reward(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """DDPG with adaptive parameter noise on the environment's own reward."""
    return on_task_reward(make_ddpg(sizes.obs, sizes.action, config.ddpg), sizes, config)


def sac_on_task_reward(sizes: Sizes, config: ExplorationConfig, belief: Belief, reward: Reward) -> Behaviour:
    """SAC on the environment's own reward."""
    return on_task_reward(make_sac(sizes.obs, sizes.action, config.task_sac), sizes, config)


def as_sac_v2(config: ExplorationConfig) -> ExplorationConfig:
    """SAC's second form: a learned entropy weight, and the reward as it is."""
    return dataclasses.replace(
        config, task_sac=dataclasses.replace(config.task_sac, learn_alpha=True, reward_scale=1.0)
    )


def as_baselines_default(config: ExplorationConfig) -> ExplorationConfig:
    """DDPG's networks as openai/baselines has them where nothing is set, so perhaps as the paper ran them."""
    return dataclasses.replace(config, ddpg=dataclasses.replace(config.ddpg, layer_norm=False, activation="tanh"))


def as_max(config: ExplorationConfig) -> ExplorationConfig:
    """nnaisense/max's networks: swish, where they are Gaussian."""
    if config.dynamics.target == "one_hot":
        return config
    return dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, activation="swish"))


def as_max_reactive(config: ExplorationConfig) -> ExplorationConfig:
    """nnaisense/max's command JDRX: 100 updates on real data in each round."""
    return dataclasses.replace(as_max(config), reactive_updates=100)


def as_max_trajectory(config: ExplorationConfig) -> ExplorationConfig:
    """nnaisense/max's command TVAX: alpha 0.2."""
    config = as_max(config)
    return dataclasses.replace(config, sac=dataclasses.replace(config.sac, alpha=0.2))


def as_max_prediction_error(config: ExplorationConfig) -> ExplorationConfig:
    """nnaisense/max's command PERX: 100 updates on real data in each round, alpha 0.2."""
    config = as_max_reactive(config)
    return dataclasses.replace(config, sac=dataclasses.replace(config.sac, alpha=0.2))


METHODS: dict[str, Method] = {
    "implicit": Method(
        "generator of models trained by amortised SVGD, variance reward, SAC in imagination or tree search",
        generator_belief,
        variance_reward,
        planned,
    ),
    "implicit_grad": Method(
        "generator of models, variance reward, policy by the reward's own gradient through the models",
        generator_belief,
        variance_reward,
        reward_gradient,
        actions="continuous",
    ),
    "disagreement": Method(
        "static networks, variance reward, SAC in imagination or tree search",
        static_belief,
        variance_reward,
        planned,
    ),
    "max": Method(
        "static Gaussian networks, Jensen-Renyi divergence (of probabilities Jensen-Shannon), SAC in imagination or "
        "tree search",
        gaussian_belief,
        divergence_reward,
        planned,
        settings=as_max,
    ),
    "max_reactive": Method(
        "static Gaussian networks, Jensen-Renyi divergence, SAC on real transitions (JDRX of nnaisense/max)",
        gaussian_belief,
        divergence_reward,
        sac_on_real_data,
        actions="continuous",
        settings=as_max_reactive,
    ),
    "max_trajectory": Method(
        "static Gaussian networks, spread of the imagined changes, SAC in imagination (TVAX of nnaisense/max)",
        gaussian_belief,
        spread_reward,
        sac_in_imagination,
        actions="continuous",
        settings=as_max_trajectory,
    ),
    "prediction_error": Method(
        "static Gaussian networks, error of their mean, SAC on real transitions (PERX of nnaisense/max)",
        gaussian_belief,
        error_reward,
        sac_on_real_data,
        actions="continuous",
        settings=as_max_prediction_error,
    ),
    "icm": Method(
        "static networks, error of their mean, SAC on real transitions with as many updates as in imagination",
        static_belief,
        error_reward,
        sac_on_real_data,
        actions="continuous",
    ),
    "icm_active": Method(
        "static networks, error of their mean, SAC in imagination, where a model stands for the truth",
        static_belief,
        error_reward,
        sac_in_imagination,
        actions="continuous",
    ),
    "disagreement_grad": Method(
        "static networks, variance reward, policy by the reward's own gradient through the models",
        static_belief,
        variance_reward,
        reward_gradient,
        actions="continuous",
    ),
    "rnd": Method(
        "random network distillation with PPO, as published",
        no_belief,
        no_reward,
        distillation_with_ppo,
        actions="continuous",
    ),
    "rnd_sac": Method(
        "random network distillation with SAC on real transitions, as an ablation",
        no_belief,
        no_reward,
        distillation_with_sac,
        actions="continuous",
    ),
    "ddqn": Method(
        "double DQN with epsilon-greedy actions on the environment's own reward, for discrete actions",
        no_belief,
        no_reward,
        ddqn_on_task_reward,
        needs_reward=True,
        actions="discrete",
    ),
    "psne": Method(
        "DDPG with adaptive noise in the policy's parameters, on the environment's own reward",
        no_belief,
        no_reward,
        ddpg_on_task_reward,
        needs_reward=True,
        actions="continuous",
    ),
    "psne_no_norm": Method(
        "psne without layer normalisation, as an ablation",
        no_belief,
        no_reward,
        ddpg_on_task_reward,
        needs_reward=True,
        actions="continuous",
        settings=as_baselines_default,
    ),
    "sac": Method(
        "SAC with a fixed entropy weight on the environment's own reward",
        no_belief,
        no_reward,
        sac_on_task_reward,
        needs_reward=True,
        actions="continuous",
    ),
    "sac_v2": Method(
        "SAC with a learned entropy weight on the environment's own reward",
        no_belief,
        no_reward,
        sac_on_task_reward,
        needs_reward=True,
        actions="continuous",
        settings=as_sac_v2,
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


def reward_unit(method: Method, config: ExplorationConfig) -> str:
    """The unit of a method's intrinsic reward, for labels."""
    probabilities = config.dynamics.target == "one_hot"
    squared = "probability, squared" if probabilities else "normalised delta, squared"
    units: dict[object, str] = {
        variance_reward: "raw units, squared" if config.reward_units == "raw" else squared,
        divergence_reward: "nats",
        error_reward: squared if probabilities or config.error_units == "delta" else "std of the observation, squared",
        spread_reward: "normalised delta",
    }
    return units.get(method.reward, "its own units")


def get_method(name: str) -> Method:
    """The method called `name`.

    Raises:
        ValueError: no such method; names the nearest and lists all.
    """
    validate.one_of("method", name, METHODS)
    return METHODS[name]
