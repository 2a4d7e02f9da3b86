"""Deep deterministic policy gradient with adaptive noise in the policy's parameters.

Lillicrap et al. (2016), arXiv 1509.02971; the noise after Plappert et al. (2018), arXiv 1706.01905 ("PSNE" in Ratzlaff
et al. 2020, who ran openai/baselines). The policy that acts is a copy with Gaussian noise on its parameters. How much
is set by what it does to actions: the standard deviation grows or shrinks until the actions of perturbed and
unperturbed policy are `target_distance` apart. Pure functions; the caller normalises observations.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore.learners.base import Learner, checked
from jaxplore.networks import ACTIVATIONS, INITIALIZERS, MLP, apply
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import Checks


@dataclass(frozen=True)
class DDPGConfig:
    """Settings of DDPG and of its noise. The defaults are openai/baselines', but for layer normalisation and ReLU."""

    hidden: tuple[int, ...] = (64, 64)
    """Hidden widths of both networks. openai/baselines: 64, 64."""
    activation: str = "relu"
    """Plappert et al. (2018): ReLU. openai/baselines' default: `tanh`, without layer normalisation."""
    layer_norm: bool = True
    """Whether hidden layers are normalised before the activation, so that the same noise means the same to all layers.
    Plappert et al. (2018): yes. openai/baselines' default: no."""
    init: str = "orthogonal_relu"
    """Initialiser of the hidden layers; the last ones start within 0.003."""
    actor_lr: float = 1e-4
    """Adam's learning rate for the policy."""
    critic_lr: float = 1e-3
    """Adam's learning rate for the action value."""
    critic_l2: float = 1e-2
    """Weight of half the sum of the action value's squared hidden kernels."""
    batch_size: int = 64
    """Transitions per update."""
    discount: float = 0.99
    """gamma per step."""
    tau: float = 0.01
    """Step of the slow networks towards the networks at each update."""
    reward_scale: float = 1.0
    """Factor on the reward."""
    obs_clip: float = 5.0
    """Bound on each entry of an observation, as it is given. 0: none."""
    noise_std: float = 0.2
    """Standard deviation of the noise on each parameter at the start. 0: no noise, ever."""
    target_distance: float = 0.2
    """Root mean square difference between perturbed and unperturbed actions that the noise is adapted to."""
    adapt_factor: float = 1.01
    """What the standard deviation is multiplied with, or divided by, at each adaptation."""
    adapt_every: int = 50
    """Updates between two adaptations."""
    redraw_every: int = 100
    """Updates between two perturbed policies to act with; about one to a step. openai/baselines: 100 steps."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.widths("hidden")
        checks.one_of("activation", ACTIVATIONS)
        checks.one_of("init", INITIALIZERS)
        for field in ("actor_lr", "critic_lr", "reward_scale", "target_distance"):
            checks.in_range(field, 0.0, open_low=True)
        for field in ("critic_l2", "obs_clip", "noise_std"):
            checks.in_range(field, 0.0)
        checks.in_range("adapt_factor", 1.0)
        checks.in_range("discount", 0.0, 1.0)
        checks.in_range("tau", 0.0, 1.0, open_low=True)
        for field in ("batch_size", "adapt_every", "redraw_every"):
            checks.at_least(field, 1)


@struct.dataclass
class DDPGState:
    """What DDPG carries."""

    params: Params
    """`{"actor", "critic"}`."""
    target: Params
    """Slow copies of both."""
    perturbed: Params
    """The policy that acts."""
    actor_opt_state: optax.OptState
    critic_opt_state: optax.OptState
    noise_std: Array
    num_updates: Array
    """Updates so far, int32."""


@struct.dataclass
class DDPGActor:
    """What acting needs."""

    params: Params
    """Of the policy without noise."""
    perturbed: Params
    """Of the policy that acts."""


class DDPGNetworks(NamedTuple):
    """The fixed parts of DDPG, which its functions take first; `make_networks` builds them."""

    policy: MLP
    """Without the squash, `[..., O] -> [..., A]`."""
    value: MLP
    """`[..., O + A] -> [..., 1]`."""
    actor_optimizer: optax.GradientTransformation
    critic_optimizer: optax.GradientTransformation
    config: DDPGConfig
    obs_size: int
    """`O`"""
    action_size: int
    """`A`"""


def make_networks(obs_size: int, action_size: int, config: DDPGConfig) -> DDPGNetworks:
    """The networks and the optimisers that `config` describes."""
    shape = (config.activation, config.init, "small_uniform", config.layer_norm)
    policy, value = MLP(config.hidden, action_size, *shape), MLP(config.hidden, 1, *shape)
    actor_optimizer, critic_optimizer = optax.adam(config.actor_lr), optax.adam(config.critic_lr)
    return DDPGNetworks(policy, value, actor_optimizer, critic_optimizer, config, obs_size, action_size)


def perturb(key: Key, params: Params, std: Array) -> Params:
    """Parameters with N(0, std^2) on each, but for those of layer normalisation, which stay as they are.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> params = {"hidden_0": {"bias": jnp.zeros(3)}, "norm_0": {"bias": jnp.zeros(3)}}
        >>> noisy = perturb(jax.random.key(0), params, jnp.float32(0.1))
        >>> bool((noisy["hidden_0"]["bias"] != 0).all()), bool((noisy["norm_0"]["bias"] == 0).all())
        (True, True)
    """
    leaves, tree = jax.tree.flatten_with_path(params)
    keys = jax.random.split(key, len(leaves))
    noisy = [
        leaf if "norm_" in jax.tree_util.keystr(path) else leaf + std * jax.random.normal(keys[i], leaf.shape)
        for i, (path, leaf) in enumerate(leaves)
    ]
    return jax.tree.unflatten(tree, noisy)


def _clip(config: DDPGConfig, obs: Array) -> Array:
    return jnp.clip(obs, -config.obs_clip, config.obs_clip) if config.obs_clip else obs


def policy_action(networks: DDPGNetworks, params: Params, obs: Array) -> Array:
    """The action `[..., A]` of a policy, perturbed or not, for `obs [..., O]`."""
    return jnp.tanh(apply(networks.policy, params, _clip(networks.config, obs)))


def action_value(networks: DDPGNetworks, params: Params, obs: Array, action: Array) -> Array:
    """The value `[...]` of `action [..., A]` at `obs [..., O]`."""
    return apply(networks.value, params, _clip(networks.config, obs), action)[..., 0]


def init(networks: DDPGNetworks, key: Key) -> DDPGState:
    """A state with freshly initialised networks; see `Learner.init`."""
    actor_key, critic_key, noise_key = jax.random.split(key, 3)
    inputs_size = networks.obs_size + networks.action_size
    params = {
        "actor": networks.policy.init(actor_key, jnp.zeros(networks.obs_size))["params"],
        "critic": networks.value.init(critic_key, jnp.zeros(inputs_size))["params"],
    }
    std = jnp.float32(networks.config.noise_std)
    return DDPGState(
        params,
        jax.tree.map(jnp.copy, params),
        perturb(noise_key, params["actor"], std),
        networks.actor_optimizer.init(params["actor"]),
        networks.critic_optimizer.init(params["critic"]),
        std,
        jnp.zeros((), jnp.int32),
    )


def get_actor(state: DDPGState) -> DDPGActor:
    """The parameters of both policies; see `Learner.actor`."""
    return DDPGActor(state.params["actor"], state.perturbed)


def act(networks: DDPGNetworks, key: Key, actor: DDPGActor, obs: Array) -> Array:
    """The perturbed policy's action `[..., A]` for `obs [..., O]`, which needs no key; see `Learner.act`."""
    return policy_action(networks, actor.perturbed, obs)


