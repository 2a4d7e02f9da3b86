"""Random network distillation: what a network has not learned to imitate has not been seen.

Burda et al. (2019), arXiv 1810.12894, with small networks for vectors instead of theirs for pictures. A predictor
learns to say of an observation what a fixed random network says; its error is the bonus. As published it goes with PPO
(`make_rnd_ppo`); `make_rnd_learner` gives the bonus to a learner on replayed transitions instead.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore import behaviours, normalizer, replay
from jaxplore.behaviours import Behaviour, Experience
from jaxplore.learner import Learner
from jaxplore.networks import ACTIVATIONS, MLP, apply
from jaxplore.normalizer import Normalizer
from jaxplore.ppo import PPOConfig, PPOState, Rollout, make_ppo, minibatches
from jaxplore.types import Array, Key, Metrics, Params, Transition, no_metrics
from jaxplore.validate import Checks

SCALE_SAMPLE = 1024
"""Real transitions over which the standard deviation of bonuses is taken."""


@dataclass(frozen=True)
class RNDConfig:
    """Settings of random network distillation."""

    hidden: tuple[int, ...] = (256, 256)
    """Hidden widths of the target, and of the predictor's first layers; ours, in place of convolutions."""
    features: int = 512
    """Outputs of both networks, and width of the predictor's extra layers. Burda et al.: 512."""
    extra_layers: int = 2
    """Hidden layers that only the predictor has. Burda et al.: 2."""
    activation: str = "leaky_relu"
    """Burda et al.: leaky ReLU, and ReLU in the extra layers."""
    lr: float = 1e-4
    """Adam's learning rate. Burda et al.: 1e-4."""
    obs_clip: float = 5.0
    """Standard deviations of the real data that an observation stays within. Burda et al.: 5."""
    discount: float = 0.99
    """gamma of the running sum of bonuses by whose standard deviation they are divided. Burda et al.: 0.99."""
    epochs: int = 4
    """Times that a transition is learned from after it came. Burda et al.: 4. With PPO, `PPOConfig.epochs` counts."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.widths("hidden")
        checks.one_of("activation", ACTIVATIONS)
        for field in ("features", "epochs"):
            checks.at_least(field, 1)
        checks.at_least("extra_layers", 0)
        for field in ("lr", "obs_clip"):
            checks.in_range(field, 0.0, open_low=True)
        checks.in_range("discount", 0.0, 1.0)


@struct.dataclass
class RNDState:
    """What distillation carries."""

    target: Params
    """Of the random network, which never changes."""
    predictor: Params
    opt_state: optax.OptState


class RND(NamedTuple):
    """Random network distillation as pure functions."""

    init: Callable[[Key], RNDState]
    """`init(key) -> state`."""
    error: Callable[[RNDState, Array], Array]
    """`error(state, obs [..., O]) -> [...]`: mean squared error over the features, of normalised observations."""
    update: Callable[[RNDState, Array, Array], tuple[RNDState, Array]]
    """`update(state, obs [B, O], weights [B]) -> (state, error)`: one gradient step on the weighted mean error."""


def make_rnd(obs_size: int, config: RNDConfig | None = None) -> RND:
    """Make target and predictor.

    Args:
        obs_size: `O`.
        config: Burda et al.'s settings by default.

    Returns:
        An `RND`.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> rnd = make_rnd(3, RNDConfig(hidden=(16,), features=8))
        >>> state = rnd.init(jax.random.key(0))
        >>> state, error = rnd.update(state, jnp.ones((5, 3)), jnp.ones(5))
        >>> bool(rnd.error(state, jnp.ones(3)) < error)
        True
    """
    config = config or RNDConfig()
    shape = (config.features, config.activation, "orthogonal_relu", "orthogonal_relu")
    target = MLP(config.hidden, *shape)
    predictor = MLP((*config.hidden, *(config.features,) * config.extra_layers), *shape)
    optimizer = optax.adam(config.lr)

    def init(key: Key) -> RNDState:
        target_key, predictor_key = jax.random.split(key)
        params = predictor.init(predictor_key, jnp.zeros(obs_size))["params"]
        return RNDState(target.init(target_key, jnp.zeros(obs_size))["params"], params, optimizer.init(params))

    def distance(predicting: Params, fixed: Params, obs: Array) -> Array:
        seen = jnp.clip(obs, -config.obs_clip, config.obs_clip)
        wanted = jax.lax.stop_gradient(apply(target, fixed, seen))
        return jnp.mean((apply(predictor, predicting, seen) - wanted) ** 2, axis=-1)

    def update(state: RNDState, obs: Array, weights: Array) -> tuple[RNDState, Array]:
        def loss(params: Params) -> Array:
            return jnp.sum(weights * distance(params, state.target, obs)) / jnp.maximum(jnp.sum(weights), 1.0)

        error, gradient = jax.value_and_grad(loss)(state.predictor)
        steps, opt_state = optimizer.update(gradient, state.opt_state)
        after = RNDState(state.target, optax.apply_updates(state.predictor, steps), opt_state)
        # Without a single row Adam is not to count a step either.
        return jax.tree.map(lambda new, old: jnp.where(jnp.sum(weights) > 0, new, old), after, state), error

    return RND(init, lambda state, obs: distance(state.predictor, state.target, obs), update)


@struct.dataclass
class RewardScale:
    """The spread of the discounted sum of rewards that came so far, by which they are divided."""

    running: Array
    """The sum up to the last step, each reward discounted by its age."""
    sums: Normalizer
    """Of all such sums."""

    @property
    def std(self) -> Array:
        """1 before the first reward."""
        return self.sums.std[0]


def init_scale() -> RewardScale:
    """Of no rewards."""
    return RewardScale(jnp.zeros(()), normalizer.init(1))


def update_scale(state: RewardScale, rewards: Array, valid: Array, discount: float) -> RewardScale:
    """Take rewards `[T]`, in the order in which they came, in where `valid [T]` is set.

    Example:
        >>> import jax.numpy as jnp
        >>> scale = update_scale(init_scale(), jnp.array([1.0, 1.0]), jnp.array([True, True]), 0.5)
        >>> float(scale.running), float(scale.std)  # of the sums 1 and 1.5
        (1.5, 0.25)
    """

    def step(running: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        running = jnp.where(now[1], discount * running + now[0], running)
        return running, running

    running, sums = jax.lax.scan(step, state.running, (rewards, valid))
    return RewardScale(running, normalizer.update(state.sums, sums[:, None], valid.astype(jnp.float32)))


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


def _told(rewards: Array, valid: Array) -> Metrics:
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
    """
    ppo_config, rnd_config = ppo_config or PPOConfig(), rnd_config or RNDConfig()
    if ppo_config.rollout_steps < steps_per_round:
        raise ValueError(
            f"PPOConfig.rollout_steps={ppo_config.rollout_steps} is less than a round's steps. "
            f"Allowed: at least steps_per_round={steps_per_round}."
        )
    ppo, rnd = make_ppo(obs_size, action_size, ppo_config), make_rnd(obs_size, rnd_config)
    capacity = ppo_config.rollout_steps + steps_per_round
    num_batches = ppo_config.rollout_steps // ppo_config.minibatch_size
    flag = jnp.zeros(capacity, bool)

    def init(key: Key) -> RNDPPOState:
        ppo_key, rnd_key = jax.random.split(key)
        obs = jnp.zeros((capacity, obs_size))
        return RNDPPOState(
            ppo=ppo.init(ppo_key),
            rnd=rnd.init(rnd_key),
            scale=init_scale(),
            obs=normalizer.init(obs_size),
            steps=Transition(obs, jnp.zeros((capacity, action_size)), jnp.zeros(capacity), obs, flag, flag),
            log_prob=jnp.zeros(capacity),
            num=jnp.zeros((), jnp.int32),
            position=jnp.full((), -1, jnp.int32),
        )

    def take(state: RNDPPOState, experience: Experience) -> tuple[RNDPPOState, Metrics]:
        """The state with the round's transitions in it."""
        known = state.position >= 0
        obs = jax.tree.map(lambda old, new: jnp.where(known, old, new), state.obs, experience.normalizers.obs)
        rows, valid, position = newest(experience, state.position, steps_per_round)
        log_prob = ppo.log_prob(ppo.actor(state.ppo), normalizer.normalize(obs, rows.obs), rows.action)
        place = jnp.where(valid, state.num + jnp.arange(steps_per_round), capacity)
        after = dataclasses.replace(
            state,
            obs=obs,
            steps=jax.tree.map(lambda held, new: held.at[place].set(new, mode="drop"), state.steps, rows),
            log_prob=state.log_prob.at[place].set(log_prob, mode="drop"),
            num=jnp.minimum(state.num + jnp.sum(valid), capacity).astype(jnp.int32),
            position=position,
        )
        bonus = rnd.error(state.rnd, normalizer.normalize(obs, rows.next_obs))
        return after, _told(bonus / state.scale.std, valid)

    def learn(key: Key, state: RNDPPOState, experience: Experience) -> tuple[RNDPPOState, Metrics]:
        ppo_key, rnd_key = jax.random.split(key)
        see = lambda obs: normalizer.normalize(state.obs, obs)  # noqa: E731
        steps = state.steps._replace(obs=see(state.steps.obs), next_obs=see(state.steps.next_obs))
        held = jnp.arange(capacity) < state.num
        bonus = rnd.error(state.rnd, steps.next_obs)
        scale = update_scale(state.scale, bonus, held, rnd_config.discount)
        rollout = Rollout(steps, bonus / scale.std, state.log_prob)
        learned, metrics = ppo.update(ppo_key, state.ppo, rollout, see(experience.obs), state.num)

        def distil(distilled: RNDState, index: Array) -> tuple[RNDState, Array]:
            return rnd.update(distilled, steps.next_obs[index], held[index].astype(jnp.float32))

        order = minibatches(rnd_key, capacity, state.num, num_batches, ppo_config.minibatch_size, ppo_config.epochs)
        distilled, errors = jax.lax.scan(distil, state.rnd, order)
        after = dataclasses.replace(
            state, ppo=learned, rnd=distilled, scale=scale, obs=experience.normalizers.obs, num=0 * state.num
        )
        return after, {**metrics, "rnd_error": errors[-1], "updated": jnp.ones(())}

    def improve(key: Key, state: RNDPPOState, experience: Experience) -> tuple[RNDPPOState, Metrics]:
        state, seen = take(state, experience)
        # From the count that all seeds share, so that the rounds in between cost nothing under `vmap` either.
        taken = experience.num_data - warm_up_steps
        length = ppo_config.rollout_steps
        is_due = taken // length > jnp.maximum(taken - steps_per_round, 0) // length
        nothing = no_metrics(lambda: learn(key, state, experience)[1])
        after, metrics = jax.lax.cond(is_due, lambda: learn(key, state, experience), lambda: (state, nothing))
        return after, {**metrics, **seen}

    def act(key: Key, actor: Any, normalizers: Any, obs: Array) -> Array:
        return ppo.act(key, actor[0], normalizer.normalize(actor[1], obs))

    return Behaviour(init, improve, lambda state: (ppo.actor(state.ppo), state.obs), act)


