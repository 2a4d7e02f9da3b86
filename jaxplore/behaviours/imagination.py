"""Behaviour by imagination: a learner is trained in rollouts of the belief's models (Algorithm 1, lines 7-9)."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, get_args

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
from jaxplore.behaviours.rollout import Mover, rollout, world_of
from jaxplore.behaviours.uniform import uniform_actions
from jaxplore.learners.base import Learner
from jaxplore.replay import Replay
from jaxplore.signals.base import Signal
from jaxplore.types import Array, Key, Metrics, Transition
from jaxplore.validate import Checks


@dataclass(frozen=True)
class ImaginationConfig:
    """How the policy is trained in each round. The defaults are nnaisense/max's, which the paper uses, but for what
    Algorithm 1 prints: the policy learns from imagined and from real data, both with the round's own rewards.
    """

    num_actors: int = 128
    """Rollouts side by side. nnaisense/max: 128."""
    horizon: int = 50
    """Steps of a rollout. nnaisense/max: 50."""
    num_rollouts: int = 50
    """Times all actors roll out, one after the other. nnaisense/max: 50."""
    num_random_rollouts: int = 3
    """How many of them take uniform actions and train nothing. nnaisense/max: 3."""
    updates_per_rollout: int = 50
    """Updates of the policy after each rollout. nnaisense/max: one per imagined step."""
    real_updates: int = 100
    """Updates on the real data alone, before imagining. nnaisense/max: 100."""
    real_fraction: float = 0.5
    """Share of each later batch that is real. Paper: the policy is trained on the union of both (Algorithm 1), which
    does not say how much of a batch is real. 0: imagined data only (nnaisense/max). 1: real data only; then nothing
    is imagined."""
    current_fraction: float = 1.0
    """Share of the actors that start where the environment stands; the others start in past states."""
    mover: Mover = "per_step"
    """Which model moves an actor. nnaisense/max: a random one `per_step`. Also `per_rollout`, `mean`."""
    bound: float = 0.0
    """Standard deviations of the real data that imagined observations and changes stay within. 0: no bound (paper)."""
    replay_capacity: int = 320_000
    """Imagined transitions kept. nnaisense/max makes 320,000 in a round."""
    restart_every: int = 1
    """Rounds that a policy lives for. 1: a new one each round (nnaisense/max). 0: for good."""
    keep_imagined: bool = False
    """Whether what was imagined in earlier rounds of a policy's life stays, with the rewards that it had then. Paper:
    no, Algorithm 1 learns from what the round's own models say."""
    normalize_reward: bool = False
    """Whether rewards are divided by their standard deviation over the imagined data. Paper: no."""
    center_reward: bool = False
    """Whether their mean over the same data is taken off. A policy of unending episodes is the same for any constant,
    but values first have to climb to it: with a discount of 0.99 to a hundred times the mean. Paper: no."""
    act_greedily: bool = True
    """Whether the real environment gets the policy's squashed mean (nnaisense/max) or a sample."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        for field in ("num_actors", "horizon", "num_rollouts", "updates_per_rollout", "replay_capacity"):
            checks.at_least(field, 1)
        for field in ("num_random_rollouts", "real_updates", "restart_every"):
            checks.at_least(field, 0)
        checks.in_range("bound", 0.0)
        for field in ("real_fraction", "current_fraction"):
            checks.in_range(field, 0.0, 1.0)
        checks.one_of("mover", get_args(Mover))
        if self.replay_capacity < self.num_actors * self.horizon:
            allowed = f"at least num_actors * horizon = {self.num_actors * self.horizon}"
            raise checks.refusal("replay_capacity", "does not hold one rollout", allowed)


@struct.dataclass
class ImaginationState:
    """What a policy trained in imagination carries."""

    learner: Any
    imagined: Replay[Transition]
    age: Array
    """Rounds that the policy has lived through, int32."""


class Imagination(NamedTuple):
    """The fixed parts of the behaviour."""

    signal: Signal
    learner: Learner
    example: Transition
    """One transition of zeros, in the environment's shapes."""
    config: ImaginationConfig
    discrete: bool
    """Whether an action is one of `A` choices, as a one-hot vector."""
    step: Callable[[Array, Array], Array] | None
    """See `World.step`."""