def act_greedily(networks: DDPGNetworks, actor: DDPGActor, obs: Array) -> Array:
    """The unperturbed policy's action `[..., A]` for `obs [..., O]`; see `Learner.act_greedily`."""
    return policy_action(networks, actor.params, obs)


def critic_loss(
    networks: DDPGNetworks, critic: Params, batch: Transition, q_target: Array
) -> tuple[Array, tuple[Array, Array]]:
    """Squared error of the action value against `q_target [B]`, with the penalty on its hidden kernels.

    Returns:
        `(loss, (error, q))`: the error is without the penalty, `q` the mean value of the batch; all scalars.
    """
    q = action_value(networks, critic, batch.obs, batch.action)
    error = jnp.mean((q - q_target) ** 2)
    kernels = [layer["kernel"] for name, layer in critic.items() if name.startswith("hidden_")]
    penalty = 0.5 * networks.config.critic_l2 * sum(jnp.sum(kernel**2) for kernel in kernels)
    return error + penalty, (error, jnp.mean(q))


def actor_loss(networks: DDPGNetworks, actor: Params, critic: Params, obs: Array) -> Array:
    """Minus the mean value, under `critic`, of the policy's actions at `obs [B, O]`: a scalar."""
    return -jnp.mean(action_value(networks, critic, obs, policy_action(networks, actor, obs)))


