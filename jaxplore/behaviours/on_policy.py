"""Behaviour on the policy's own steps alone: PPO, which forgets them once it has learned from them.

With random network distillation after Burda et al. (2019), arXiv 1810.12894: `jaxplore.signals.distillation`.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import normalizer
from jaxplore.behaviours.base import Behaviour, Experience
from jaxplore.dynamics import Normalizers
from jaxplore.learners.ppo import PPO, PPOConfig, PPOState, Rollout, make_ppo, minibatches
from jaxplore.normalizer import Normalizer
from jaxplore.signals.base import Learning, Seen, Signal
from jaxplore.signals.distillation import newest
from jaxplore.types import Array, Key, Metrics, Transition, no_metrics, traced_once
from jaxplore.validate import FieldError


def _summary(rewards: Array, valid: Array) -> Metrics:
    """Mean and 95th percentile of the rewards of new transitions; 0 if there are none."""
    held = jnp.where(valid, rewards, jnp.nan)
    return {
        "intrinsic_reward": jnp.where(valid[0], jnp.nanmean(held), 0.0),
        "intrinsic_reward_p95": jnp.where(valid[0], jnp.nanpercentile(held, 95.0), 0.0),
    }


@struct.dataclass
class OnPolicyState:
    """What PPO carries with a signal that learns when it does."""

    ppo: PPOState
    own: Any
    """What the signal carries."""
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


class OnPolicy(NamedTuple):
    """The fixed parts of the behaviour."""

    ppo: PPO
    signal: Signal
    learning: Learning
    """The signal's."""
    sizes: tuple[int, int]
    """`O` and `A`."""
    steps_per_round: int
    warm_up_steps: int
    config: PPOConfig

    @property
    def capacity(self) -> int:
        """Transitions that are held until an update."""
        return self.config.rollout_steps + self.steps_per_round


def make_on_policy(
    signal: Signal,
    obs_size: int,
    action_size: int,
    steps_per_round: int,
    warm_up_steps: int,
    config: PPOConfig | None = None,
) -> Behaviour:
    """PPO on the real steps that its own policy took, with a signal that learns from each as often as PPO does: with
    `make_distillation`, random network distillation as published.

    Rounds come every few steps and updates after many: each round takes its transitions in, with the probability of
    their actions under the policy that took them, and the round that brings them to a multiple of `rollout_steps`
    learns. Policy and signal see observations normalised with statistics that change at updates only, so that these
    probabilities are exact. The random steps at the start fill the statistics.

    Args:
        signal: how interesting a transition is; one that learns in steps (`Signal.learning`), which PPO takes over.
        obs_size: `O`.
        action_size: `A`.
        steps_per_round: most transitions that a round brings.
        warm_up_steps: `Experience.num_data` when the first round comes; those transitions are not the policy's.
        config: settings of PPO.

    Returns:
        A `Behaviour`. The metrics are PPO's and `rnd_error` (both 0 in rounds without an update), `updated` (1 or 0),
        `intrinsic_reward` and `intrinsic_reward_p95` (of the round's transitions, scaled; 0 where there are none).

    Raises:
        ValueError: a round brings more transitions than an update takes, or the signal does not learn in steps.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import dynamics, signals
        >>> signal = signals.make_distillation(2, 25, signals.RNDConfig(hidden=(8,), features=8))
        >>> behaviour = make_on_policy(signal, 2, 1, steps_per_round=25, warm_up_steps=256)
        >>> actor = behaviour.actor(jax.jit(behaviour.init)(jax.random.key(0)))
        >>> behaviour.act_greedily(jax.random.key(1), actor, dynamics.init_normalizers(2, 1), jnp.zeros((5, 2))).shape
        (5, 1)
    """
    config = config or PPOConfig()
    if signal.learning is None:
        raise ValueError(
            "the signal does not learn in steps, which PPO would take over. Allowed: distillation (make_distillation), "
            "or another behaviour on real transitions."
        )
    if config.rollout_steps < steps_per_round:
        raise FieldError(
            "rollout_steps",
            config.rollout_steps,
            f"at least steps_per_round={steps_per_round}",
            "is less than a round's steps",
            "PPOConfig",
        )
    ppo, sizes = make_ppo(obs_size, action_size, config), (obs_size, action_size)
    parts = OnPolicy(ppo, signal, signal.learning, sizes, steps_per_round, warm_up_steps, config)
    return Behaviour(
        init=functools.partial(init, parts),
        improve=functools.partial(improve, parts),
        actor=lambda state: (parts.ppo.actor(state.ppo), state.obs),
        act=functools.partial(act, parts),
        act_greedily=functools.partial(act_greedily, parts),
        score=functools.partial(score, parts),
    )


def init(parts: OnPolicy, key: Key) -> OnPolicyState:
    """New networks and no transitions."""
    assert parts.signal.init is not None
    ppo_key, own_key = jax.random.split(key)
    (obs_size, action_size), capacity = parts.sizes, parts.capacity
    obs, flag = jnp.zeros((capacity, obs_size)), jnp.zeros(capacity, bool)
    return OnPolicyState(
        ppo=parts.ppo.init(ppo_key),
        own=parts.signal.init(own_key),
        obs=normalizer.init(obs_size),
        steps=Transition(obs, jnp.zeros((capacity, action_size)), jnp.zeros(capacity), obs, flag, flag),
        log_prob=jnp.zeros(capacity),
        num=jnp.zeros((), jnp.int32),
        position=jnp.full((), -1, jnp.int32),
    )


