"""Soft actor-critic in its first form: a policy, two action-value networks, a value network and its slow copy.

Haarnoja et al. (2018), arXiv 1801.01290, with the settings that Ratzlaff et al. (2020) use for exploration (table
"List of SAC hyper-parameters", after nnaisense/max): fixed entropy weight alpha, leaky ReLU, orthogonal weights. As an
option alpha is learned, as in its second form (Haarnoja et al. 2018b, arXiv 1812.05905); the value network stays.
Pure functions; the caller normalises observations.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore.learners.base import Learner, checked
from jaxplore.networks import (
    ACTIVATIONS,
    INITIALIZERS,
    LOG_STD_MAPS,
    MLP,
    GaussianParams,
    TanhGaussianPolicy,
    apply,
    sample_tanh_gaussian,
    tanh_gaussian_of,
    tanh_mean,
)
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import Checks


@dataclass(frozen=True)
class SACConfig:
    """Settings of SAC. The defaults are the paper's for exploration."""

    hidden: tuple[int, ...] = (256, 256)
    """Hidden widths of every network. Paper: 256, 256."""
    activation: str = "leaky_relu"
    """nnaisense/max: leaky ReLU, slope 0.01."""
    init: str = "orthogonal"
    """Initialiser of every layer. nnaisense/max: orthogonal, gain 1."""
    layer_norm: bool = False
    """Whether hidden layers of the value networks are normalised (Ba et al. 2016): with many updates for each real step
    values of actions never taken are otherwise overestimated (Ball et al. 2023, arXiv 2302.02948). Paper: no."""
    lr: float = 1e-3
    """Adam's learning rate for all networks. Paper: 1e-3."""
    batch_size: int = 4096
    """Transitions per update. Paper: 4096."""
    alpha: float = 0.02
    """Weight of the entropy beside the reward. Paper: 0.02."""
    learn_alpha: bool = False
    """Whether the weight is learned, from `alpha` on, so that the entropy becomes `target_entropy` (Haarnoja et al.
    2018b, arXiv 1812.05905, equation 18). Paper: no."""
    target_entropy: float = -1.0
    """The entropy aimed at, nats per action entry. Haarnoja et al. (2018b): -1."""
    discount: float = 0.99
    """gamma per step. Paper: 0.99."""
    tau: float = 5e-3
    """Step of the slow value network towards the value network at each update. Paper: 5e-3."""
    reward_scale: float = 1.0
    """Factor on the reward. Paper: 1."""
    log_std_map: str = "tanh"
    """From the head of the policy's network to its log standard deviation: `tanh`, which is in the middle of the bounds
    where the head is 0, as at the start (nnaisense/max), or `clip`, which is then 0 (haarnoja/sac)."""
    log_std_min: float = -20.0
    """Lower end of the policy's log standard deviation. nnaisense/max: -20."""
    log_std_max: float = 2.0
    """Upper end. nnaisense/max: 2."""
    policy_penalty: float = 1e-3
    """Weight of mean(tanh(mean)^2) + mean(log_std^2) in the policy's loss. nnaisense/max: 1e-3."""
    grad_clip: float = 5.0
    """Bound on each entry of a gradient. nnaisense/max: 5."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.widths("hidden")
        checks.one_of("activation", ACTIVATIONS)
        checks.one_of("init", INITIALIZERS)
        checks.one_of("log_std_map", LOG_STD_MAPS)
        for field in ("lr", "reward_scale", "grad_clip"):
            checks.in_range(field, 0.0, open_low=True)
        checks.at_least("batch_size", 1)
        checks.in_range("alpha", 0.0, open_low=self.learn_alpha)
        checks.in_range("target_entropy", high=0.6931, open_low=True)
        checks.in_range("discount", 0.0, 1.0)
        checks.in_range("tau", 0.0, 1.0, open_low=True)
        checks.in_range("policy_penalty", 0.0)
        checks.in_range("log_std_max", high=10.0)
        checks.in_range("log_std_min", high=self.log_std_max)


@struct.dataclass
class SACState:
    """What SAC carries."""

    params: Params
    """`{"policy", "q", "v"}`; the leaves of `q` have a leading axis of 2. With `learn_alpha` also `"log_alpha"`."""
    target_v: Params
    """Slow copy of the value network."""
    opt_state: optax.OptState


class SACNetworks(NamedTuple):
    """The fixed parts of SAC, which its functions take first; `make_networks` builds them."""

    policy: TanhGaussianPolicy
    value: MLP
    """Architecture of the value network and, with the action as further inputs, of both action-value networks."""
    optimizer: optax.GradientTransformation
    """Of all parameters together."""
    config: SACConfig
    obs_size: int
    """`O`"""
    action_size: int
    """`A`"""


def make_networks(obs_size: int, action_size: int, config: SACConfig) -> SACNetworks:
    """The networks and the optimiser that `config` describes."""
    log_std_bounds = (config.log_std_min, config.log_std_max)
    form = (config.activation, config.init, log_std_bounds, config.log_std_map)
    policy = TanhGaussianPolicy(config.hidden, action_size, *form)
    value = MLP(config.hidden, 1, config.activation, config.init, config.init, config.layer_norm)
    optimizer = optax.chain(optax.clip(config.grad_clip), optax.adam(config.lr))
    return SACNetworks(policy, value, optimizer, config, obs_size, action_size)


def action_values(networks: SACNetworks, params: Params, obs: Array, action: Array) -> Array:
    """Both action values, `[2, ...]`, of `obs [..., O]` and `action [..., A]`; `params` are those of `q`."""
    # One after the other: under `vmap` XLA makes their first layers one product on CPUs, and turns what comes out.
    each = (jax.tree.map(lambda leaf, i=i: leaf[i], params) for i in range(2))
    return jnp.stack([apply(networks.value, one, obs, action)[..., 0] for one in each])


def state_value(networks: SACNetworks, params: Params, obs: Array) -> Array:
    """The value `[...]` of `obs [..., O]`; `params` are those of `v` or its slow copy."""
    return apply(networks.value, params, obs)[..., 0]


def init(networks: SACNetworks, key: Key) -> SACState:
    """A state with freshly initialised networks; see `Learner.init`."""
    policy_key, q_key, v_key = jax.random.split(key, 3)
    obs, inputs = jnp.zeros(networks.obs_size), jnp.zeros(networks.obs_size + networks.action_size)
    params = {
        "policy": networks.policy.init(policy_key, obs)["params"],
        "q": jax.vmap(lambda one: networks.value.init(one, inputs)["params"])(jax.random.split(q_key, 2)),
        "v": networks.value.init(v_key, obs)["params"],
    }
    if networks.config.learn_alpha:
        params["log_alpha"] = jnp.log(jnp.float32(networks.config.alpha))
    return SACState(params, jax.tree.map(jnp.copy, params["v"]), networks.optimizer.init(params))


def adopt(state: SACState, actor: Params) -> SACState:
    """The state with another's policy, and critics, their slow copy and the optimiser as they are."""
    return SACState({**state.params, "policy": actor}, state.target_v, state.opt_state)