def adapt_noise(
    networks: DDPGNetworks, key: Key, actor: Params, noise_std: Array, obs: Array, num_updates: Array
) -> tuple[Array, Array]:
    """Adapt the parameter noise to its effect on actions (Plappert et al. 2018, section 3, "Adaptive noise scaling").

    Args:
        networks: the fixed parts.
        key: of the perturbed policy that the effect is measured with.
        actor: parameters of the policy without noise.
        noise_std: standard deviation of the noise so far, a scalar.
        obs: where the effect is measured, `[B, O]`.
        num_updates: updates so far, this one included; only each `adapt_every`-th changes the noise.

    Returns:
        `(noise_std, distance)`: the new standard deviation, and the root mean square difference between perturbed and
        unperturbed actions under the old one.
    """
    config = networks.config
    measured = policy_action(networks, perturb(key, actor, noise_std), obs)
    distance = jnp.sqrt(jnp.mean((measured - policy_action(networks, actor, obs)) ** 2))
    change = jnp.where(distance > config.target_distance, 1.0 / config.adapt_factor, config.adapt_factor)
    return noise_std * jnp.where(num_updates % config.adapt_every == 0, change, 1.0), distance


def update(networks: DDPGNetworks, key: Key, state: DDPGState, batch: Transition) -> tuple[DDPGState, Metrics]:
    """One gradient step of both networks on `batch [B, ...]`; see `Learner.update`."""
    config = networks.config
    measure_key, redraw_key = jax.random.split(key)
    params, target = state.params, state.target
    next_action = policy_action(networks, target["actor"], batch.next_obs)
    next_q = action_value(networks, target["critic"], batch.next_obs, next_action)
    q_target = config.reward_scale * batch.reward + config.discount * jnp.where(batch.terminated, 0.0, next_q)
    critic_gradient, (q_loss, q) = jax.grad(partial(critic_loss, networks), has_aux=True)(
        params["critic"], batch, q_target
    )
    policy_loss, actor_gradient = jax.value_and_grad(partial(actor_loss, networks))(
        params["actor"], params["critic"], batch.obs
    )
    actor_steps, actor_opt_state = networks.actor_optimizer.update(actor_gradient, state.actor_opt_state)
    critic_steps, critic_opt_state = networks.critic_optimizer.update(critic_gradient, state.critic_opt_state)
    params = {
        "actor": optax.apply_updates(params["actor"], actor_steps),
        "critic": optax.apply_updates(params["critic"], critic_steps),
    }
    num_updates = state.num_updates + 1

    noise_std, distance = adapt_noise(networks, measure_key, params["actor"], state.noise_std, batch.obs, num_updates)
    redrawn, is_due = perturb(redraw_key, params["actor"], noise_std), num_updates % config.redraw_every == 0
    after = DDPGState(
        params,
        optax.incremental_update(params, target, config.tau),
        jax.tree.map(lambda new, old: jnp.where(is_due, new, old), redrawn, state.perturbed),
        actor_opt_state,
        critic_opt_state,
        noise_std,
        num_updates,
    )
    return after, {
        "q_loss": q_loss,
        "policy_loss": policy_loss,
        "q": q,
        "noise_std": noise_std,
        "distance": distance,
    }


def make_ddpg(obs_size: int, action_size: int, config: DDPGConfig | None = None) -> Learner:
    """Make the learner.

    Args:
        obs_size: `O`.
        action_size: `A`, each entry of an action in [-1, 1].
        config: openai/baselines' settings, with layer normalisation, by default.

    Returns:
        A `Learner`; `act` is the perturbed policy's action, without noise of its own. The metrics of `update` are
        `q_loss` (mean squared error, without the penalty), `policy_loss`, `q` (mean value of the batch), `noise_std`
        (after the update) and `distance` (between a perturbed policy's actions and the policy's, on the batch).

    Raises:
        FieldError: a size below 1; when it is traced, observations or a batch of other shapes.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> ddpg = make_ddpg(3, 1, DDPGConfig(hidden=(32, 32), batch_size=8))
        >>> state = ddpg.init(jax.random.key(0))
        >>> obs, flag = jnp.ones((8, 3)), jnp.zeros(8, bool)
        >>> batch = Transition(obs, jnp.zeros((8, 1)), jnp.ones(8), obs, flag, flag)
        >>> state, metrics = jax.jit(ddpg.update)(jax.random.key(1), state, batch)
        >>> ddpg.act(jax.random.key(2), ddpg.actor(state), obs[0]).shape
        (1,)
    """
    config = config or DDPGConfig()
    networks = make_networks(obs_size, action_size, config)
    learner = Learner(
        init=partial(init, networks),
        actor=get_actor,
        act=partial(act, networks),
        act_greedily=partial(act_greedily, networks),
        update=partial(update, networks),
        batch_size=config.batch_size,
    )
    return checked(learner, obs_size, action_size)
