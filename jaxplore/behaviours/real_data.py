"""Behaviour on real transitions alone, with the reward that a signal gives them now, or with the task's own."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import normalizer, replay, validate
from jaxplore.behaviours.base import (
    Behaviour,
    Experience,
    check_imaginable,
    label,
    lesson_of,
    make_act,
    no_learner_metrics,
    renewed,
    reward_moments,
    train,
)
from jaxplore.learners.base import Learner
from jaxplore.learners.maxinfo import Gain
from jaxplore.signals.base import Signal
from jaxplore.signals.task import TASK
from jaxplore.types import Array, Key, Metrics
from jaxplore.validate import Checks


@dataclass(frozen=True)
class ReactiveConfig:
    """How a policy is trained in each round by methods that seek an intrinsic reward and imagine nothing."""

    updates: int = 2_450
    """Updates in each round, on batches of all real data. The default is what nnaisense/max's policy gets in
    imagination and on real data together; its own reactive commands make 100."""
    restart_every: int = 1
    """Rounds that a policy lives for. 1: a new one each round (nnaisense/max). 0: never a new one."""
    normalize_reward: bool = False
    """Whether rewards are divided by their standard deviation over the data. Paper: no."""
    center_reward: bool = False
    """Whether their mean over the same data is taken off. A policy of unending episodes is the same for any constant,
    but values first have to climb to it: with a discount of 0.99 to a hundred times the mean. Paper: no."""
    act_greedily: bool = True
    """Whether the real environment gets the policy's squashed mean (nnaisense/max) or a sample."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.at_least("updates", 1)
        checks.at_least("restart_every", 0)


@struct.dataclass
class ReactiveState:
    """What a policy trained on real transitions carries, where it lives for some rounds."""

    learner: Any
    age: Array
    """Rounds that the policy has lived through, int32."""


class Reactive(NamedTuple):
    """The fixed parts of the behaviour."""

    signal: Signal
    learner: Learner
    sizes: tuple[int, int]
    """`O` and `A`."""
    config: ReactiveConfig
    normalize_obs: bool
    std_draws: int


def make_reactive(
    signal: Signal,
    learner: Learner,
    obs_size: int,
    action_size: int,
    config: ReactiveConfig | None = None,
    *,
    lasting: bool = False,
    normalize_obs: bool = True,
    std_draws: int = 0,
) -> Behaviour:
    """Train a learner on real transitions alone, with the reward that the round's signal gives them.

    The reactive mode of nnaisense/max: novelty is looked for where the agent has been, nothing is imagined. As models
    have just been fitted to the same transitions, an error is small where the fit is good, not only where nothing is
    new.

    Args:
        signal: how interesting a transition is.
        learner: such as `make_sac` gives.
        obs_size: `O`.
        action_size: `A`.
        config: how much of everything.
        lasting: whether the policy lives as long as the run, each round going on where the last one stopped, whatever
            `config.restart_every` is.
        normalize_obs: whether the learner sees observations less their mean and over their standard deviation.
        std_draws: transitions, drawn anew in each round, over which `config.normalize_reward` takes the standard
            deviation. 0: all.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update.

    Raises:
        FieldError: a size is below 1.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, learners, rewards, signals
        >>> belief = beliefs.make_ensemble_belief(2, 1, 5, dynamics_config=dynamics.DynamicsConfig(hidden=(8,)))
        >>> error = signals.Reward(
        ...     lambda prediction, delta, normalizers: rewards.prediction_error(prediction, delta), "squared")
        >>> sac = learners.make_sac(2, 1, learners.SACConfig(hidden=(8,)))
        >>> behaviour = make_reactive(signals.make_belief_signal(belief, error), sac, 2, 1)
        >>> actor = behaviour.actor(jax.jit(behaviour.init)(jax.random.key(0)))
        >>> behaviour.act(jax.random.key(1), actor, dynamics.init_normalizers(2, 1), jnp.zeros((5, 2))).shape
        (5, 1)
    """
    validate.sizes(obs_size=obs_size, action_size=action_size)
    config = config or ReactiveConfig()
    parts = Reactive(signal, learner, (obs_size, action_size), config, normalize_obs, std_draws)
    act, act_greedily = (make_act(learner, greedily, normalize_obs) for greedily in (config.act_greedily, True))
    if lasting:
        improve = functools.partial(train_on_real_data, parts)
        return Behaviour(learner.init, improve, learner.actor, act, act_greedily, adopt=learner.adopt)
    return Behaviour(
        init=functools.partial(init_reactive, parts),
        improve=functools.partial(improve_reactive, parts),
        actor=lambda state: learner.actor(state.learner),
        act=act,
        act_greedily=act_greedily,
    )


def init_reactive(parts: Reactive, key: Key) -> ReactiveState:
    """A new policy."""
    return ReactiveState(parts.learner.init(key), jnp.zeros((), jnp.int32))


def improve_reactive(
    parts: Reactive, key: Key, state: ReactiveState, experience: Experience
) -> tuple[ReactiveState, Metrics]:
    """One round of a policy that lives for some of them."""
    init_key, train_key = jax.random.split(key)
    state = renewed(init_key, state, functools.partial(init_reactive, parts), parts.config.restart_every)
    learner_state, metrics = train_on_real_data(parts, train_key, state.learner, experience)
    return ReactiveState(learner_state, state.age + 1), metrics


