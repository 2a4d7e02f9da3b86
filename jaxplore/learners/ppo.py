"""Proximal policy optimisation with two streams of reward, as random network distillation needs it.

Schulman et al. (2017), arXiv 1707.06347; advantages after Schulman et al. (2016), arXiv 1506.02438. The intrinsic
stream has its own value head and knows no episodes, the extrinsic one ends with them: Burda et al. (2019), arXiv
1810.12894. It learns from its own latest steps in their order, not from a replay, so it is no `Learner`; the rest of
the contract is the same. Pure functions; the caller normalises observations.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore import validate
from jaxplore.networks import ACTIVATIONS, INITIALIZERS, MLP, apply
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import Checks


@dataclass(frozen=True)
class PPOConfig:
    """Settings of PPO. The defaults are the usual ones for MuJoCo; steps between updates, passes over them and weights
    of the two streams are Burda et al.'s: in 10,000 steps the usual 2,048 would leave room for four updates.
    """

    hidden: tuple[int, ...] = (256, 256)
    """Hidden widths of policy and values."""
    activation: str = "tanh"
    """Usual for MuJoCo: tanh."""
    init: str = "orthogonal_relu"
    """Initialiser of the hidden layers. The policy's last layer starts a hundredth of its usual size."""
    lr: float = 3e-4
    """Adam's learning rate. Burda et al.: 1e-4."""
    rollout_steps: int = 128
    """Steps between two updates. Burda et al.: 128, of 32 actors. Usual for MuJoCo: 2,048."""
    epochs: int = 4
    """Passes over the steps per update. Burda et al.: 4. Usual for MuJoCo: 10."""
    minibatch_size: int = 32
    """Steps per gradient step. Burda et al.: a quarter of the steps."""
    clip: float = 0.2
    """How far the ratio of new to old probability may go from 1 and still pay. Burda et al.: 0.1."""
    discount: float = 0.99
    """gamma of the extrinsic stream per step."""
    intrinsic_discount: float = 0.99
    """gamma of the intrinsic stream per step. Burda et al.: 0.99."""
    gae_lambda: float = 0.95
    """lambda of both streams' advantages."""
    intrinsic_weight: float = 1.0
    """Weight of the intrinsic advantage. Burda et al.: 1."""
    extrinsic_weight: float = 0.0
    """Weight of the extrinsic advantage. 0: the task's reward is not used. Burda et al.: 2."""
    normalize_advantage: bool = True
    """Whether the sum of both is brought to mean 0 and standard deviation 1 at each update."""
    entropy_weight: float = 0.0
    """Weight of the Gaussian's entropy, nats. Burda et al.: 0.001."""
    value_weight: float = 0.5
    """Weight of the sum of both value heads' squared errors, each halved."""
    max_grad_norm: float = 0.5
    """Bound on the norm of a gradient."""
    log_std: float = 0.0
    """The policy's log standard deviation at the start."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.widths("hidden")
        checks.one_of("activation", ACTIVATIONS)
        checks.one_of("init", INITIALIZERS)
        for field in ("lr", "clip", "max_grad_norm"):
            checks.in_range(field, 0.0, open_low=True)
        for field in ("rollout_steps", "epochs", "minibatch_size"):
            checks.at_least(field, 1)
        for field in ("discount", "intrinsic_discount", "gae_lambda"):
            checks.in_range(field, 0.0, 1.0)
        for field in ("intrinsic_weight", "extrinsic_weight", "entropy_weight", "value_weight"):
            checks.in_range(field, 0.0)
        checks.in_range("log_std", -20.0, 2.0)
        if self.minibatch_size > self.rollout_steps:
            problem, allowed = "is more than an update has", f"at most rollout_steps={self.rollout_steps}"
            raise checks.refusal("minibatch_size", problem, allowed)


class Rollout(NamedTuple):
    """Steps in the order in which they were taken, `T` of them."""

    transitions: Transition
    """`[T, ...]`; `reward` is the extrinsic one."""
    intrinsic_reward: Array
    """`[T]`"""
    log_prob: Array
    """Of each action, under the policy that took it, `[T]`."""


@struct.dataclass
class PPOState:
    """What PPO carries."""

    params: Params
    """`{"policy", "log_std", "value"}`; `log_std` is `[A]`, `value` has two outputs: extrinsic and intrinsic."""
    opt_state: optax.OptState


class PPO(NamedTuple):
    """PPO as pure functions."""

    init: Callable[[Key], PPOState]
    """`init(key) -> state`."""
    actor: Callable[[PPOState], Any]
    """`actor(state) -> actor`: the part of the state that acting needs."""
    act: Callable[[Key, Any, Array], Array]
    """`act(key, actor, obs [..., O]) -> action [..., A]`, drawn, and clipped to [-1, 1]."""
    act_greedily: Callable[[Any, Array], Array]
    """`act_greedily(actor, obs [..., O]) -> action [..., A]`: the mean, clipped."""
    log_prob: Callable[[Any, Array, Array], Array]
    """`log_prob(actor, obs [..., O], action [..., A]) -> [...]`, of a clipped action."""
    update: Callable[[Key, PPOState, Rollout, Array, Array], tuple[PPOState, Metrics]]
    """`update(key, state, rollout, last_obs [O], num) -> (state, metrics)`: learn from the first `num` (int32) steps of
    the rollout, the rest being padding. `last_obs` is observed after them, where the stream continues."""


class PPONetworks(NamedTuple):
    """The fixed parts of PPO, which its functions take first; `make_networks` builds them."""

    policy: MLP
    """Of the Gaussian's mean, `[..., O] -> [..., A]`."""
    value: MLP
    """`[..., O] -> [..., 2]`: extrinsic, intrinsic."""
    optimizer: optax.GradientTransformation
    config: PPOConfig
    obs_size: int
    """`O`"""
    action_size: int
    """`A`"""


