"""Random network distillation: what a network has not learned to imitate has not been seen.

Burda et al. (2019), arXiv 1810.12894, with small networks for vectors instead of theirs for pictures. A predictor
learns to say of an observation what a fixed random network says; its error is the bonus.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore import normalizer, replay, validate
from jaxplore.beliefs.base import Belief, make_no_belief
from jaxplore.dynamics import Normalizers
from jaxplore.networks import ACTIVATIONS, MLP, apply
from jaxplore.normalizer import Normalizer
from jaxplore.replay import Replay
from jaxplore.signals.base import Learning, Seen, Signal
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import Checks

UNIT = "squared distillation error"
"""Of the bonus, a mean over features, before it is divided by a standard deviation."""


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

    Raises:
        FieldError: `obs_size` below 1; when it is traced, observations or weights of another shape.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> rnd = make_rnd(3, RNDConfig(hidden=(16,), features=8))
        >>> state = rnd.init(jax.random.key(0))
        >>> state, error = rnd.update(state, jnp.ones((5, 3)), jnp.ones(5))
        >>> bool(rnd.error(state, jnp.ones(3)) < error)
        True
    """
    validate.sizes(obs_size=obs_size)
    config = config or RNDConfig()
    form = (config.features, config.activation, "orthogonal_relu", "orthogonal_relu")
    target = MLP(config.hidden, *form)
    predictor = MLP((*config.hidden, *(config.features,) * config.extra_layers), *form)
    optimizer = optax.adam(config.lr)

    def init(key: Key) -> RNDState:
        target_key, predictor_key = jax.random.split(key)
        params = predictor.init(predictor_key, jnp.zeros(obs_size))["params"]
        return RNDState(target.init(target_key, jnp.zeros(obs_size))["params"], params, optimizer.init(params))

    def distance(predicting: Params, fixed: Params, obs: Array) -> Array:
        validate.shape("obs", obs, "...", obs_size)
        seen = jnp.clip(obs, -config.obs_clip, config.obs_clip)
        wanted = jax.lax.stop_gradient(apply(target, fixed, seen))
        return jnp.mean((apply(predictor, predicting, seen) - wanted) ** 2, axis=-1)

    def update(state: RNDState, obs: Array, weights: Array) -> tuple[RNDState, Array]:
        validate.shape("weights", weights, *obs.shape[:-1])

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


@struct.dataclass
class Distilled:
    """What distillation carries as a signal."""

    rnd: RNDState
    scale: RewardScale
    position: Array
    """Of the replay, up to where transitions have been taken in, int32; -1 before the first round."""


def newest(data: Replay[Transition], position: Array, count: int) -> tuple[Transition, Array, Array]:
    """The real transitions since the replay's `position`, at most `count` of them.

    Returns:
        `(transitions [count, ...], valid [count], the replay's position now)`. A negative `position` stands for a
        replay that was never looked at: nothing is new.
    """
    capacity = replay.capacity(data)
    new = jnp.where(position < 0, 0, (data.position - position) % capacity)
    index = (position + jnp.arange(count)) % capacity
    return jax.tree.map(lambda leaf: leaf[index], data.rows), jnp.arange(count) < new, data.position


def make_distillation(
    obs_size: int, steps_per_round: int, config: RNDConfig | None = None, belief: Belief | None = None
) -> Signal:
    """Random network distillation as a signal: a transition is worth the error of where it leads.

    Each round learns from the transitions that it brought; those at the start, before the first round, only fill the
    statistics that observations are normalised with.

    Args:
        obs_size: `O`.
        steps_per_round: most transitions that a round brings.
        config: Burda et al.'s settings by default.
        belief: whose models imagine where a policy would lead; the score is not read off them. None: nothing can be
            imagined.

    Returns:
        A `Signal`. The metric of `fit` is `rnd_error`, of the last distillation step.

    Raises:
        FieldError: `obs_size` below 1.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import dynamics
        >>> signal = make_distillation(2, steps_per_round=25, config=RNDConfig(hidden=(8,), features=8))
        >>> own, obs, flag = signal.init(jax.random.key(0)), jnp.ones((5, 2)), jnp.zeros(5, bool)
        >>> rows = Transition(obs, jnp.zeros((5, 1)), jnp.zeros(5), obs, flag, flag)
        >>> signal.score(own, Seen(rows, None, None, dynamics.init_normalizers(2, 1))).shape
        (5,)
    """
    config = config or RNDConfig()
    rnd = make_rnd(obs_size, config)

    def init(key: Key) -> Distilled:
        return Distilled(rnd.init(key), init_scale(), jnp.full((), -1, jnp.int32))

    def see(seen: Seen) -> Array:
        return normalizer.normalize(seen.normalizers.obs, seen.transitions.next_obs)

    def score(own: Distilled, seen: Seen) -> Array:
        return rnd.error(own.rnd, see(seen))

    def measure(own: Distilled, seen: Seen, valid: Array) -> tuple[Distilled, Array]:
        bonus = score(own, seen)
        return dataclasses.replace(own, scale=update_scale(own.scale, bonus, valid, config.discount)), bonus

    def learn(own: Distilled, seen: Seen, weights: Array) -> tuple[Distilled, Array]:
        distilled, error = rnd.update(own.rnd, see(seen), weights)
        return dataclasses.replace(own, rnd=distilled), error

    def fit(own: Distilled, data: Replay[Transition], normalizers: Normalizers) -> tuple[Distilled, Metrics]:
        rows, valid, position = newest(data, own.position, steps_per_round)
        seen = Seen(rows, None, None, normalizers)
        own, _ = measure(own, seen, valid)

        def distil(i: Array, carry: tuple[Distilled, Array]) -> tuple[Distilled, Array]:
            return learn(carry[0], seen, valid.astype(jnp.float32))

        own, error = jax.lax.fori_loop(0, config.epochs, distil, (own, jnp.zeros(())))
        return dataclasses.replace(own, position=position), {"rnd_error": error}

    return Signal(
        score, UNIT, belief or make_no_belief(), init, fit, lambda own: own.scale.std, Learning(measure, learn)
    )
