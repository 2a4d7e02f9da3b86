"""What a behaviour is, and what those that train a learner share.

A behaviour is a named tuple of pure functions. `improve` learns from a belief and the real data, `act` gives the
action for the real environment.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxplore import normalizer, replay
from jaxplore.dynamics import Normalizers
from jaxplore.learners.base import Learner
from jaxplore.replay import Replay
from jaxplore.signals.base import Signal
from jaxplore.types import Array, Key, Metrics, Transition, no_metrics, traced_once

DRAWN_AHEAD = 64
"""Updates whose random numbers are drawn at once, at most, to bound memory."""
LABEL_CHUNK = 1024
"""Real transitions are given their intrinsic reward this many at a time, to bound memory."""


class Experience(NamedTuple):
    """What a behaviour learns from in one round."""

    models: Any
    """Models drawn from the belief, fixed for the round, so that the imagined task stands still."""
    data: Replay[Transition]
    """All real transitions."""
    num_data: Array
    """How many there are, int32; the same for every seed carried side by side."""
    normalizers: Normalizers
    obs: Array
    """Where the real environment stands, `[O]`."""
    own: Any = ()
    """What the signal carries beside the belief, fixed for the round, too."""


class Behaviour(NamedTuple):
    """A behaviour as pure functions."""

    init: Callable[[Key], Any]
    """`init(key) -> state`."""
    improve: Callable[[Key, Any, Experience], tuple[Any, Metrics]]
    """`improve(key, state, experience) -> (state, metrics)`."""
    actor: Callable[[Any], Any]
    """`actor(state) -> actor`: the part of the state that acting needs, small enough to hand around."""
    act: Callable[[Key, Any, Normalizers, Array], Array]
    """`act(key, actor, normalizers, obs [..., O]) -> action [..., A]`, for the real environment."""
    act_greedily: Callable[[Key, Any, Normalizers, Array], Array] | None = None
    """The same without exploring, for evaluation: the action that the behaviour holds for the best. None: `act`."""
    score: Callable[[Any, Normalizers, Transition], Array] | None = None
    """`score(state, normalizers, transitions [T, ...]) -> [T]`: the signal's score, where the behaviour holds what the
    signal carries beside the belief, and says when it learns. None: the explorer does."""
    adopt: Callable[[Any, Any], Any] | None = None
    """`adopt(state, actor) -> state`: with the policy of another behaviour's `actor`, to learn on from. None: there is
    no policy that could be taken over and would stay."""


def make_act(
    learner: Learner, act_greedily: bool, normalize_obs: bool = True
) -> Callable[[Key, Any, Normalizers, Array], Array]:
    """`Behaviour.act` of a learner, which sees normalised observations or, if not `normalize_obs`, as they are."""

    def act(key: Key, actor: Any, normalizers: Normalizers, obs: Array) -> Array:
        seen = normalizer.normalize(normalizers.obs, obs) if normalize_obs else obs
        return learner.act_greedily(actor, seen) if act_greedily else learner.act(key, actor, seen)

    return act


def renewed(key: Key, state: Any, init: Callable[[Key], Any], restart_every: int) -> Any:
    """`state`, or a fresh one from `init` when its `age` is `restart_every` rounds. 0: never."""
    if restart_every == 0:
        return state
    if restart_every == 1:
        return init(key)
    due = state.age == restart_every
    return jax.tree.map(lambda new, old: jnp.where(due, new, old), init(key), state)


def check_imaginable(signal: Signal) -> None:
    """Raise unless it can be said of imagined transitions what they are worth.

    Raises:
        ValueError: names what fits.
    """
    allowed = "a signal with a belief that predicts, or a behaviour on real transitions"
    if signal.score is None:
        raise ValueError(
            "the signal cannot be imagined: it is the environment's own reward, which only real transitions have. "
            f"Allowed: {allowed}."
        )
    if signal.belief.predict is None:
        raise ValueError(f"belief predicts nothing, so the signal cannot be imagined. Allowed: {allowed}.")


def label(signal: Signal, experience: Experience) -> Replay[Transition]:
    """The real data with the reward that the round's signal gives it.

    Args:
        signal: how interesting a transition is; of the environment's own reward the data are returned as they are.
        experience: models and data. Rows that the data do not hold get 0.

    Returns:
        The data, `reward` replaced.
    """
    data, normalizers = experience.data, experience.normalizers
    if signal.score is None:
        return data
    capacity = replay.capacity(data)

    def chunk(i: Array, rewards: Array) -> Array:
        place = i * LABEL_CHUNK + jnp.arange(LABEL_CHUNK)
        # The last chunk is filled up with rows already seen: a reward may compare rows, and empty ones are no data.
        rows = jax.tree.map(lambda leaf: leaf[place % jnp.maximum(data.size, 1)], data.rows)
        given = signal.judge(experience.models, experience.own, normalizers, rows)
        return rewards.at[jnp.where(place < data.size, place, capacity)].set(given, mode="drop")

    num_chunks = (jnp.minimum(experience.num_data, capacity) + LABEL_CHUNK - 1) // LABEL_CHUNK
    rewards = jax.lax.fori_loop(0, num_chunks, chunk, jnp.zeros(capacity))
    return dataclasses.replace(data, rows=data.rows._replace(reward=rewards))


class RewardMoments(NamedTuple):
    """What a learner counts rewards in: `(reward - mean) / std`, scalars."""

    std: Array | float
    mean: Array | float


class Lesson(NamedTuple):
    """What a learner is trained on."""

    choose: Callable[[Key], Any]
    """`choose(key) -> choice`: which rows a batch has."""
    take: Callable[[Any], Transition]
    """`take(choice) -> batch [B, ...]`."""
    normalizers: Normalizers | None
    """What observations are normalised with. None: they stay as they are."""
    moments: RewardMoments
    """What the learner counts rewards in."""


def lesson_of(
    parts: Sequence[tuple[Replay[Transition], int]], normalizers: Normalizers | None, moments: RewardMoments
) -> Lesson:
    """Batches of so many rows of each buffer, drawn anew each time; of those with none nothing is drawn."""
    parts = [(data, num) for data, num in parts if num > 0]

    def choose(key: Key) -> list[Array]:
        keys = [key] if len(parts) == 1 else jax.random.split(key, len(parts))
        return [replay.choose(keys[i], data, num) for i, (data, num) in enumerate(parts)]

    def take(choice: list[Array]) -> Transition:
        rows = [replay.take(data, index) for (data, _), index in zip(parts, choice, strict=True)]
        return rows[0] if len(rows) == 1 else jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *rows)

    return Lesson(choose, take, normalizers, moments)


def train(
    learner: Learner,
    key: Key,
    state: Any,
    lesson: Lesson,
    num_updates: int,
    metrics: Metrics,
    wanted: bool | Array = True,
) -> tuple[Any, Metrics]:
    """`num_updates` updates, or none unless `wanted`, which may be traced; `metrics` are returned where there are none.

    What is random is drawn for many updates at once: a few numbers at a time cost as much as a layer of a network.
    """
    normalizers = lesson.normalizers
    num_blocks = -(-num_updates // DRAWN_AHEAD)
    size = -(-num_updates // num_blocks)

    def see(obs: Array) -> Array:
        return obs if normalizers is None else normalizer.normalize(normalizers.obs, obs)

    def keys_of(i: Array) -> tuple[Key, Key]:
        draw_key, update_key = jax.random.split(jax.random.fold_in(key, i))
        return draw_key, update_key

    def block(b: Array, carry: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
        draw_keys, update_keys = jax.vmap(keys_of)(b * size + jnp.arange(size))
        choices = jax.vmap(lesson.choose)(draw_keys)
        noises = update_keys if learner.noise is None else jax.vmap(learner.noise)(update_keys)

        def one_update(i: Array, carry: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
            choice, noise = jax.tree.map(lambda leaf: leaf[i], (choices, noises))
            batch = lesson.take(choice)
            reward = (batch.reward - lesson.moments.mean) / lesson.moments.std
            batch = batch._replace(obs=see(batch.obs), next_obs=see(batch.next_obs), reward=reward)
            return traced_once(learner.update_given or learner.update)(noise, carry[0], batch)

        return jax.lax.fori_loop(0, jnp.minimum(size, num_updates - b * size), one_update, carry)

    return jax.lax.fori_loop(0, jnp.where(wanted, num_blocks, 0), block, (state, metrics))


def no_learner_metrics(learner: Learner, state: Any, obs_size: int, action_size: int) -> Metrics:
    """Zeros in the shape of the learner's metrics, to start a loop of its updates of `state` with."""
    num = learner.batch_size
    flags, obs = jnp.zeros(num, bool), jnp.zeros((num, obs_size))
    batch = Transition(obs, jnp.zeros((num, action_size)), jnp.zeros(num), obs, flags, flags)
    key = jax.random.key(0)
    noise = learner.noise(key) if learner.noise else key
    return no_metrics(lambda: traced_once(learner.update_given or learner.update)(noise, state, batch)[1])


AS_THEY_ARE = RewardMoments(1.0, 0.0)
"""Rewards in their own units."""


def reward_moments(
    data: Replay[Transition], normalize: bool, center: bool, std: Array | float = AS_THEY_ARE.std
) -> RewardMoments:
    """Of the rewards held the standard deviation, at least 1e-6, and the mean; `std` and 0 where they are not asked
    for.
    """
    if not normalize and not center:
        return RewardMoments(std, AS_THEY_ARE.mean)
    held = jnp.arange(replay.capacity(data)) < data.size
    count = jnp.maximum(data.size, 1)
    rewards = jnp.where(held, data.rows.reward, 0.0)
    mean = jnp.sum(rewards) / count
    own_std = jnp.maximum(jnp.sqrt(jnp.sum(jnp.where(held, rewards - mean, 0.0) ** 2) / count), 1e-6)
    return RewardMoments(own_std if normalize else std, mean if center else AS_THEY_ARE.mean)