def make_networks(obs_size: int, action_size: int, config: PPOConfig) -> PPONetworks:
    """The networks and the optimiser that `config` describes."""
    policy = MLP(config.hidden, action_size, config.activation, config.init, "orthogonal_small")
    value = MLP(config.hidden, 2, config.activation, config.init, "orthogonal")
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(config.lr, eps=1e-5))
    return PPONetworks(policy, value, optimizer, config, obs_size, action_size)


class Minibatch(NamedTuple):
    """What a gradient step sees of `B` steps."""

    obs: Array
    """`[B, O]`"""
    action: Array
    """`[B, A]`"""
    log_prob: Array
    """Of each action, under the policy that took it, `[B]`."""
    advantage: Array
    """`[B]`"""
    target: Array
    """What both value heads should predict, `[B, 2]`."""


def generalized_advantages(
    reward: Array, value: Array, next_value: Array, goes_on: Array, discount: float, gae_lambda: float
) -> Array:
    """Generalised advantage estimates (Schulman et al. 2016, equation 16).

    `A_t = delta_t + discount * lambda * goes_on_t * A_{t+1}`, with `delta_t = r_t + discount * V'_t - V_t`.

    Args:
        reward: `[T]`.
        value: of what is seen before each step, `[T]`.
        next_value: of what is seen after each step, `[T]`; 0 where that is the end.
        goes_on: whether step t + 1 follows from step t, bool `[T]`.
        discount: gamma.
        gae_lambda: lambda.

    Returns:
        `[T]`.

    Example:
        >>> import jax.numpy as jnp
        >>> ones, zeros = jnp.ones(2), jnp.zeros(2)
        >>> generalized_advantages(ones, zeros, zeros, jnp.array([True, False]), 0.5, 1.0).tolist()
        [1.5, 1.0]
    """
    deltas = reward + discount * next_value - value

    def step(later: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        advantage = now[0] + discount * gae_lambda * jnp.where(now[1], later, 0.0)
        return advantage, advantage

    return jax.lax.scan(step, jnp.zeros(()), (deltas, goes_on), reverse=True)[1]


def clipped_objective(log_prob: Array, old_log_prob: Array, advantage: Array, clip: float) -> Array:
    """PPO's objective per step (Schulman et al. 2017, equation 7), to be maximised: all `[B]`.

    Example:
        >>> import jax.numpy as jnp
        >>> clipped_objective(jnp.log(jnp.array([1.5, 1.5])), jnp.zeros(2), jnp.array([1.0, -1.0]), 0.2).tolist()
        [1.2000000476837158, -1.5]
    """
    ratio = jnp.exp(log_prob - old_log_prob)
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)