@struct.dataclass
class RNDLearnerState:
    """What distillation with a learner on replayed transitions carries."""

    learner: Any
    rnd: RNDState
    scale: RewardScale
    position: Array
    """Of the replay, up to where transitions have been taken in, int32; -1 before the first round."""


def make_rnd_learner(
    learner: Learner,
    obs_size: int,
    steps_per_round: int,
    config: behaviours.ImaginationConfig,
    num_updates: int,
    rnd_config: RNDConfig | None = None,
) -> Behaviour:
    """Train a learner on real transitions, replayed, each with the bonus that its successor has now.

    Args:
        learner: such as `make_sac` gives; it sees normalised observations.
        obs_size: `O`.
        steps_per_round: most transitions that a round brings.
        config: of it count `act_greedily` and `normalize_reward`: whether bonuses are divided by their standard
            deviation over the data, as rewards of other methods are, in place of that of their discounted sum in time,
            which remembers how large they once were.
        num_updates: updates in each round.
        rnd_config: settings of distillation.

    Returns:
        A `Behaviour`. The metrics are the learner's, from the last update, `rnd_error`, `intrinsic_reward` and
        `intrinsic_reward_p95` (of the round's transitions, scaled; 0 where there are none).
    """
    rnd_config = rnd_config or RNDConfig()
    rnd = make_rnd(obs_size, rnd_config)

    def init(key: Key) -> RNDLearnerState:
        learner_key, rnd_key = jax.random.split(key)
        return RNDLearnerState(learner.init(learner_key), rnd.init(rnd_key), init_scale(), jnp.full((), -1, jnp.int32))

    def improve(key: Key, state: RNDLearnerState, experience: Experience) -> tuple[RNDLearnerState, Metrics]:
        see = lambda obs: normalizer.normalize(experience.normalizers.obs, obs)  # noqa: E731
        rows, valid, position = newest(experience, state.position, steps_per_round)
        next_obs, weights = see(rows.next_obs), valid.astype(jnp.float32)
        bonus = rnd.error(state.rnd, next_obs)
        scale = update_scale(state.scale, bonus, valid, rnd_config.discount)

        def distil(i: Array, carry: tuple[RNDState, Array]) -> tuple[RNDState, Array]:
            return rnd.update(carry[0], next_obs, weights)

        distilled, error = jax.lax.fori_loop(0, rnd_config.epochs, distil, (state.rnd, jnp.zeros(())))

        def draw(draw_key: Key) -> Transition:
            batch = replay.sample(draw_key, experience.data, learner.batch_size)
            return batch._replace(reward=rnd.error(distilled, see(batch.next_obs)))

        reward_std = scale.std
        if config.normalize_reward:
            sample_key, key = jax.random.split(key)
            held = see(replay.sample(sample_key, experience.data, SCALE_SAMPLE).next_obs)
            reward_std = jnp.maximum(jnp.std(rnd.error(distilled, held)), 1e-6)
        nothing = no_metrics(lambda: learner.update(key, state.learner, draw(key))[1])
        learned, metrics = behaviours.train(
            learner, key, state.learner, draw, experience.normalizers, reward_std, num_updates, nothing
        )
        after = RNDLearnerState(learned, distilled, scale, position)
        return after, {**metrics, "rnd_error": error, **_told(bonus / reward_std, valid)}

    return Behaviour(
        init, improve, lambda state: learner.actor(state.learner), behaviours.make_act(learner, config.act_greedily)
    )
