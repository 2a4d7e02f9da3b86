"""The parts that a method is made of, each from the configuration: signals, of beliefs and rewards, and behaviours.

Each says by `reads` which fields of the configuration it looks at, so that a setting which does nothing is refused and
not ignored.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

from jaxplore.behaviours.base import Behaviour
from jaxplore.behaviours.gradient import make_gradient_policy
from jaxplore.behaviours.imagination import make_imagination
from jaxplore.behaviours.on_policy import make_on_policy
from jaxplore.behaviours.real_data import ModelFreeConfig, make_informed, make_model_free, make_reactive
from jaxplore.behaviours.tree_search import make_tree_search
from jaxplore.behaviours.uniform import make_uniform
from jaxplore.beliefs.base import Belief
from jaxplore.beliefs.ensemble import make_ensemble_belief
from jaxplore.beliefs.implicit import make_generator_belief
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import Normalizers, Prediction
from jaxplore.learners.base import Learner
from jaxplore.learners.ddpg import make_ddpg
from jaxplore.learners.ddqn import make_ddqn
from jaxplore.learners.maxinfo import Gain, make_maxinfo_sac
from jaxplore.learners.sac import make_sac
from jaxplore.signals import rewards
from jaxplore.signals.base import Reward, Signal, make_belief_signal
from jaxplore.signals.distillation import make_distillation
from jaxplore.signals.task import TASK
from jaxplore.types import Array
from jaxplore.validate import FieldError


def reads(*fields: Any, discrete: tuple[str, ...] | None = None) -> Callable[[Any], Any]:
    """Mark a part with the fields of `ExplorationConfig` that it reads.

    Args:
        *fields: their names; or one function that gives them, `(config, discrete) -> names`.
        discrete: their names where actions are discrete, if they are others.

    Returns:
        A decorator; the part then has `reads(config, discrete=False) -> names`.
    """

    def names(config: Any, is_discrete: bool = False) -> set[str]:
        return set(discrete if is_discrete and discrete is not None else fields)

    def mark(part: Any) -> Any:
        part.reads = fields[0] if fields and callable(fields[0]) else names
        return part

    return mark


def fields_read(part: Any, config: Any, *discrete: bool) -> set[str]:
    """The names of the fields that a part reads; of one that does not say so: all."""
    own = getattr(part, "reads", None)
    return set(own(config, *discrete)) if own else {item.name for item in dataclasses.fields(ExplorationConfig)}


def make_learner(sizes: Sizes, config: ExplorationConfig) -> Learner:
    """Who learns from an intrinsic reward: SAC or, where an action is one of several choices, double DQN."""
    if sizes.discrete:
        return make_ddqn(sizes.obs, sizes.action, config.ddqn)
    return make_sac(sizes.obs, sizes.action, config.sac)


@reads("dynamics", "generator", "svgd", "fit")
def generator_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """The generator of dynamics networks, trained by amortised SVGD."""
    return make_generator_belief(sizes.obs, sizes.action, config.dynamics, config.generator, config.svgd, config.fit)


@reads("dynamics", "ensemble", "fit")
def static_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """Networks of their own, deterministic."""
    return _ensemble(sizes, config, gaussian=False)


@reads("dynamics", "ensemble", "fit")
def gaussian_belief(sizes: Sizes, config: ExplorationConfig) -> Belief:
    """Networks of their own that state a variance; where they predict probabilities, deterministic ones."""
    return _ensemble(sizes, config, gaussian=config.dynamics.target == "delta")


def _ensemble(sizes: Sizes, config: ExplorationConfig, *, gaussian: bool) -> Belief:
    return make_ensemble_belief(
        sizes.obs,
        sizes.action,
        gaussian=gaussian,
        dynamics_config=config.dynamics,
        ensemble_config=config.ensemble,
        fit_config=config.fit,
    )


@reads("reward_units", "dynamics")
def variance_reward(config: ExplorationConfig) -> Reward:
    """Equation 1, in the units that the configuration names."""
    if config.reward_units == "raw":
        score = lambda prediction, delta, normalizers: rewards.variance(prediction, normalizers.delta.std)  # noqa: E731
        return Reward(score, "raw units, squared")
    unit = squared_unit(config)
    return Reward(lambda prediction, delta, normalizers: rewards.variance(prediction, None), unit)


def squared_unit(config: ExplorationConfig) -> str:
    """The unit of squared predictions."""
    return "probability, squared" if config.dynamics.target == "one_hot" else "normalised delta, squared"


@reads("renyi_decay", "dynamics")
def divergence_reward(config: ExplorationConfig) -> Reward:
    """Jensen-Renyi divergence of what the models predict; Jensen-Shannon where that is probabilities."""
    if config.dynamics.target == "one_hot":
        return Reward(lambda prediction, delta, normalizers: rewards.jensen_shannon(prediction), "nats")
    decay = config.renyi_decay
    return Reward(lambda prediction, delta, normalizers: rewards.jensen_renyi(prediction, decay), "nats")


@reads("error_units", "dynamics")
def error_reward(config: ExplorationConfig) -> Reward:
    """Squared error of the models' mean, in the units that the configuration names."""
    in_obs_units = config.error_units == "obs" and config.dynamics.target == "delta"

    def score(prediction: Prediction, delta: Array, normalizers: Normalizers) -> Array:
        scale = normalizers.delta.std / normalizers.obs.std if in_obs_units else None
        return rewards.prediction_error(prediction, delta, scale)

    return Reward(score, "std of the observation, squared" if in_obs_units else squared_unit(config))