def clipped_log_prob(mean: Array, log_std: Array, action: Array) -> Array:
    """Log-probability of a Gaussian draw that was clipped to [-1, 1]: `[..., A]` each -> `[...]`.

    Inside it is the Gaussian's density; at either end the probability of all that was clipped there, so that a policy
    that pushes its mean ever further out is not taken for one that changes (Fujita & Maeda 2018, arXiv 1802.07564).

    Example:
        >>> import jax.numpy as jnp
        >>> round(float(jnp.exp(clipped_log_prob(jnp.zeros(1), jnp.zeros(1), jnp.ones(1)))), 4)  # P(x > 1)
        0.1587
    """
    std = jnp.exp(log_std)
    inside = -0.5 * ((action - mean) / std) ** 2 - log_std - 0.5 * math.log(2 * math.pi)
    low, high = (jax.scipy.special.log_ndtr(end) for end in ((-1.0 - mean) / std, (mean - 1.0) / std))
    return jnp.sum(jnp.where(action >= 1.0, high, jnp.where(action <= -1.0, low, inside)), axis=-1)


def minibatches(key: Key, capacity: int, num: Array, num_batches: int, batch_size: int, epochs: int) -> Array:
    """Which rows each gradient step takes, int32 `[epochs * num_batches, batch_size]`.

    Each epoch goes through the first `num` of `capacity` rows in a new random order; where they are too few for all its
    batches, from the start again.
    """

    def one(key: Key) -> Array:
        # Rows that hold nothing come last.
        place = jax.random.uniform(key, (capacity,)) + (jnp.arange(capacity) >= num)
        return jnp.argsort(place)[jnp.arange(num_batches * batch_size) % jnp.maximum(num, 1)]

    return jax.vmap(one)(jax.random.split(key, epochs)).reshape(epochs * num_batches, batch_size)


def init(networks: PPONetworks, key: Key) -> PPOState:
    """A state with freshly initialised networks; see `PPO.init`."""
    policy_key, value_key = jax.random.split(key)
    params = {
        "policy": networks.policy.init(policy_key, jnp.zeros(networks.obs_size))["params"],
        "log_std": jnp.full(networks.action_size, networks.config.log_std),
        "value": networks.value.init(value_key, jnp.zeros(networks.obs_size))["params"],
    }
    return PPOState(params, networks.optimizer.init(params))


def get_actor(state: PPOState) -> Params:
    """The parameters of the Gaussian; see `PPO.actor`."""
    return {"policy": state.params["policy"], "log_std": state.params["log_std"]}


def gaussian(networks: PPONetworks, actor: Params, obs: Array) -> tuple[Array, Array]:
    """`(mean, log_std)`, each `[..., A]`, of the policy's Gaussian before clipping, for `obs [..., O]`."""
    mean = apply(networks.policy, actor["policy"], obs)
    return mean, jnp.broadcast_to(actor["log_std"], mean.shape)


def act(networks: PPONetworks, key: Key, actor: Params, obs: Array) -> Array:
    """An action `[..., A]` drawn from the policy for `obs [..., O]`; see `PPO.act`."""
    mean, log_std = gaussian(networks, actor, obs)
    return jnp.clip(mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape), -1.0, 1.0)


def act_greedily(networks: PPONetworks, actor: Params, obs: Array) -> Array:
    """The policy's clipped mean `[..., A]` for `obs [..., O]`; see `PPO.act_greedily`."""
    return jnp.clip(gaussian(networks, actor, obs)[0], -1.0, 1.0)