def make_imagination(
    signal: Signal,
    learner: Learner,
    obs_size: int,
    action_size: int,
    config: ImaginationConfig,
    discrete: bool = False,
    step: Callable[[Array, Array], Array] | None = None,
) -> Behaviour:
    """Train a learner in rollouts imagined by the belief's models (Algorithm 1, lines 7-9).

    Args:
        signal: what is sought, with a belief whose models imagine.
        learner: such as `make_sac` gives, or where actions are discrete `make_ddqn`; it sees normalised observations.
        obs_size: `O`.
        action_size: `A`.
        config: how much of everything.
        discrete: whether an action is one of `A` choices, as a one-hot vector.
        step: a simulator that moves actors in place of the models; see `World.step`.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update, and `imagined_reward`,
        `imagined_reward_p95` (of the last rollout, in the reward's own units) and `invalid_imagined` (share of its
        transitions that were not finite, and dropped).

    Raises:
        ValueError: the signal cannot be imagined, or a size is below 1.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, learners, rewards, signals
        >>> belief = beliefs.make_generator_belief(2, 1, dynamics.DynamicsConfig(hidden=(8,)))
        >>> sac = learners.make_sac(2, 1, learners.SACConfig(hidden=(8,)))
        >>> reward = signals.Reward(lambda prediction, delta, normalizers: rewards.variance(prediction), "squared")
        >>> behaviour = make_imagination(
        ...     signals.make_belief_signal(belief, reward), sac, 2, 1,
        ...     ImaginationConfig(num_actors=16, horizon=5, replay_capacity=4000))
        >>> actor = behaviour.actor(jax.jit(behaviour.init)(jax.random.key(0)))
        >>> behaviour.act(jax.random.key(1), actor, dynamics.init_normalizers(2, 1), jnp.zeros((5, 2))).shape
        (5, 1)
    """
    check_imaginable(signal)
    validate.sizes(obs_size=obs_size, action_size=action_size)
    flag = jnp.zeros((), bool)
    example = Transition(jnp.zeros(obs_size), jnp.zeros(action_size), jnp.zeros(()), jnp.zeros(obs_size), flag, flag)
    parts = Imagination(signal, learner, example, config, discrete, step)
    return Behaviour(
        init=functools.partial(init, parts),
        improve=functools.partial(improve, parts),
        actor=lambda state: learner.actor(state.learner),
        act=make_act(learner, config.act_greedily),
        act_greedily=make_act(learner, True),
    )


def init(parts: Imagination, key: Key) -> ImaginationState:
    """A new policy and no imagined data."""
    imagined = replay.init(parts.example, parts.config.replay_capacity)
    return ImaginationState(parts.learner.init(key), imagined, jnp.zeros((), jnp.int32))