@reads()
def spread_reward(config: ExplorationConfig) -> Reward:
    """How far apart the actors' changes are."""
    return Reward(lambda prediction, delta, normalizers: rewards.trajectory_spread(delta), "normalised delta")


@reads("information", "dynamics")
def information_reward(config: ExplorationConfig) -> Reward:
    """How much more than noise the models disagree."""
    if config.dynamics.target == "one_hot":
        problem = "is probabilities, which have no noise to compare a spread with"
        raise FieldError("target", "one_hot", "'delta'", problem, "DynamicsConfig")
    std = config.information.noise_std
    return Reward(lambda prediction, delta, normalizers: rewards.information_gain(prediction, std), "nats")


MakeBelief: TypeAlias = Callable[[Sizes, ExplorationConfig], Belief]
MakeReward: TypeAlias = Callable[[ExplorationConfig], Reward]
MakeSignal: TypeAlias = Callable[[Sizes, ExplorationConfig], Signal]


def read_off(belief: MakeBelief, reward: MakeReward) -> MakeSignal:
    """A signal: the intrinsic reward read off what the belief's models predict."""

    @reads(lambda config, discrete=False: _read_by_belief(belief, config) | fields_read(reward, config))
    def signal(sizes: Sizes, config: ExplorationConfig) -> Signal:
        return make_belief_signal(belief(sizes, config), reward(config))

    return signal


def _read_by_belief(belief: MakeBelief, config: Any) -> set[str]:
    # Of every belief the divergence is logged, too.
    return fields_read(belief, config) | {"renyi_decay"}


@reads("rnd")
def distillation(sizes: Sizes, config: ExplorationConfig) -> Signal:
    """A signal: random network distillation, on real transitions."""
    return _distillation(sizes, config)


def distillation_beside(belief: MakeBelief) -> MakeSignal:
    """A signal: random network distillation, on transitions that the belief's models imagine, too."""

    @reads(lambda config, discrete=False: _read_by_belief(belief, config) | {"rnd"})
    def signal(sizes: Sizes, config: ExplorationConfig) -> Signal:
        return _distillation(sizes, config, belief(sizes, config))

    return signal


def _distillation(sizes: Sizes, config: ExplorationConfig, belief: Belief | None = None) -> Signal:
    # What came last follows from where the replay writes, which must not wrap around within a round.
    if config.data_capacity <= config.steps_per_round:
        allowed = f"at least steps_per_round + 1 = {config.steps_per_round + 1}"
        problem = "holds no more than a round"
        raise FieldError("data_capacity", config.data_capacity, allowed, problem, "ExplorationConfig")
    return make_distillation(sizes.obs, config.steps_per_round, config.rnd, belief)


@reads()
def task_reward(sizes: Sizes, config: ExplorationConfig) -> Signal:
    """The environment's own reward, as real transitions have it; for a behaviour that seeks nothing, no signal."""
    return TASK