def log_prob(networks: PPONetworks, actor: Params, obs: Array, action: Array) -> Array:
    """Log-probability `[...]` of a clipped `action [..., A]` for `obs [..., O]`; see `PPO.log_prob`."""
    return clipped_log_prob(*gaussian(networks, actor, obs), action)


def advantages(
    networks: PPONetworks, params: Params, rollout: Rollout, last_obs: Array, num: Array
) -> tuple[Array, Array]:
    """Both streams' values and advantages, each `[T, 2]`: extrinsic, intrinsic. 0 for padding.

    Args:
        networks: the fixed parts.
        params: `PPOState.params`.
        rollout: `[T, ...]`.
        last_obs: observed after the last step, `[O]`.
        num: steps that are no padding, int32.
    """
    config, steps = networks.config, rollout.transitions
    held = jnp.arange(len(steps.reward)) < num
    # The stream's next observation: after an episode's end it is the next one's start, which is no step's successor.
    seen_next = jnp.concatenate([steps.obs[1:], steps.obs[:1]]).at[num - 1].set(last_obs)
    values = apply(networks.value, params["value"], steps.obs)
    next_values = apply(networks.value, params["value"], steps.next_obs)
    extrinsic_next = jnp.where(steps.terminated, 0.0, next_values[:, 0])
    intrinsic_next = apply(networks.value, params["value"], seen_next)[:, 1]
    streams = (
        (steps.reward, extrinsic_next, ~(steps.terminated | steps.truncated), config.discount),
        (rollout.intrinsic_reward, intrinsic_next, jnp.ones_like(held), config.intrinsic_discount),
    )
    found = [
        generalized_advantages(
            jnp.where(held, reward, 0.0),
            jnp.where(held, values[:, i], 0.0),
            jnp.where(held, next_value, 0.0),
            goes_on & held,
            discount,
            config.gae_lambda,
        )
        for i, (reward, next_value, goes_on, discount) in enumerate(streams)
    ]
    return jnp.where(held[:, None], values, 0.0), jnp.stack(found, axis=-1)


def loss(networks: PPONetworks, params: Params, batch: Minibatch) -> tuple[Array, Metrics]:
    """Loss of policy and values on a minibatch (Schulman et al. 2017, equation 9): `(loss, metrics)`, scalars."""
    config = networks.config
    new_log_prob = log_prob(networks, params, batch.obs, batch.action)
    policy_loss = -jnp.mean(clipped_objective(new_log_prob, batch.log_prob, batch.advantage, config.clip))
    values = apply(networks.value, params["value"], batch.obs)
    value_loss = 0.5 * jnp.sum(jnp.mean((values - batch.target) ** 2, axis=0))
    entropy = jnp.sum(params["log_std"]) + 0.5 * networks.action_size * math.log(2 * math.pi * math.e)
    change = new_log_prob - batch.log_prob
    metrics = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "kl": jnp.mean(jnp.expm1(change) - change),
        "clipped": jnp.mean(jnp.abs(jnp.expm1(change)) > config.clip),
    }
    return policy_loss + config.value_weight * value_loss - config.entropy_weight * entropy, metrics


def _normalize(advantage: Array, held: Array, count: Array) -> Array:
    """`advantage [T]` with mean 0 and standard deviation 1 over the `count` steps where `held [T]` is set."""
    mean = jnp.sum(advantage) / count
    std = jnp.sqrt(jnp.sum(jnp.where(held, advantage - mean, 0.0) ** 2) / count)
    return (advantage - mean) / jnp.maximum(std, 1e-8)


def _gradient_step(networks: PPONetworks, rows: Minibatch, state: PPOState, index: Array) -> tuple[PPOState, Metrics]:
    """One gradient step on the steps `index [B]` of `rows [T, ...]`."""
    batch = jax.tree.map(lambda leaf: leaf[index], rows)
    gradient, metrics = jax.grad(partial(loss, networks), has_aux=True)(state.params, batch)
    steps, opt_state = networks.optimizer.update(gradient, state.opt_state)
    return PPOState(optax.apply_updates(state.params, steps), opt_state), metrics


