"""A policy by direct gradient ascent on a differentiable intrinsic reward, through the models that imagine it.

After the "differentiable" form of Pathak et al. (2019), arXiv 1906.04161: where the reward is a smooth function of the
action, no value function and no reinforcement learning are needed. Theirs looks one step ahead; the gradient does not
pass through the environment. With a longer horizon it passes through the models' predictions, too.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore import normalizer, replay, validate
from jaxplore.behaviours.base import Behaviour, Experience, check_imaginable
from jaxplore.behaviours.rollout import World, rollout, world_of
from jaxplore.dynamics import Normalizers
from jaxplore.networks import (
    ACTIVATIONS,
    INITIALIZERS,
    GaussianParams,
    TanhGaussianPolicy,
    apply,
    sample_tanh_gaussian,
    tanh_mean,
)
from jaxplore.signals.base import Signal
from jaxplore.types import Array, Key, Metrics, Params, no_metrics, traced_once
from jaxplore.validate import Checks


@dataclass(frozen=True)
class GradientPolicyConfig:
    """Settings of gradient ascent on the reward. Pathak et al. give few; the rest are as many as SAC has."""

    horizon: int = 1
    """Steps imagined from each start, H. Pathak et al. (2019): 1."""
    discount: float = 0.99
    """gamma per imagined step."""
    updates: int = 2450
    """Gradient steps per round: as many as nnaisense/max's SAC takes."""
    batch_size: int = 4096
    """Start states per gradient step, drawn from all real data."""
    lr: float = 1e-3
    """Adam's learning rate."""
    hidden: tuple[int, ...] = (256, 256)
    """Hidden widths of the policy, as SAC's."""
    activation: str = "leaky_relu"
    """As SAC's."""
    init: str = "orthogonal"
    """Initialiser of every layer, as SAC's."""
    log_std_min: float = -5.0
    """Lower end of the policy's log standard deviation."""
    log_std_max: float = 2.0
    """Upper end."""
    policy_penalty: float = 1e-3
    """Weight of mean(mean^2), before the squash, against actions that saturate at -1 or 1."""
    grad_clip: float = 5.0
    """Bound on each entry of a gradient, as SAC's."""
    restart: bool = True
    """Whether each round starts from a new policy or continues with the last one."""
    normalize_reward: bool = False
    """Whether rewards are divided by their mean size over the batch, so that the penalty's weight does not depend on
    it."""
    bound: float = 0.0
    """Standard deviations of the real data that imagined observations and changes stay within. 0: no bound."""
    act_greedily: bool = True
    """Whether the real environment gets the policy's squashed mean or a sample."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        for field in ("horizon", "updates", "batch_size"):
            checks.at_least(field, 1)
        checks.widths("hidden")
        checks.one_of("activation", ACTIVATIONS)
        checks.one_of("init", INITIALIZERS)
        for field in ("lr", "grad_clip"):
            checks.in_range(field, 0.0, open_low=True)
        checks.in_range("discount", 0.0, 1.0)
        for field in ("policy_penalty", "bound"):
            checks.in_range(field, 0.0)
        checks.in_range("log_std_max", high=10.0)
        checks.in_range("log_std_min", high=self.log_std_max)


@struct.dataclass
class GradientPolicyState:
    """What the policy carries."""

    params: Params
    opt_state: optax.OptState


class GradientPolicy(NamedTuple):
    """The fixed parts of the behaviour."""

    signal: Signal
    policy: TanhGaussianPolicy
    optimizer: optax.GradientTransformation
    obs_size: int
    config: GradientPolicyConfig


def imagined_return(
    key: Key, policy: TanhGaussianPolicy, params: Params, world: World, start: Array, config: GradientPolicyConfig
) -> tuple[Array, tuple[Array, GaussianParams]]:
    """What the policy is expected to earn in imagination, as a differentiable function of its parameters.

    `J = mean over start states of sum_{t < H} discount^t r(s_t, a_t)`: actions are drawn from the policy by the
    reparametrisation, and one model, drawn per start state, leads from each state to the next.

    Args:
        key: consumed.
        policy: the network; it sees normalised observations.
        params: its parameters.
        world: the belief, models drawn from it, their units and the intrinsic reward.
        start: `[N, O]`.
        config: horizon, discount and bound.

    Returns:
        `(J, (rewards [H, N], policy at the start states))`.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, rewards
        >>> belief = beliefs.make_generator_belief(2, 1, dynamics.DynamicsConfig(hidden=(8,)))
        >>> models = belief.sample(jax.random.key(0), belief.init(jax.random.key(1)), 4)
        >>> policy = TanhGaussianPolicy((8,), 1)
        >>> params = policy.init(jax.random.key(2), jnp.zeros(2))["params"]
        >>> world = World(
        ...     belief, models, dynamics.init_normalizers(2, 1), lambda seen: rewards.variance(seen.prediction))
        >>> config = GradientPolicyConfig(horizon=3)
        >>> gradient = jax.jit(jax.grad(lambda params: imagined_return(
        ...     jax.random.key(3), policy, params, world, jnp.zeros((16, 2)), config)[0]))
        >>> gradient(params)["mlp"]["output"]["kernel"].shape
        (8, 2)
    """

    def gaussian(obs: Array) -> GaussianParams:
        return apply(policy, params, normalizer.normalize(world.normalizers.obs, obs))

    def act(act_key: Key, obs: Array) -> Array:
        return sample_tanh_gaussian(act_key, gaussian(obs))[0]

    rows = rollout(key, act, world, start, config.horizon, "per_rollout", config.bound)
    weights = config.discount ** jnp.arange(config.horizon)
    return jnp.mean(weights @ rows.reward), (rows.reward, gaussian(start))


def make_gradient_policy(
    signal: Signal, obs_size: int, action_size: int, config: GradientPolicyConfig | None = None
) -> Behaviour:
    """Climb the intrinsic reward's own gradient.

    Args:
        signal: what is sought, differentiable in what the models predict or in where that leads; its belief's models
            are differentiated and must predict changes, not probabilities.
        obs_size: `O`.
        action_size: `A`.
        config: how long, how far ahead, and how fast.

    Returns:
        A `Behaviour`. The metrics, of the last gradient step: `imagined_return` (J), `imagined_reward`,
        `imagined_reward_p95`, `saturation` (mean absolute action of the squashed mean) and `gradient` (its norm).

    Raises:
        ValueError: a size below 1; the signal cannot be imagined, or its belief predicts which of finitely many states
            comes next.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, rewards, signals
        >>> belief = beliefs.make_generator_belief(2, 1, dynamics.DynamicsConfig(hidden=(8,)))
        >>> reward = signals.Reward(lambda prediction, delta, normalizers: rewards.variance(prediction), "squared")
        >>> behaviour = make_gradient_policy(
        ...     signals.make_belief_signal(belief, reward), 2, 1, GradientPolicyConfig(hidden=(8,)))
        >>> actor = behaviour.actor(behaviour.init(jax.random.key(0)))
        >>> behaviour.act(jax.random.key(1), actor, dynamics.init_normalizers(2, 1), jnp.zeros((5, 2))).shape
        (5, 1)
    """
    validate.sizes(obs_size=obs_size, action_size=action_size)
    config = config or GradientPolicyConfig()
    check_imaginable(signal)
    if signal.belief.encoding.is_probability:
        raise ValueError("the belief's predictions cannot be differentiated. Allowed: DynamicsConfig.target='delta'.")
    policy = TanhGaussianPolicy(
        config.hidden, action_size, config.activation, config.init, (config.log_std_min, config.log_std_max)
    )
    optimizer = optax.chain(optax.clip(config.grad_clip), optax.adam(config.lr))
    parts = GradientPolicy(signal, policy, optimizer, obs_size, config)
    act_greedily = functools.partial(act_by_mean, parts)
    return Behaviour(
        init=functools.partial(init, parts),
        improve=functools.partial(improve, parts),
        actor=lambda state: state.params,
        act=act_greedily if config.act_greedily else functools.partial(act_by_draw, parts),
        act_greedily=act_greedily,
    )


def init(parts: GradientPolicy, key: Key) -> GradientPolicyState:
    """A new policy."""
    params = parts.policy.init(key, jnp.zeros(parts.obs_size))["params"]
    return GradientPolicyState(params, parts.optimizer.init(params))


def loss(
    params: Params, parts: GradientPolicy, key: Key, experience: Experience, start: Array
) -> tuple[Array, Metrics]:
    """The imagined return, negative and scaled, with the penalty on actions that saturate; and metrics."""
    config = parts.config
    world = world_of(parts.signal, experience)
    expected, (rewards, gaussian) = imagined_return(key, parts.policy, params, world, start, config)
    scale = parts.signal.std(experience.own)
    if config.normalize_reward:
        scale = jnp.maximum(jnp.mean(jnp.abs(jax.lax.stop_gradient(rewards))), 1e-6)
    metrics = {
        "imagined_return": expected,
        "imagined_reward": jnp.mean(rewards),
        "imagined_reward_p95": jnp.percentile(rewards, 95.0),
        "saturation": jnp.mean(jnp.abs(tanh_mean(gaussian))),
    }
    return -expected / scale + config.policy_penalty * jnp.mean(gaussian.mean**2), metrics


def update(
    parts: GradientPolicy, key: Key, state: GradientPolicyState, experience: Experience
) -> tuple[GradientPolicyState, Metrics]:
    """One gradient step, from past states."""
    start_key, rollout_key = jax.random.split(key)
    start = replay.sample(start_key, experience.data, parts.config.batch_size).obs
    gradient, metrics = jax.grad(loss, has_aux=True)(state.params, parts, rollout_key, experience, start)
    steps, opt_state = parts.optimizer.update(gradient, state.opt_state, state.params)
    after = GradientPolicyState(optax.apply_updates(state.params, steps), opt_state)
    return after, {**metrics, "gradient": optax.tree.norm(gradient)}


def improve(
    parts: GradientPolicy, key: Key, state: GradientPolicyState, experience: Experience
) -> tuple[GradientPolicyState, Metrics]:
    """One round of gradient steps, from a new policy if the configuration says so."""
    init_key, updates_key = jax.random.split(key)
    start = init(parts, init_key) if parts.config.restart else state
    step = traced_once(functools.partial(update, parts))

    def one(i: Array, carry: tuple[GradientPolicyState, Metrics]) -> tuple[GradientPolicyState, Metrics]:
        return step(jax.random.fold_in(updates_key, i), carry[0], experience)

    metrics = no_metrics(lambda: step(updates_key, start, experience)[1])
    return jax.lax.fori_loop(0, parts.config.updates, one, (start, metrics))


def act_by_mean(parts: GradientPolicy, key: Key, actor: Params, normalizers: Normalizers, obs: Array) -> Array:
    """The policy's squashed mean."""
    return tanh_mean(apply(parts.policy, actor, normalizer.normalize(normalizers.obs, obs)))


def act_by_draw(parts: GradientPolicy, key: Key, actor: Params, normalizers: Normalizers, obs: Array) -> Array:
    """An action drawn from the policy."""
    return sample_tanh_gaussian(key, apply(parts.policy, actor, normalizer.normalize(normalizers.obs, obs)))[0]
