"""Behaviour by random network distillation: PPO on the policy's own steps, or a learner on replayed transitions.

Burda et al. (2019), arXiv 1810.12894. The bonus itself is in `jaxplore.signals.distillation`.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import normalizer, replay
from jaxplore.behaviours.base import Behaviour, Bonus, Experience, Lesson, RewardMoments, make_act, train
from jaxplore.behaviours.real_data import ReactiveConfig
from jaxplore.dynamics import Normalizers
from jaxplore.learners.base import Learner
from jaxplore.learners.ppo import PPO, PPOConfig, PPOState, Rollout, make_ppo, minibatches
from jaxplore.normalizer import Normalizer
from jaxplore.signals.distillation import (
    RND,
    UNIT,
    RewardScale,
    RNDConfig,
    RNDState,
    init_scale,
    make_rnd,
    update_scale,
)
from jaxplore.types import Array, Key, Metrics, Transition, no_metrics
from jaxplore.validate import FieldError

SCALE_SAMPLE = 1024
"""Real transitions over which the standard deviation of bonuses is taken."""


def newest(experience: Experience, position: Array, count: int) -> tuple[Transition, Array, Array]:
    """The real transitions since the replay's `position`, at most `count` of them.

    Returns:
        `(transitions [count, ...], valid [count], the replay's position now)`. A negative `position` stands for a
        replay that was never looked at: nothing is new.
    """
    data = experience.data
    capacity = replay.capacity(data)
    new = jnp.where(position < 0, 0, (data.position - position) % capacity)
    index = (position + jnp.arange(count)) % capacity
    return jax.tree.map(lambda leaf: leaf[index], data.rows), jnp.arange(count) < new, data.position


def _summary(rewards: Array, valid: Array) -> Metrics:
    """Mean and 95th percentile of the rewards of new transitions; 0 if there are none."""
    held = jnp.where(valid, rewards, jnp.nan)
    return {
        "intrinsic_reward": jnp.where(valid[0], jnp.nanmean(held), 0.0),
        "intrinsic_reward_p95": jnp.where(valid[0], jnp.nanpercentile(held, 95.0), 0.0),
    }


@struct.dataclass
class RNDPPOState:
    """What distillation with PPO carries."""

    ppo: PPOState
    rnd: RNDState
    scale: RewardScale
    obs: Normalizer
    """What observations are normalised with, the same from one update to the next."""
    steps: Transition
    """Real transitions since the last update, in their order, `[rollout_steps + steps_per_round, ...]`."""
    log_prob: Array
    """Of their actions, when they were taken."""
    num: Array
    """How many there are, int32."""
    position: Array
    """Of the replay, up to where transitions have been taken in, int32; -1 before the first round."""


class RNDPPO(NamedTuple):
    """The fixed parts of the behaviour."""

    ppo: PPO
    rnd: RND
    sizes: tuple[int, int]
    """`O` and `A`."""
    steps_per_round: int
    warm_up_steps: int
    ppo_config: PPOConfig
    rnd_config: RNDConfig

    @property
    def capacity(self) -> int:
        """Transitions that are held until an update."""
        return self.ppo_config.rollout_steps + self.steps_per_round


def make_rnd_ppo(
    obs_size: int,
    action_size: int,
    steps_per_round: int,
    warm_up_steps: int,
    ppo_config: PPOConfig | None = None,
    rnd_config: RNDConfig | None = None,
) -> Behaviour:
    """Random network distillation as published: PPO on the real steps that its own policy took.

    Rounds come every few steps and updates after many: each round takes its transitions in, with the probability of
    their actions under the policy that took them, and the round that brings them to a multiple of `rollout_steps`
    learns. Policy and predictor see observations normalised with statistics that change at updates only, so that these
    probabilities are exact. The random steps at the start fill the statistics.

    Args:
        obs_size: `O`.
        action_size: `A`.
        steps_per_round: most transitions that a round brings.
        warm_up_steps: `Experience.num_data` when the first round comes; those transitions are not the policy's.
        ppo_config: settings of PPO.
        rnd_config: settings of distillation.

    Returns:
        A `Behaviour`. The metrics are PPO's and `rnd_error` (both 0 in rounds without an update), `updated` (1 or 0),
        `intrinsic_reward` and `intrinsic_reward_p95` (of the round's transitions, scaled; 0 where there are none).

    Raises:
        ValueError: a round brings more transitions than an update takes.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import dynamics
        >>> behaviour = make_rnd_ppo(
        ...     2, 1, steps_per_round=25, warm_up_steps=256, ppo_config=PPOConfig(hidden=(8,)),
        ...     rnd_config=RNDConfig(hidden=(8,), features=8))
        >>> actor = behaviour.actor(jax.jit(behaviour.init)(jax.random.key(0)))
        >>> behaviour.act_greedily(jax.random.key(1), actor, dynamics.init_normalizers(2, 1), jnp.zeros((5, 2))).shape
        (5, 1)
    """
    ppo_config, rnd_config = ppo_config or PPOConfig(), rnd_config or RNDConfig()
    if ppo_config.rollout_steps < steps_per_round:
        raise FieldError(
            "rollout_steps",
            ppo_config.rollout_steps,
            f"at least steps_per_round={steps_per_round}",
            "is less than a round's steps",
            "PPOConfig",
        )
    parts = RNDPPO(
        make_ppo(obs_size, action_size, ppo_config),
        make_rnd(obs_size, rnd_config),
        (obs_size, action_size),
        steps_per_round,
        warm_up_steps,
        ppo_config,
        rnd_config,
    )
    return Behaviour(
        init=functools.partial(init_ppo, parts),
        improve=functools.partial(improve_ppo, parts),
        actor=lambda state: (parts.ppo.actor(state.ppo), state.obs),
        act=functools.partial(act_ppo, parts),
        act_greedily=functools.partial(act_ppo_greedily, parts),
        bonus=Bonus(functools.partial(score_ppo, parts), UNIT),
    )


def init_ppo(parts: RNDPPO, key: Key) -> RNDPPOState:
    """New networks and no transitions."""
    ppo_key, rnd_key = jax.random.split(key)
    (obs_size, action_size), capacity = parts.sizes, parts.capacity
    obs, flag = jnp.zeros((capacity, obs_size)), jnp.zeros(capacity, bool)
    return RNDPPOState(
        ppo=parts.ppo.init(ppo_key),
        rnd=parts.rnd.init(rnd_key),
        scale=init_scale(),
        obs=normalizer.init(obs_size),
        steps=Transition(obs, jnp.zeros((capacity, action_size)), jnp.zeros(capacity), obs, flag, flag),
        log_prob=jnp.zeros(capacity),
        num=jnp.zeros((), jnp.int32),
        position=jnp.full((), -1, jnp.int32),
    )


def take(parts: RNDPPO, state: RNDPPOState, experience: Experience) -> tuple[RNDPPOState, Metrics]:
    """The state with the round's transitions in it."""
    ppo, count = parts.ppo, parts.steps_per_round
    obs = _statistics(state, experience.normalizers)
    rows, valid, position = newest(experience, state.position, count)
    log_prob = ppo.log_prob(ppo.actor(state.ppo), normalizer.normalize(obs, rows.obs), rows.action)
    place = jnp.where(valid, state.num + jnp.arange(count), parts.capacity)
    after = dataclasses.replace(
        state,
        obs=obs,
        steps=jax.tree.map(lambda held, new: held.at[place].set(new, mode="drop"), state.steps, rows),
        log_prob=state.log_prob.at[place].set(log_prob, mode="drop"),
        num=jnp.minimum(state.num + jnp.sum(valid), parts.capacity).astype(jnp.int32),
        position=position,
    )
    bonus = parts.rnd.error(state.rnd, normalizer.normalize(obs, rows.next_obs))
    return after, _summary(bonus / state.scale.std, valid)


def _statistics(state: RNDPPOState, normalizers: Normalizers) -> Normalizer:
    """What observations are normalised with: the state's own, or before the first round those of the warm-up."""
    known = state.position >= 0
    return jax.tree.map(lambda old, new: jnp.where(known, old, new), state.obs, normalizers.obs)


def score_ppo(parts: RNDPPO, state: RNDPPOState, normalizers: Normalizers, transitions: Transition) -> Array:
    """The distillation error of each successor, `[T]`."""
    obs = _statistics(state, normalizers)
    return parts.rnd.error(state.rnd, normalizer.normalize(obs, transitions.next_obs))


def learn_ppo(parts: RNDPPO, key: Key, state: RNDPPOState, experience: Experience) -> tuple[RNDPPOState, Metrics]:
    """PPO and distillation on the transitions held, which are then dropped."""
    rnd, ppo_config, capacity = parts.rnd, parts.ppo_config, parts.capacity
    num_batches = ppo_config.rollout_steps // ppo_config.minibatch_size
    ppo_key, rnd_key = jax.random.split(key)
    see = lambda obs: normalizer.normalize(state.obs, obs)  # noqa: E731
    steps = state.steps._replace(obs=see(state.steps.obs), next_obs=see(state.steps.next_obs))
    held = jnp.arange(capacity) < state.num
    bonus = rnd.error(state.rnd, steps.next_obs)
    scale = update_scale(state.scale, bonus, held, parts.rnd_config.discount)
    rollout = Rollout(steps, bonus / scale.std, state.log_prob)
    learned, metrics = parts.ppo.update(ppo_key, state.ppo, rollout, see(experience.obs), state.num)

    def distil(distilled: RNDState, index: Array) -> tuple[RNDState, Array]:
        return rnd.update(distilled, steps.next_obs[index], held[index].astype(jnp.float32))

    order = minibatches(rnd_key, capacity, state.num, num_batches, ppo_config.minibatch_size, ppo_config.epochs)
    distilled, errors = jax.lax.scan(distil, state.rnd, order)
    after = dataclasses.replace(
        state, ppo=learned, rnd=distilled, scale=scale, obs=experience.normalizers.obs, num=0 * state.num
    )
    return after, {**metrics, "rnd_error": errors[-1], "updated": jnp.ones(())}


def improve_ppo(parts: RNDPPO, key: Key, state: RNDPPOState, experience: Experience) -> tuple[RNDPPOState, Metrics]:
    """One round: take its transitions in, and learn if that makes them enough."""
    state, seen = take(parts, state, experience)
    # From the count that all seeds share, so that the rounds in between cost nothing under `vmap` either.
    taken = experience.num_data - parts.warm_up_steps
    length = parts.ppo_config.rollout_steps
    is_due = taken // length > jnp.maximum(taken - parts.steps_per_round, 0) // length
    nothing = no_metrics(lambda: learn_ppo(parts, key, state, experience)[1])
    after, metrics = jax.lax.cond(is_due, lambda: learn_ppo(parts, key, state, experience), lambda: (state, nothing))
    return after, {**metrics, **seen}


def act_ppo(parts: RNDPPO, key: Key, actor: Any, normalizers: Normalizers, obs: Array) -> Array:
    """An action drawn from the policy, which has statistics of its own."""
    return parts.ppo.act(key, actor[0], normalizer.normalize(actor[1], obs))


def act_ppo_greedily(parts: RNDPPO, key: Key, actor: Any, normalizers: Normalizers, obs: Array) -> Array:
    """The policy's best action."""
    return parts.ppo.act_greedily(actor[0], normalizer.normalize(actor[1], obs))


@struct.dataclass
class RNDLearnerState:
    """What distillation with a learner on replayed transitions carries."""

    learner: Any
    rnd: RNDState
    scale: RewardScale
    position: Array
    """Of the replay, up to where transitions have been taken in, int32; -1 before the first round."""


class RNDLearner(NamedTuple):
    """The fixed parts of the behaviour."""

    learner: Learner
    rnd: RND
    steps_per_round: int
    config: ReactiveConfig
    rnd_config: RNDConfig


def make_rnd_learner(
    learner: Learner,
    obs_size: int,
    steps_per_round: int,
    config: ReactiveConfig | None = None,
    rnd_config: RNDConfig | None = None,
) -> Behaviour:
    """Train a learner on real transitions, replayed, each with the bonus that its successor has now.

    Args:
        learner: such as `make_sac` gives; it sees normalised observations.
        obs_size: `O`.
        steps_per_round: most transitions that a round brings.
        config: how much of everything, but for `restart_every`: the policy is never replaced. With `normalize_reward`
            bonuses are divided by their standard deviation over the data, as rewards of other methods are, in place of
            that of their discounted sum in time, which remembers how large they once were.
        rnd_config: settings of distillation.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update, `rnd_error`, `intrinsic_reward` and
        `intrinsic_reward_p95` (of the round's transitions, scaled; 0 where there are none).

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import dynamics, learners
        >>> sac = learners.make_sac(2, 1, learners.SACConfig(hidden=(8,)))
        >>> behaviour = make_rnd_learner(
        ...     sac, 2, steps_per_round=25, rnd_config=RNDConfig(hidden=(8,), features=8))
        >>> actor = behaviour.actor(jax.jit(behaviour.init)(jax.random.key(0)))
        >>> behaviour.act(jax.random.key(1), actor, dynamics.init_normalizers(2, 1), jnp.zeros((5, 2))).shape
        (5, 1)
    """
    config, rnd_config = config or ReactiveConfig(), rnd_config or RNDConfig()
    parts = RNDLearner(learner, make_rnd(obs_size, rnd_config), steps_per_round, config, rnd_config)
    return Behaviour(
        init=functools.partial(init_learner, parts),
        improve=functools.partial(improve_learner, parts),
        actor=lambda state: learner.actor(state.learner),
        act=make_act(learner, config.act_greedily),
        act_greedily=make_act(learner, True),
        bonus=Bonus(functools.partial(score_learner, parts), UNIT),
    )


def init_learner(parts: RNDLearner, key: Key) -> RNDLearnerState:
    """New networks."""
    learner_key, rnd_key = jax.random.split(key)
    never = jnp.full((), -1, jnp.int32)
    return RNDLearnerState(parts.learner.init(learner_key), parts.rnd.init(rnd_key), init_scale(), never)


def score_learner(
    parts: RNDLearner, state: RNDLearnerState, normalizers: Normalizers, transitions: Transition
) -> Array:
    """The distillation error of each successor, `[T]`."""
    return parts.rnd.error(state.rnd, normalizer.normalize(normalizers.obs, transitions.next_obs))


def improve_learner(
    parts: RNDLearner, key: Key, state: RNDLearnerState, experience: Experience
) -> tuple[RNDLearnerState, Metrics]:
    """One round: distil its transitions, then train the learner on all of them with the bonus they have now."""
    learner, rnd, rnd_config = parts.learner, parts.rnd, parts.rnd_config
    see = lambda obs: normalizer.normalize(experience.normalizers.obs, obs)  # noqa: E731
    rows, valid, position = newest(experience, state.position, parts.steps_per_round)
    next_obs, weights = see(rows.next_obs), valid.astype(jnp.float32)
    bonus = rnd.error(state.rnd, next_obs)
    scale = update_scale(state.scale, bonus, valid, rnd_config.discount)

    def distil(i: Array, carry: tuple[RNDState, Array]) -> tuple[RNDState, Array]:
        return rnd.update(carry[0], next_obs, weights)

    distilled, error = jax.lax.fori_loop(0, rnd_config.epochs, distil, (state.rnd, jnp.zeros(())))

    def choose(draw_key: Key) -> Array:
        return replay.choose(draw_key, experience.data, learner.batch_size)

    def take(index: Array) -> Transition:
        batch = replay.take(experience.data, index)
        return batch._replace(reward=rnd.error(distilled, see(batch.next_obs)))

    reward_std = scale.std
    if parts.config.normalize_reward:
        sample_key, key = jax.random.split(key)
        held = see(replay.sample(sample_key, experience.data, SCALE_SAMPLE).next_obs)
        reward_std = jnp.maximum(jnp.std(rnd.error(distilled, held)), 1e-6)
    nothing = no_metrics(lambda: learner.update(key, state.learner, take(choose(key)))[1])
    lesson = Lesson(choose, take, experience.normalizers, RewardMoments(reward_std, 0.0))
    learned, metrics = train(learner, key, state.learner, lesson, parts.config.updates, nothing)
    after = RNDLearnerState(learned, distilled, scale, position)
    return after, {**metrics, "rnd_error": error, **_summary(bonus / reward_std, valid)}
