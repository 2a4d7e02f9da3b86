"""Ways to turn an intrinsic reward into behaviour.

A behaviour is a named tuple of pure functions. `improve` learns from a belief and the real data, `act` gives the
action for the real environment.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import imagination, normalizer, replay
from jaxplore.beliefs import Belief
from jaxplore.dynamics import Normalizers
from jaxplore.imagination import Mover, Reward
from jaxplore.learner import Learner
from jaxplore.replay import Replay
from jaxplore.types import Array, Key, Metrics, Transition, no_metrics
from jaxplore.validate import Checks

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


@dataclass(frozen=True)
class ImaginationConfig:
    """How the policy is trained in each round. The defaults are nnaisense/max's, which the paper uses."""

    num_models: int = 32
    """m, models drawn for the round. Paper: 32."""
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
    real_fraction: float = 0.0
    """Share of each later batch that is real. 0: imagined data only (nnaisense/max); 1: real data only."""
    current_fraction: float = 1.0
    """Share of the actors that start where the environment stands; the others start in past states."""
    mover: Mover = "per_step"
    """Which model moves an actor. nnaisense/max: a random one `per_step`. Also `per_rollout`, `mean`."""
    bound: float = 0.0
    """Standard deviations of the real data that imagined observations and changes stay within. 0: no bound (paper)."""
    replay_capacity: int = 320_000
    """Imagined transitions kept. nnaisense/max makes 320,000 in a round."""
    restart_every: int = 1
    """Rounds that a policy and its imagined data live for. 1: new ones each round (nnaisense/max). 0: for good."""
    normalize_reward: bool = False
    """Whether rewards are divided by their standard deviation over the imagined data. Paper: no."""
    act_greedily: bool = True
    """Whether the real environment gets the policy's squashed mean (nnaisense/max) or a sample."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        for field in ("num_models", "num_actors", "horizon", "num_rollouts", "updates_per_rollout", "replay_capacity"):
            checks.at_least(field, 1)
        for field in ("num_random_rollouts", "real_updates", "restart_every"):
            checks.at_least(field, 0)
        checks.in_range("bound", 0.0)
        for field in ("real_fraction", "current_fraction"):
            checks.in_range(field, 0.0, 1.0)
        checks.one_of("mover", get_args(Mover))
        if self.replay_capacity < self.num_actors * self.horizon:
            raise ValueError(
                f"replay_capacity={self.replay_capacity} does not hold one rollout. "
                f"Allowed: at least num_actors * horizon = {self.num_actors * self.horizon}."
            )

    @property
    def num_updates(self) -> int:
        """Updates of the policy in a round, on real and on imagined data."""
        return self.real_updates + max(0, self.num_rollouts - self.num_random_rollouts) * self.updates_per_rollout


@struct.dataclass
class ImaginationState:
    """What a policy trained in imagination carries."""

    learner: Any
    imagined: Replay[Transition]
    age: Array
    """Rounds that the policy has lived through, int32."""


def make_imagination(
    belief: Belief, reward: Reward, learner: Learner, obs_size: int, action_size: int, config: ImaginationConfig
) -> Behaviour:
    """Train a learner in rollouts imagined by the belief's models (Algorithm 1, lines 7-9).

    Args:
        belief: whose models imagine; it must predict.
        reward: the intrinsic reward.
        learner: such as `make_sac` gives; it sees normalised observations.
        obs_size: `O`.
        action_size: `A`.
        config: how much of everything.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update, and `imagined_reward`,
        `imagined_reward_p95` (of the last rollout, in the reward's own units) and `invalid_imagined` (share of its
        transitions that were not finite, and dropped).

    Raises:
        ValueError: the belief does not predict.
    """
    predict = belief.predict
    if predict is None:
        raise ValueError("belief predicts nothing, so nothing can be imagined. Allowed: a belief with `predict`.")
    encoding = belief.encoding
    flag = jnp.zeros((), bool)
    example = Transition(jnp.zeros(obs_size), jnp.zeros(action_size), jnp.zeros(()), jnp.zeros(obs_size), flag, flag)

    def init(key: Key) -> ImaginationState:
        return ImaginationState(
            learner.init(key), replay.init(example, config.replay_capacity), jnp.zeros((), jnp.int32)
        )

    def starts(key: Key, experience: Experience) -> Array:
        """Where the actors start, `[N, O]`."""
        num_current = round(config.current_fraction * config.num_actors)
        past = replay.sample(key, experience.data, config.num_actors).obs
        current = (jnp.arange(config.num_actors) < num_current)[:, None]
        return jnp.where(current, experience.obs[None], past)

    def mixed_draw(imagined: Replay[Transition], real: Replay[Transition]) -> Callable[[Key], Transition]:
        num_real = round(config.real_fraction * learner.batch_size)

        def draw(key: Key) -> Transition:
            if num_real == 0:
                return replay.sample(key, imagined, learner.batch_size)
            if num_real == learner.batch_size:
                return replay.sample(key, real, learner.batch_size)
            real_key, imagined_key = jax.random.split(key)
            parts = (
                replay.sample(real_key, real, num_real),
                replay.sample(imagined_key, imagined, learner.batch_size - num_real),
            )
            return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *parts)

        return draw

    def improve(key: Key, state: ImaginationState, experience: Experience) -> tuple[ImaginationState, Metrics]:
        init_key, real_key, rollouts_key = jax.random.split(key, 3)
        normalizers = experience.normalizers
        state = renewed(init_key, state, init, config.restart_every)
        needs_real = config.real_updates > 0 or config.real_fraction > 0
        real = label(belief, reward, experience) if needs_real else experience.data
        learner_state, metrics = state.learner, _no_metrics(learner, obs_size, action_size)
        if config.real_updates > 0:
            learner_state, metrics = train(
                learner,
                real_key,
                learner_state,
                lambda draw_key: replay.sample(draw_key, real, learner.batch_size),
                normalizers,
                _reward_std(real, config.normalize_reward),
                config.real_updates,
                metrics,
            )

        def one_rollout(i: Array, carry):
            learner_state, imagined, metrics, _ = carry
            start_key, rollout_key, train_key = jax.random.split(jax.random.fold_in(rollouts_key, i), 3)
            is_random = i < config.num_random_rollouts
            actor = learner.actor(learner_state)

            def imagined_act(act_key: Key, obs: Array) -> Array:
                drawn = learner.act(act_key, actor, normalizer.normalize(normalizers.obs, obs))
                return jnp.where(is_random, jax.random.uniform(act_key, drawn.shape, minval=-1.0, maxval=1.0), drawn)

            rows = imagination.rollout(
                rollout_key,
                imagined_act,
                predict,
                reward,
                experience.models,
                normalizers,
                starts(start_key, experience),
                config.horizon,
                config.mover,
                config.bound,
                encoding,
            )
            rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), rows)
            finite = jnp.isfinite(rows.reward) & jnp.all(jnp.isfinite(rows.next_obs), axis=-1)
            imagined = replay.add(imagined, rows, finite)
            learner_state, metrics = train(
                learner,
                train_key,
                learner_state,
                mixed_draw(imagined, real),
                normalizers,
                _reward_std(imagined, config.normalize_reward),
                jnp.where(is_random, 0, config.updates_per_rollout),
                metrics,
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
            0, config.num_rollouts, one_rollout, (learner_state, state.imagined, metrics, seen)
        )
        return ImaginationState(learner_state, imagined, state.age + 1), {**metrics, **seen}

    return Behaviour(init, improve, lambda state: learner.actor(state.learner), make_act(learner, config.act_greedily))


@struct.dataclass
class ReactiveState:
    """What a policy trained on re-labelled real transitions carries."""

    learner: Any
    age: Array
    """Rounds that the policy has lived through, int32."""


def make_reactive(
    belief: Belief,
    reward: Reward,
    learner: Learner,
    obs_size: int,
    action_size: int,
    config: ImaginationConfig,
    num_updates: int = 0,
) -> Behaviour:
    """Train a learner on real transitions alone, with the intrinsic reward that the round's models give them.

    The reactive mode of nnaisense/max: novelty is looked for where the agent has been, nothing is imagined. As models
    have just been fitted to the same transitions, an error is small where the fit is good, not only where nothing is
    new.

    Args:
        belief: whose models label the data; it must predict.
        reward: the intrinsic reward.
        learner: such as `make_sac` gives; it sees normalised observations.
        obs_size: `O`.
        action_size: `A`.
        config: of it count `num_models`, `restart_every`, `normalize_reward` and `act_greedily`.
        num_updates: updates in each round. 0: as many as `config` comes to for a behaviour that imagines.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update.

    Raises:
        ValueError: the belief does not predict.
    """
    if belief.predict is None:
        raise ValueError("belief predicts nothing, so nothing can be labelled. Allowed: a belief with `predict`.")

    def init(key: Key) -> ReactiveState:
        return ReactiveState(learner.init(key), jnp.zeros((), jnp.int32))

    def improve(key: Key, state: ReactiveState, experience: Experience) -> tuple[ReactiveState, Metrics]:
        init_key, train_key = jax.random.split(key)
        state = renewed(init_key, state, init, config.restart_every)
        real = label(belief, reward, experience)
        learner_state, metrics = train(
            learner,
            train_key,
            state.learner,
            lambda draw_key: replay.sample(draw_key, real, learner.batch_size),
            experience.normalizers,
            _reward_std(real, config.normalize_reward),
            num_updates or config.num_updates,
            _no_metrics(learner, obs_size, action_size),
        )
        return ReactiveState(learner_state, state.age + 1), metrics

    return Behaviour(init, improve, lambda state: learner.actor(state.learner), make_act(learner, config.act_greedily))


def make_act(
    learner: Learner, act_greedily: bool, normalize_obs: bool = True
) -> Callable[[Key, Any, Normalizers, Array], Array]:
    """`Behaviour.act` of a learner, which sees normalised observations or, if not `normalize_obs`, as they are."""

    def act(key: Key, actor: Any, normalizers: Normalizers, obs: Array) -> Array:
        seen = normalizer.normalize(normalizers.obs, obs) if normalize_obs else obs
        return learner.act_greedily(actor, seen) if act_greedily else learner.act(key, actor, seen)

    return act


def renewed(key: Key, state: Any, init: Callable[[Key], Any], restart_every: int) -> Any:
    """`state`, or a new one from `init` when its `age` is `restart_every` rounds. 0: it lives for good."""
    if restart_every == 0:
        return state
    if restart_every == 1:
        return init(key)
    due = state.age == restart_every
    return jax.tree.map(lambda new, old: jnp.where(due, new, old), init(key), state)


def label(belief: Belief, reward: Reward, experience: Experience) -> Replay[Transition]:
    """The real data with the intrinsic reward that the round's models give it.

    Args:
        belief: it must predict.
        reward: the intrinsic reward.
        experience: models and data. Rows that the data do not hold get 0.

    Returns:
        The data, `reward` replaced.
    """
    data, normalizers, predict = experience.data, experience.normalizers, belief.predict
    assert predict is not None  # Whoever makes a behaviour refuses a belief that does not.
    capacity = replay.capacity(data)

    def chunk(i: Array, rewards: Array) -> Array:
        place = i * LABEL_CHUNK + jnp.arange(LABEL_CHUNK)
        # The last chunk is filled up with rows already seen: a reward may compare rows, and empty ones are no data.
        rows = jax.tree.map(lambda leaf: leaf[place % jnp.maximum(data.size, 1)], data.rows)
        prediction = predict(experience.models, belief.encoding.inputs(normalizers, rows.obs, rows.action))
        delta = belief.encoding.targets(normalizers, rows.obs, rows.next_obs)
        given = reward(prediction, delta, normalizers)
        return rewards.at[jnp.where(place < data.size, place, capacity)].set(given, mode="drop")

    num_chunks = (jnp.minimum(experience.num_data, capacity) + LABEL_CHUNK - 1) // LABEL_CHUNK
    rewards = jax.lax.fori_loop(0, num_chunks, chunk, jnp.zeros(capacity))
    return dataclasses.replace(data, rows=data.rows._replace(reward=rewards))


def train(
    learner: Learner,
    key: Key,
    state: Any,
    draw: Callable[[Key], Transition],
    normalizers: Normalizers | None,
    reward_std: Array,
    num_updates: int | Array,
    metrics: Metrics,
) -> tuple[Any, Metrics]:
    """`num_updates` updates, which may be a traced number, on batches that `draw` gives.

    Observations are normalised, or stay as they are where `normalizers` is None; rewards are divided by `reward_std`.
    """

    def see(obs: Array) -> Array:
        return obs if normalizers is None else normalizer.normalize(normalizers.obs, obs)

    def one_update(i: Array, carry: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
        draw_key, update_key = jax.random.split(jax.random.fold_in(key, i))
        batch = draw(draw_key)
        batch = batch._replace(obs=see(batch.obs), next_obs=see(batch.next_obs), reward=batch.reward / reward_std)
        return learner.update(update_key, carry[0], batch)

    return jax.lax.fori_loop(0, num_updates, one_update, (state, metrics))


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

    The learner lives as long as the run; each round goes on from where the last one stopped, on batches drawn from all
    real data.

    Args:
        learner: such as `make_ddqn` or `make_sac` gives.
        obs_size: `O`.
        action_size: `A`.
        config: how much of everything. `normalize_obs` is done as it says, whatever the observations are.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update.
    """
    config = config or ModelFreeConfig()

    def improve(key: Key, state: Any, experience: Experience) -> tuple[Any, Metrics]:
        return train(
            learner,
            key,
            state,
            lambda draw_key: replay.sample(draw_key, experience.data, learner.batch_size),
            experience.normalizers if config.normalize_obs else None,
            jnp.ones(()),
            config.updates_per_round,
            _no_metrics(learner, obs_size, action_size),
        )

    act = make_act(learner, config.act_greedily, config.normalize_obs)
    return Behaviour(learner.init, improve, learner.actor, act)