@reads("imagination", "sac", discrete=("imagination", "ddqn"))
def sac_in_imagination(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """SAC, or double DQN where actions are discrete, trained in rollouts that the belief's models imagine."""
    learner = make_learner(sizes, config)
    return make_imagination(signal, learner, sizes.obs, sizes.action, config.imagination, sizes.discrete)


@reads("reactive", "sac", discrete=("reactive", "ddqn"))
def sac_on_real_data(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """SAC, or double DQN where actions are discrete, on real transitions, relabelled in each round; nothing is
    imagined. One-hot observations stay as they are.
    """
    learner, seen = make_learner(sizes, config), not sizes.one_hot_obs
    return make_reactive(signal, learner, sizes.obs, sizes.action, config.reactive, normalize_obs=seen)


STD_DRAWS = 1024
"""Real transitions over which a lasting policy's rewards have their standard deviation taken."""


@reads("reactive", "sac", discrete=("reactive", "ddqn"))
def lasting_sac_on_real_data(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """The same with a policy that is never replaced, whatever `reactive.restart_every` is."""
    learner = make_learner(sizes, config)
    options = {"lasting": True, "std_draws": STD_DRAWS, "normalize_obs": not sizes.one_hot_obs}
    return make_reactive(signal, learner, sizes.obs, sizes.action, config.reactive, **options)


@reads("mcts")
def tree_search(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """Tree search in the belief's models at each real step. Refuses all but finitely many states and actions."""
    if not (sizes.discrete and sizes.one_hot_obs):
        raise FieldError(
            "planner",
            "mcts",
            "planner='sac'",
            "searches finitely many states and actions; here actions are numbers or observations are not one-hot",
            "ExplorationConfig",
        )
    return make_tree_search(signal, sizes.obs, sizes.action, config.mcts)


PLANNERS: dict[str, Any] = {
    "sac": sac_in_imagination,
    "mcts": tree_search,
}
"""`ExplorationConfig.planner` -> behaviour."""


@reads(lambda config, discrete=False: {"planner"} | PLANNERS[config.planner].reads(config, discrete))
def planned(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """The behaviour that the configuration names, for methods that plan in their models. Finitely many states and
    actions are searched, not learned.
    """
    if config.planner == "sac" and sizes.discrete and sizes.one_hot_obs:
        given = f"an observation is one of {sizes.obs} states and an action one of {sizes.action} choices"
        problem = f"is for observations or actions that are numbers; here {given}"
        raise FieldError("planner", "sac", "planner='mcts'", problem, "ExplorationConfig")
    return PLANNERS[config.planner](sizes, config, signal)


@reads("gradient")
def reward_gradient(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """A policy by gradient ascent on the reward, through the belief's models."""
    return make_gradient_policy(signal, sizes.obs, sizes.action, config.gradient)


@reads("ppo")
def ppo_on_own_steps(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """PPO on the real steps of its own policy, and the signal with it."""
    per_round, warm_up = config.steps_per_round, config.warm_up_steps
    return make_on_policy(signal, sizes.obs, sizes.action, per_round, warm_up, config.ppo)


@reads()
def uniform_actions(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """Uniform random actions."""
    return make_uniform(sizes.action, sizes.discrete)


def _model_free_config(sizes: Sizes, config: ExplorationConfig) -> ModelFreeConfig:
    """One-hot observations stay as they are."""
    normalize_obs = config.model_free.normalize_obs and not sizes.one_hot_obs
    return dataclasses.replace(config.model_free, normalize_obs=normalize_obs)


def _model_free(learner: Learner, sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """A learner that lasts, on real transitions."""
    return make_model_free(learner, sizes.obs, sizes.action, _model_free_config(sizes, config), signal)


@reads("model_free", "ddqn")
def model_free_ddqn(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """Double DQN that lasts, on real transitions."""
    return _model_free(make_ddqn(sizes.obs, sizes.action, config.ddqn), sizes, config, signal)


@reads("model_free", "ddpg")
def model_free_ddpg(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """DDPG with adaptive parameter noise that lasts, on real transitions."""
    return _model_free(make_ddpg(sizes.obs, sizes.action, config.ddpg), sizes, config, signal)


@reads("model_free", "task_sac")
def model_free_sac(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """SAC that lasts, with the settings for a task's reward, on real transitions."""
    return _model_free(make_sac(sizes.obs, sizes.action, config.task_sac), sizes, config, signal)


@reads("model_free", "task_sac", "information")
def informed_sac(sizes: Sizes, config: ExplorationConfig, signal: Signal) -> Behaviour:
    """The same, whose policy also seeks what the signal says of its actions."""

    def make(gain: Gain) -> Learner:
        return make_maxinfo_sac(sizes.obs, sizes.action, gain, config.task_sac, config.information)

    return make_informed(signal, make, sizes.obs, sizes.action, _model_free_config(sizes, config))