def improve(
    parts: Imagination, key: Key, state: ImaginationState, experience: Experience
) -> tuple[ImaginationState, Metrics]:
    """One round: updates on real data if the configuration wants some, then imagined rollouts with updates after each;
    where batches are all real, these updates without the rollouts.

    The round's models are fixed. Metrics are those of the last update and the last rollout.
    """
    learner, config = parts.learner, parts.config
    init_key, real_key, rollouts_key = jax.random.split(key, 3)
    normalizers = experience.normalizers
    state = renewed(init_key, state, functools.partial(init, parts), config.restart_every)
    before = state.imagined if config.keep_imagined else replay.cleared(state.imagined)
    needs_real = config.real_updates > 0 or config.real_fraction > 0
    real = label(parts.signal, experience) if needs_real else experience.data
    std = parts.signal.std(experience.own)
    obs_size, action_size = parts.example.obs.shape[0], parts.example.action.shape[0]
    learner_state = state.learner
    metrics = no_learner_metrics(learner, learner_state, obs_size, action_size)
    real_updates = config.real_updates
    if config.real_fraction == 1.0:
        real_updates += max(config.num_rollouts - config.num_random_rollouts, 0) * config.updates_per_rollout
    if real_updates > 0:
        moments = reward_moments(real, config.normalize_reward, config.center_reward, std)
        lesson = lesson_of([(real, learner.batch_size)], normalizers, moments)
        learner_state, metrics = train(learner, real_key, learner_state, lesson, real_updates, metrics)
    if config.real_fraction == 1.0:
        return ImaginationState(learner_state, before, state.age + 1), metrics

    def one_rollout(i: Array, carry: tuple[Any, Replay[Transition], Metrics, Metrics]) -> tuple[Any, ...]:
        learner_state, imagined, metrics, _ = carry
        start_key, rollout_key, train_key = jax.random.split(jax.random.fold_in(rollouts_key, i), 3)
        is_random = i < config.num_random_rollouts
        rows = imagine(parts, (start_key, rollout_key), learner.actor(learner_state), is_random, experience)
        finite = jnp.isfinite(rows.reward) & jnp.all(jnp.isfinite(rows.next_obs), axis=-1)
        imagined = replay.add(imagined, rows, finite)
        num_real = round(config.real_fraction * learner.batch_size)
        parts_of_batch = [(real, num_real), (imagined, learner.batch_size - num_real)]
        moments = reward_moments(imagined, config.normalize_reward, config.center_reward, std)
        lesson = lesson_of(parts_of_batch, normalizers, moments)
        num_updates = config.updates_per_rollout
        learner_state, metrics = train(
            learner, train_key, learner_state, lesson, num_updates, metrics, wanted=~is_random
        )
        rewards = jnp.where(finite, rows.reward, jnp.nan)
        seen = {
            "imagined_reward": jnp.nanmean(rewards),
            "imagined_reward_p95": jnp.nanpercentile(rewards, 95.0),
            "invalid_imagined": jnp.mean(~finite),
        }
        return learner_state, imagined, metrics, seen

    nothing = jnp.zeros(())
    seen = {"imagined_reward": nothing, "imagined_reward_p95": nothing, "invalid_imagined": nothing}
    learner_state, imagined, metrics, seen = jax.lax.fori_loop(
        0, config.num_rollouts, one_rollout, (learner_state, before, metrics, seen)
    )
    return ImaginationState(learner_state, imagined, state.age + 1), {**metrics, **seen}


def imagine(
    parts: Imagination, keys: tuple[Key, Key], actor: Any, is_random: Array, experience: Experience
) -> Transition:
    """One rollout of all actors, by the policy or by uniform actions: transitions `[H * N, ...]`."""
    config, normalizers = parts.config, experience.normalizers
    start_key, rollout_key = keys

    def act(key: Key, obs: Array) -> Array:
        drawn = parts.learner.act(key, actor, normalizer.normalize(normalizers.obs, obs))
        return jnp.where(is_random, uniform_actions(key, obs, drawn.shape[-1], parts.discrete), drawn)

    world = world_of(parts.signal, experience)._replace(step=parts.step)
    start = starts(start_key, experience, config.num_actors, config.current_fraction)
    rows = rollout(rollout_key, act, world, start, config.horizon, config.mover, config.bound)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), rows)


def starts(key: Key, experience: Experience, num_actors: int, current_fraction: float) -> Array:
    """Where the actors start, `[N, O]`: a share of them where the environment stands, the others in past states."""
    num_current = round(current_fraction * num_actors)
    past = replay.sample(key, experience.data, num_actors).obs
    current = (jnp.arange(num_actors) < num_current)[:, None]
    return jnp.where(current, experience.obs[None], past)