def _no_metrics(learner: Learner, obs_size: int, action_size: int) -> Metrics:
    """Zeros in the shape of the learner's metrics, to start a loop with."""
    flag, obs = jnp.zeros(1, bool), jnp.zeros((1, obs_size))
    batch = Transition(obs, jnp.zeros((1, action_size)), jnp.zeros(1), obs, flag, flag)
    key = jax.random.key(0)
    return no_metrics(lambda: learner.update(key, learner.init(key), batch)[1])


def _reward_std(data: Replay[Transition], wanted: bool) -> Array:
    """Standard deviation of the rewards held, at least 1e-6; 1 where rewards stay as they are."""
    if not wanted:
        return jnp.ones(())
    held = jnp.arange(replay.capacity(data)) < data.size
    count = jnp.maximum(data.size, 1)
    rewards = jnp.where(held, data.rows.reward, 0.0)
    mean = jnp.sum(rewards) / count
    return jnp.maximum(jnp.sqrt(jnp.sum(jnp.where(held, rewards - mean, 0.0) ** 2) / count), 1e-6)


def uniform_actions(key: Key, obs: Array, action_size: int, discrete: bool = False) -> Array:
    """Uniform random actions for `obs [..., O]`: `[..., A]`, in [-1, 1] or, if `discrete`, one-hot."""
    leading = obs.shape[:-1]
    if discrete:
        return jax.nn.one_hot(jax.random.randint(key, leading, 0, action_size), action_size)
    return jax.random.uniform(key, (*leading, action_size), minval=-1.0, maxval=1.0)


def make_uniform(action_size: int, discrete: bool = False) -> Behaviour:
    """Uniform actions, always: in [-1, 1], or one of `action_size` choices."""

    def act(key: Key, actor: Any, normalizers: Normalizers, obs: Array) -> Array:
        return uniform_actions(key, obs, action_size, discrete)

    return Behaviour(
        init=lambda key: (),
        improve=lambda key, state, experience: (state, {}),
        actor=lambda state: (),
        act=act,
    )
