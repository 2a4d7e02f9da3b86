"""Behaviour on real transitions alone: re-labelled with an intrinsic reward, or with the task's own."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import validate
from jaxplore.behaviours.base import (
    AS_THEY_ARE,
    Behaviour,
    Experience,
    label,
    lesson_of,
    make_act,
    no_learner_metrics,
    renewed,
    reward_moments,
    train,
)
from jaxplore.beliefs.base import Belief
from jaxplore.learners.base import Learner
from jaxplore.replay import Replay
from jaxplore.signals.base import Score
from jaxplore.types import Array, Key, Metrics, Transition
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
    """What a policy trained on re-labelled real transitions carries."""

    learner: Any
    age: Array
    """Rounds that the policy has lived through, int32."""


class Reactive(NamedTuple):
    """The fixed parts of the behaviour."""

    relabel: Callable[[Experience], Replay[Transition]]
    """`relabel(experience) -> data`, `reward` replaced."""
    learner: Learner
    sizes: tuple[int, int]
    """`O` and `A`."""
    config: ReactiveConfig


def make_reactive(
    belief: Belief,
    score: Score,
    learner: Learner,
    obs_size: int,
    action_size: int,
    config: ReactiveConfig | None = None,
) -> Behaviour:
    """Train a learner on real transitions alone, with the intrinsic reward that the round's models give them.

    The reactive mode of nnaisense/max: novelty is looked for where the agent has been, nothing is imagined. As models
    have just been fitted to the same transitions, an error is small where the fit is good, not only where nothing is
    new.

    Args:
        belief: whose models label the data; it must predict.
        score: the intrinsic reward.
        learner: such as `make_sac` gives; it sees normalised observations.
        obs_size: `O`.
        action_size: `A`.
        config: how much of everything.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update.

    Raises:
        ValueError: the belief does not predict, or a size is below 1.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, learners, rewards
        >>> belief = beliefs.make_ensemble_belief(2, 1, 5, dynamics_config=dynamics.DynamicsConfig(hidden=(8,)))
        >>> sac = learners.make_sac(2, 1, learners.SACConfig(hidden=(8,)))
        >>> behaviour = make_reactive(
        ...     belief, lambda prediction, delta, normalizers: rewards.prediction_error(prediction, delta), sac, 2, 1)
        >>> actor = behaviour.actor(jax.jit(behaviour.init)(jax.random.key(0)))
        >>> behaviour.act(jax.random.key(1), actor, dynamics.init_normalizers(2, 1), jnp.zeros((5, 2))).shape
        (5, 1)
    """
    if belief.predict is None:
        raise ValueError("belief predicts nothing, so nothing can be labelled. Allowed: a belief with `predict`.")
    relabel = functools.partial(label, belief, score)
    return make_relabelled(relabel, learner, obs_size, action_size, config)


def make_relabelled(
    relabel: Callable[[Experience], Replay[Transition]],
    learner: Learner,
    obs_size: int,
    action_size: int,
    config: ReactiveConfig | None = None,
) -> Behaviour:
    """`make_reactive` with a reward of any kind: `relabel(experience) -> data`, the real data with `reward` replaced.

    Raises:
        FieldError: a size is below 1.
    """
    validate.sizes(obs_size=obs_size, action_size=action_size)
    config = config or ReactiveConfig()
    parts = Reactive(relabel, learner, (obs_size, action_size), config)
    return Behaviour(
        init=functools.partial(init_reactive, parts),
        improve=functools.partial(improve_reactive, parts),
        actor=lambda state: learner.actor(state.learner),
        act=make_act(learner, config.act_greedily),
        act_greedily=make_act(learner, True),
    )


def init_reactive(parts: Reactive, key: Key) -> ReactiveState:
    """A new policy."""
    return ReactiveState(parts.learner.init(key), jnp.zeros((), jnp.int32))


def improve_reactive(
    parts: Reactive, key: Key, state: ReactiveState, experience: Experience
) -> tuple[ReactiveState, Metrics]:
    """One round: all real data get their reward, and the policy its updates on them."""
    learner, config = parts.learner, parts.config
    init_key, train_key = jax.random.split(key)
    state = renewed(init_key, state, functools.partial(init_reactive, parts), config.restart_every)
    real = parts.relabel(experience)
    moments = reward_moments(real, config.normalize_reward, config.center_reward)
    lesson = lesson_of([(real, learner.batch_size)], experience.normalizers, moments)
    nothing = no_learner_metrics(learner, *parts.sizes)
    learner_state, metrics = train(learner, train_key, state.learner, lesson, config.updates, nothing)
    return ReactiveState(learner_state, state.age + 1), metrics


@dataclass(frozen=True)
class ModelFreeConfig:
    """How a learner is trained on real transitions alone, with the environment's own reward."""

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
    learner: Learner, obs_size: int, action_size: int, config: ModelFreeConfig | None = None
) -> Behaviour:
    """Train a learner on the real transitions and the environment's own reward: no belief, no intrinsic reward.

    The learner lives as long as the run; each round continues where the last one stopped, on batches drawn from all
    real data.

    Args:
        learner: such as `make_ddqn` or `make_sac` gives.
        obs_size: `O`.
        action_size: `A`.
        config: how much of everything. `normalize_obs` is done as it says, whatever the observations are.

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
    validate.sizes(obs_size=obs_size, action_size=action_size)
    config = config or ModelFreeConfig()

    def improve(key: Key, state: Any, experience: Experience) -> tuple[Any, Metrics]:
        normalizers = experience.normalizers if config.normalize_obs else None
        lesson = lesson_of([(experience.data, learner.batch_size)], normalizers, AS_THEY_ARE)
        nothing = no_learner_metrics(learner, obs_size, action_size)
        return train(learner, key, state, lesson, config.updates_per_round, nothing)

    act = make_act(learner, config.act_greedily, config.normalize_obs)
    act_greedily = make_act(learner, True, config.normalize_obs)
    return Behaviour(learner.init, improve, learner.actor, act, act_greedily, adopt=learner.adopt)