def take(parts: OnPolicy, state: OnPolicyState, experience: Experience) -> tuple[OnPolicyState, Metrics]:
    """The state with the round's transitions in it."""
    ppo, count = parts.ppo, parts.steps_per_round
    normalizers = _statistics(state, experience.normalizers)
    rows, valid, position = newest(experience.data, state.position, count)
    log_prob = ppo.log_prob(ppo.actor(state.ppo), normalizer.normalize(normalizers.obs, rows.obs), rows.action)
    place = jnp.where(valid, state.num + jnp.arange(count), parts.capacity)
    after = dataclasses.replace(
        state,
        obs=normalizers.obs,
        steps=jax.tree.map(lambda held, new: held.at[place].set(new, mode="drop"), state.steps, rows),
        log_prob=state.log_prob.at[place].set(log_prob, mode="drop"),
        num=jnp.minimum(state.num + jnp.sum(valid), parts.capacity).astype(jnp.int32),
        position=position,
    )
    bonus = score(parts, state, experience.normalizers, rows)
    return after, _summary(bonus / parts.signal.std(state.own), valid)


def _statistics(state: OnPolicyState, normalizers: Normalizers) -> Normalizers:
    """What observations are normalised with: the state's own, or before the first round those of the warm-up."""
    known = state.position >= 0
    obs = jax.tree.map(lambda old, new: jnp.where(known, old, new), state.obs, normalizers.obs)
    return dataclasses.replace(normalizers, obs=obs)


def score(parts: OnPolicy, state: OnPolicyState, normalizers: Normalizers, transitions: Transition) -> Array:
    """What the signal says of transitions, `[T]`."""
    assert parts.signal.score is not None
    return parts.signal.score(state.own, Seen(transitions, None, None, _statistics(state, normalizers)))


def learn(parts: OnPolicy, key: Key, state: OnPolicyState, experience: Experience) -> tuple[OnPolicyState, Metrics]:
    """PPO and the signal on the transitions held, which are then dropped."""
    learning, config, capacity = parts.learning, parts.config, parts.capacity
    num_batches = config.rollout_steps // config.minibatch_size
    ppo_key, own_key = jax.random.split(key)
    normalizers = dataclasses.replace(experience.normalizers, obs=state.obs)
    see = lambda obs: normalizer.normalize(state.obs, obs)  # noqa: E731
    held = jnp.arange(capacity) < state.num
    own, bonus = learning.measure(state.own, Seen(state.steps, None, None, normalizers), held)
    steps = state.steps._replace(obs=see(state.steps.obs), next_obs=see(state.steps.next_obs))
    rollout = Rollout(steps, bonus / parts.signal.std(own), state.log_prob)
    learned, metrics = parts.ppo.update(ppo_key, state.ppo, rollout, see(experience.obs), state.num)

    def one(own: Any, index: Array) -> tuple[Any, Array]:
        rows = jax.tree.map(lambda leaf: leaf[index], state.steps)
        return learning.learn(own, Seen(rows, None, None, normalizers), held[index].astype(jnp.float32))

    order = minibatches(own_key, capacity, state.num, num_batches, config.minibatch_size, config.epochs)
    own, errors = jax.lax.scan(one, own, order)
    after = dataclasses.replace(state, ppo=learned, own=own, obs=experience.normalizers.obs, num=0 * state.num)
    return after, {**metrics, "rnd_error": errors[-1], "updated": jnp.ones(())}


def improve(parts: OnPolicy, key: Key, state: OnPolicyState, experience: Experience) -> tuple[OnPolicyState, Metrics]:
    """One round: take its transitions in, and learn if that makes them enough."""
    state, seen = take(parts, state, experience)
    # From the count that all seeds share, so that the rounds in between cost nothing under `vmap` either.
    taken = experience.num_data - parts.warm_up_steps
    length = parts.config.rollout_steps
    is_due = taken // length > jnp.maximum(taken - parts.steps_per_round, 0) // length
    learned = traced_once(functools.partial(learn, parts))
    nothing = no_metrics(lambda: learned(key, state, experience)[1])
    after, metrics = jax.lax.cond(is_due, lambda: learned(key, state, experience), lambda: (state, nothing))
    return after, {**metrics, **seen}


def act(parts: OnPolicy, key: Key, actor: Any, normalizers: Normalizers, obs: Array) -> Array:
    """An action drawn from the policy, which has statistics of its own."""
    return parts.ppo.act(key, actor[0], normalizer.normalize(actor[1], obs))


def act_greedily(parts: OnPolicy, key: Key, actor: Any, normalizers: Normalizers, obs: Array) -> Array:
    """The policy's best action."""
    return parts.ppo.act_greedily(actor[0], normalizer.normalize(actor[1], obs))