def get_actor(state: SACState) -> Params:
    """The policy's parameters; see `Learner.actor`."""
    return state.params["policy"]


def act(networks: SACNetworks, key: Key, actor: Params, obs: Array) -> Array:
    """An action `[..., A]` drawn from the policy for `obs [..., O]`; see `Learner.act`."""
    return sample_tanh_gaussian(key, apply(networks.policy, actor, obs))[0]


def act_greedily(networks: SACNetworks, actor: Params, obs: Array) -> Array:
    """The squashed mean `[..., A]` of the policy for `obs [..., O]`; see `Learner.act_greedily`."""
    return tanh_mean(apply(networks.policy, actor, obs))


def noise(networks: SACNetworks, key: Key, num: int | None = None) -> Array:
    """What an update on `num` transitions (the configuration's batch by default) draws, `[num, A]`; see `Learner`."""
    return jax.random.normal(key, (num or networks.config.batch_size, networks.action_size))


class Drawn(NamedTuple):
    """Actions drawn from a policy."""

    gaussian: GaussianParams
    """What they were drawn from, before the squash, `[B, A]`."""
    action: Array
    """`[B, A]`"""
    log_prob: Array
    """`[B]`"""


def draw(networks: SACNetworks, policy: Params, noise: Array, obs: Array) -> Drawn:
    """What standard normal noise `[B, A]` makes of the policy with these parameters at `obs [B, O]`."""
    gaussian = apply(networks.policy, policy, obs)
    return Drawn(gaussian, *tanh_gaussian_of(noise, gaussian))