def update(
    networks: PPONetworks, key: Key, state: PPOState, rollout: Rollout, last_obs: Array, num: Array
) -> tuple[PPOState, Metrics]:
    """All gradient steps on the first `num` steps of `rollout [T, ...]`; see `PPO.update`."""
    config, steps = networks.config, rollout.transitions
    validate.shape("rollout.transitions.obs", steps.obs, "T", networks.obs_size)
    validate.shape("rollout.transitions.action", steps.action, len(steps.obs), networks.action_size)
    for field in ("intrinsic_reward", "log_prob"):
        validate.shape(f"rollout.{field}", getattr(rollout, field), len(steps.obs))
    capacity, count = len(rollout.log_prob), jnp.maximum(num, 1)
    held = jnp.arange(capacity) < num
    values, both = advantages(networks, state.params, rollout, last_obs, num)
    targets = values + both
    advantage = config.extrinsic_weight * both[:, 0] + config.intrinsic_weight * both[:, 1]
    if config.normalize_advantage:
        advantage = _normalize(advantage, held, count)
    rows = Minibatch(rollout.transitions.obs, rollout.transitions.action, rollout.log_prob, advantage, targets)
    num_batches = config.rollout_steps // config.minibatch_size
    order = minibatches(key, capacity, num, num_batches, config.minibatch_size, config.epochs)
    after, metrics = jax.lax.scan(partial(_gradient_step, networks, rows), state, order)
    extrinsic_value, intrinsic_value = jnp.sum(values, axis=0) / count
    # Without a single step there is nothing to learn.
    after = jax.tree.map(lambda new, old: jnp.where(num > 0, new, old), after, state)
    return after, {
        **jax.tree.map(lambda leaf: leaf[-1], metrics),
        "extrinsic_value": extrinsic_value,
        "intrinsic_value": intrinsic_value,
    }


def make_ppo(obs_size: int, action_size: int, config: PPOConfig | None = None) -> PPO:
    """Make the learner.

    Args:
        obs_size: `O`.
        action_size: `A`, each entry of an action in [-1, 1].
        config: the usual settings for MuJoCo by default.

    Returns:
        A `PPO`. The metrics of `update` are `policy_loss`, `value_loss`, `entropy` (of the Gaussian before clipping,
        nats), `kl` (of the policy from the one that acted, estimated) and `clipped` (share of steps whose ratio is out
        of the clip), from the last gradient step; `intrinsic_value` and `extrinsic_value` are means over the steps.

    Raises:
        FieldError: a size below 1; when `update` is traced, steps of other shapes, or none.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> ppo = make_ppo(3, 1, PPOConfig(hidden=(8,), rollout_steps=4, minibatch_size=2))
        >>> state = ppo.init(jax.random.key(0))
        >>> obs, flag = jnp.ones((4, 3)), jnp.zeros(4, bool)
        >>> action = ppo.act(jax.random.key(1), ppo.actor(state), obs)
        >>> steps = Transition(obs, action, jnp.zeros(4), obs, flag, flag)
        >>> rollout = Rollout(steps, jnp.ones(4), ppo.log_prob(ppo.actor(state), obs, action))
        >>> state, metrics = jax.jit(ppo.update)(jax.random.key(2), state, rollout, obs[0], jnp.int32(4))
        >>> ppo.act_greedily(ppo.actor(state), obs[0]).shape
        (1,)
    """
    validate.sizes(obs_size=obs_size, action_size=action_size)
    networks = make_networks(obs_size, action_size, config or PPOConfig())
    return PPO(
        init=partial(init, networks),
        actor=get_actor,
        act=partial(act, networks),
        act_greedily=partial(act_greedily, networks),
        log_prob=partial(log_prob, networks),
        update=partial(update, networks),
    )