def train_on_real_data(parts: Reactive, key: Key, state: Any, experience: Experience) -> tuple[Any, Metrics]:
    """One round: all real data get their reward, and the learner its updates on them."""
    learner, config = parts.learner, parts.config
    real = label(parts.signal, experience)
    measured = real
    if config.normalize_reward and parts.std_draws:
        std_key, key = jax.random.split(key)
        drawn = replay.sample(std_key, real, parts.std_draws)
        measured = replace(real, rows=drawn, size=jnp.full((), parts.std_draws))
    std = parts.signal.std(experience.own)
    moments = reward_moments(measured, config.normalize_reward, config.center_reward, std)
    normalizers = experience.normalizers if parts.normalize_obs else None
    lesson = lesson_of([(real, learner.batch_size)], normalizers, moments)
    nothing = no_learner_metrics(learner, state, *parts.sizes)
    return train(learner, key, state, lesson, config.updates, nothing)


@dataclass(frozen=True)
class ModelFreeConfig:
    """How a learner that lives as long as the run is trained on real transitions alone."""

    updates_per_round: int = 25
    """Updates after each round. 25: one for each step of a round of 25."""
    normalize_obs: bool = True
    """Whether the learner sees observations less their mean and over their standard deviation. One-hot observations
    always stay as they are."""
    act_greedily: bool = False
    """Whether the real environment gets the policy's best action or one that is drawn to explore."""

    def __post_init__(self) -> None:
        Checks(self).at_least("updates_per_round", 1)


def make_model_free(
    learner: Learner,
    obs_size: int,
    action_size: int,
    config: ModelFreeConfig | None = None,
    signal: Signal = TASK,
) -> Behaviour:
    """Train a learner that lives as long as the run on real transitions: `make_reactive` of a policy that lasts.

    Args:
        learner: such as `make_ddqn` or `make_sac` gives.
        obs_size: `O`.
        action_size: `A`.
        config: how much of everything. `normalize_obs` is done as it says, whatever the observations are.
        signal: how interesting a transition is. By default what the environment's own reward says.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update.

    Raises:
        FieldError: a size below 1.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import dynamics, learners
        >>> ddqn = learners.make_ddqn(4, 2, learners.DDQNConfig(hidden=(8,)))
        >>> behaviour = make_model_free(ddqn, 4, 2, ModelFreeConfig(normalize_obs=False))
        >>> actor = behaviour.actor(jax.jit(behaviour.init)(jax.random.key(0)))
        >>> behaviour.act_greedily(jax.random.key(1), actor, dynamics.init_normalizers(4, 2), jnp.eye(4)).shape
        (4, 2)
    """
    config = config or ModelFreeConfig()
    reactive = ReactiveConfig(config.updates_per_round, act_greedily=config.act_greedily)
    options = {"lasting": True, "normalize_obs": config.normalize_obs}
    return make_reactive(signal, learner, obs_size, action_size, reactive, **options)


def make_informed(
    signal: Signal,
    make_learner: Callable[[Gain], Learner],
    obs_size: int,
    action_size: int,
    config: ModelFreeConfig | None = None,
) -> Behaviour:
    """Train a learner that lives as long as the run on the environment's own reward, and on what a signal says of the
    actions that its policy would take now.

    The signal is not added to the rewards of what happened: it is asked anew, by the round's models, at each update.

    Args:
        signal: how interesting a transition is, differentiable in the action, by what its belief's models predict or
            where that leads.
        make_learner: a learner with such a gain, such as `make_maxinfo_sac`. It carries the same whatever the gain.
        obs_size: `O`.
        action_size: `A`.
        config: how much of everything. `normalize_obs` is done as it says, whatever the observations are.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update.

    Raises:
        ValueError: a size below 1; the signal cannot be imagined.

    Example:
        >>> import functools, jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, learners, rewards, signals
        >>> belief = beliefs.make_ensemble_belief(2, 1, 5, dynamics_config=dynamics.DynamicsConfig(hidden=(8,)))
        >>> told = signals.Reward(lambda prediction, delta, normalizers: rewards.information_gain(prediction), "nats")
        >>> make = functools.partial(learners.make_maxinfo_sac, 2, 1, config=learners.SACConfig(hidden=(8,)))
        >>> behaviour = make_informed(signals.make_belief_signal(belief, told), make, 2, 1)
        >>> actor = behaviour.actor(jax.jit(behaviour.init)(jax.random.key(0)))
        >>> behaviour.act(jax.random.key(1), actor, dynamics.init_normalizers(2, 1), jnp.zeros((5, 2))).shape
        (5, 1)
    """
    check_imaginable(signal)
    config = config or ModelFreeConfig()

    def improve(key: Key, state: Any, experience: Experience) -> tuple[Any, Metrics]:
        def gain(seen: Array, action: Array) -> Array:
            normalizers = experience.normalizers
            obs = normalizer.denormalize(normalizers.obs, seen) if config.normalize_obs else seen
            return signal.expect(experience.models, experience.own, normalizers, obs, action)

        now = make_model_free(make_learner(gain), obs_size, action_size, config)
        return now.improve(key, state, experience)

    at_rest = make_learner(lambda seen, action: jnp.zeros(seen.shape[0]))
    return make_model_free(at_rest, obs_size, action_size, config)._replace(improve=improve)