def loss(
    networks: SACNetworks,
    params: Params,
    drawn: Drawn,
    target_v: Params,
    batch: Transition,
    bonus: Array | None = None,
) -> tuple[Array, Metrics]:
    """Sum of the losses of all networks (Haarnoja et al. 2018, equations 5, 7 and 12), whose gradients do not mix.

    Args:
        networks: the fixed parts.
        params: `SACState.params`.
        drawn: actions of the policy in `params` at the batch's observations.
        target_v: parameters of the slow value network.
        batch: `[B, ...]`.
        bonus: what those actions are worth beside reward and entropy, `[B]`; the policy climbs its gradient. None:
            nothing.

    Returns:
        `(loss, metrics)`, scalars.
    """
    config = networks.config
    alpha = jnp.exp(jax.lax.stop_gradient(params["log_alpha"])) if config.learn_alpha else config.alpha
    gaussian, action, log_prob = drawn
    price = alpha * log_prob if bonus is None else alpha * log_prob - bonus
    # The networks share no parameters, so the gradient of the sum is each network's own.
    q_of_policy = jnp.min(action_values(networks, jax.lax.stop_gradient(params["q"]), batch.obs, action), axis=0)
    penalty = jnp.mean(tanh_mean(gaussian) ** 2) + jnp.mean(gaussian.log_std**2)
    policy_loss = jnp.mean(price - q_of_policy) + config.policy_penalty * penalty

    next_v = state_value(networks, target_v, batch.next_obs)
    q_target = config.reward_scale * batch.reward + config.discount * jnp.where(batch.terminated, 0.0, next_v)
    q = action_values(networks, params["q"], batch.obs, batch.action)
    q_loss = 0.5 * jnp.sum(jnp.mean((q - jax.lax.stop_gradient(q_target)[None]) ** 2, axis=1))
    v_target = jax.lax.stop_gradient(q_of_policy - price)
    v_loss = 0.5 * jnp.mean((state_value(networks, params["v"], batch.obs) - v_target) ** 2)
    metrics = {
        "q_loss": q_loss,
        "v_loss": v_loss,
        "policy_loss": policy_loss,
        "q": jnp.mean(q),
        "entropy": -jnp.mean(log_prob),
    }
    total = policy_loss + q_loss + v_loss
    if config.learn_alpha:
        surplus = -jnp.mean(jax.lax.stop_gradient(log_prob)) - config.target_entropy * networks.action_size
        total = total + params["log_alpha"] * surplus
    return total, metrics


def update(networks: SACNetworks, key: Key, state: SACState, batch: Transition) -> tuple[SACState, Metrics]:
    """One gradient step of every network on `batch [B, ...]`; see `Learner.update`."""
    return update_given(networks, noise(networks, key, batch.reward.shape[0]), state, batch)


def update_given(networks: SACNetworks, noise: Array, state: SACState, batch: Transition) -> tuple[SACState, Metrics]:
    """The same with its noise `[B, A]`; see `Learner.update_given`."""

    def objective(params: Params) -> tuple[Array, Metrics]:
        return loss(networks, params, draw(networks, params["policy"], noise, batch.obs), state.target_v, batch)

    gradient, metrics = jax.grad(objective, has_aux=True)(state.params)
    after, moved = step(networks, state, gradient)
    return after, {**metrics, **moved}


def step(networks: SACNetworks, state: SACState, gradient: Params) -> tuple[SACState, Metrics]:
    """The state one step down the gradient of its parameters, the slow network after it; with `learn_alpha` the metric
    is `alpha`.
    """
    steps, opt_state = networks.optimizer.update(gradient, state.opt_state, state.params)
    params: Params = optax.apply_updates(state.params, steps)
    target_v = optax.incremental_update(params["v"], state.target_v, networks.config.tau)
    metrics = {"alpha": jnp.exp(params["log_alpha"])} if networks.config.learn_alpha else {}
    return SACState(params, target_v, opt_state), metrics


def make_sac(obs_size: int, action_size: int, config: SACConfig | None = None) -> Learner:
    """Make the learner.

    Args:
        obs_size: `O`.
        action_size: `A`, each entry of an action in [-1, 1].
        config: the paper's exploration settings by default.

    Returns:
        A `Learner`. The metrics of `update` are `q_loss`, `v_loss`, `policy_loss`, `q` (mean value of the batch) and
        `entropy` (of the policy on the batch, nats); with `learn_alpha` also `alpha`, after the update.

    Raises:
        FieldError: a size below 1; when it is traced, observations or a batch of other shapes.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> sac = make_sac(3, 1, SACConfig(hidden=(32, 32), batch_size=8))
        >>> state = sac.init(jax.random.key(0))
        >>> obs, flag = jnp.ones((8, 3)), jnp.zeros(8, bool)
        >>> batch = Transition(obs, jnp.zeros((8, 1)), jnp.ones(8), obs, flag, flag)
        >>> state, metrics = jax.jit(sac.update)(jax.random.key(1), state, batch)
        >>> sac.act_greedily(sac.actor(state), obs[0]).shape
        (1,)
    """
    config = config or SACConfig()
    networks = make_networks(obs_size, action_size, config)
    learner = Learner(
        init=partial(init, networks),
        actor=get_actor,
        act=partial(act, networks),
        act_greedily=partial(act_greedily, networks),
        update=partial(update, networks),
        batch_size=config.batch_size,
        noise=partial(noise, networks),
        update_given=partial(update_given, networks),
        adopt=adopt,
    )
    return checked(learner, obs_size, action_size)
