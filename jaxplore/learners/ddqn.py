"""Double deep Q-learning with epsilon-greedy actions: the paper's baseline on the chain.

van Hasselt et al. (2016), arXiv 1509.06461: the online network chooses the action of the next state, its frozen copy
evaluates that action. Ratzlaff et al. (2020) give no settings; the network is that of their chain's dynamics
models, the rest after openai/baselines' `deepq`. Pure functions.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore import validate
from jaxplore.learners.base import Learner, checked
from jaxplore.networks import ACTIVATIONS, INITIALIZERS, MLP, apply
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import Checks


@dataclass(frozen=True)
class DDQNConfig:
    """Settings of double DQN. The defaults are for a chain of 40 states with episodes of 49 steps."""

    hidden: tuple[int, ...] = (256, 256)
    """Hidden widths of the network. Paper, of the chain's dynamics models: 256."""
    activation: str = "tanh"
    """Paper, of the chain's dynamics models: tanh."""
    init: str = "lecun"
    """Initialiser of every layer."""
    lr: float = 1e-4
    """Adam's learning rate. Paper, of the chain's dynamics models: 1e-4. openai/baselines: 5e-4."""
    batch_size: int = 32
    """Transitions per update. openai/baselines: 32."""
    discount: float = 0.99
    """gamma per step."""
    target_every: int = 100
    """Updates between two copies of the network to the frozen one. openai/baselines: 500."""
    epsilon_start: float = 1.0
    """Share of random actions before the first step."""
    epsilon_end: float = 0.1
    """Share of random actions from `epsilon_steps` on. Set both to the same number for a constant share."""
    epsilon_steps: int = 490
    """Steps over which the share falls linearly: 10 episodes of the chain."""
    epsilon_offset: int = 147
    """Steps taken before the first update, 3 episodes of the chain; each update counts as one more step."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.widths("hidden")
        checks.one_of("activation", ACTIVATIONS)
        checks.one_of("init", INITIALIZERS)
        checks.in_range("lr", 0.0, open_low=True)
        for field in ("discount", "epsilon_start", "epsilon_end"):
            checks.in_range(field, 0.0, 1.0)
        for field in ("batch_size", "target_every", "epsilon_steps"):
            checks.at_least(field, 1)
        checks.at_least("epsilon_offset", 0)


@struct.dataclass
class DDQNState:
    """What double DQN carries."""

    params: Params
    """Of the online network."""
    target: Params
    """Of its frozen copy."""
    opt_state: optax.OptState
    num_updates: Array
    """Updates so far, int32."""


@struct.dataclass
class DDQNActor:
    """What acting needs."""

    params: Params
    epsilon: Array
    """Share of random actions, 0 to 1."""


class DDQNNetworks(NamedTuple):
    """The fixed parts of double DQN, which its functions take first; `make_networks` builds them."""

    value: MLP
    """Of the values of all actions, `[..., O] -> [..., A]`."""
    optimizer: optax.GradientTransformation
    config: DDQNConfig
    obs_size: int
    """`O`"""
    num_actions: int
    """`A`"""


def make_networks(obs_size: int, num_actions: int, config: DDQNConfig) -> DDQNNetworks:
    """The network and the optimiser that `config` describes.

    Raises:
        ValueError: `num_actions` is below 2.
    """
    validate.at_least("num_actions", num_actions, 2)
    value = MLP(config.hidden, num_actions, config.activation, config.init, config.init)
    return DDQNNetworks(value, optax.adam(config.lr), config, obs_size, num_actions)


def init(networks: DDQNNetworks, key: Key) -> DDQNState:
    """A state with a freshly initialised network; see `Learner.init`."""
    params = networks.value.init(key, jnp.zeros(networks.obs_size))["params"]
    target = jax.tree.map(jnp.copy, params)
    return DDQNState(params, target, networks.optimizer.init(params), jnp.zeros((), jnp.int32))


def epsilon(config: DDQNConfig, num_updates: Array) -> Array:
    """Share of random actions after `num_updates` updates, a scalar.

    Example:
        >>> import jax.numpy as jnp
        >>> config = DDQNConfig(epsilon_start=1.0, epsilon_end=0.0, epsilon_steps=10, epsilon_offset=0)
        >>> float(epsilon(config, jnp.int32(5)))
        0.5
    """
    progress = jnp.minimum((config.epsilon_offset + num_updates) / config.epsilon_steps, 1.0)
    return config.epsilon_start + (config.epsilon_end - config.epsilon_start) * progress


def get_actor(networks: DDQNNetworks, state: DDQNState) -> DDQNActor:
    """The network's parameters and the share of random actions; see `Learner.actor`."""
    return DDQNActor(state.params, epsilon(networks.config, state.num_updates))


def act_greedily(networks: DDQNNetworks, actor: DDQNActor, obs: Array) -> Array:
    """The action of the largest value, one-hot `[..., A]`, for `obs [..., O]`; see `Learner.act_greedily`."""
    return jax.nn.one_hot(jnp.argmax(apply(networks.value, actor.params, obs), axis=-1), networks.num_actions)


def act(networks: DDQNNetworks, key: Key, actor: DDQNActor, obs: Array) -> Array:
    """An epsilon-greedy action, one-hot `[..., A]`, for `obs [..., O]`; see `Learner.act`."""
    coin_key, choice_key = jax.random.split(key)
    shape, num_actions = obs.shape[:-1], networks.num_actions
    choice = jax.nn.one_hot(jax.random.randint(choice_key, shape, 0, num_actions), num_actions)
    is_random = jax.random.bernoulli(coin_key, actor.epsilon, shape)
    return jnp.where(is_random[..., None], choice, act_greedily(networks, actor, obs))


def loss(networks: DDQNNetworks, params: Params, target: Params, batch: Transition) -> tuple[Array, Array]:
    """Huber's loss of the action values on `batch [B, ...]` against double DQN's targets (van Hasselt et al. 2016).

    Returns:
        `(loss, mean value of the batch's actions)`, scalars.
    """
    best = jnp.argmax(apply(networks.value, params, batch.next_obs), axis=-1)
    next_value = _pick(apply(networks.value, target, batch.next_obs), best)
    q_target = batch.reward + networks.config.discount * jnp.where(batch.terminated, 0.0, next_value)
    q = _pick(apply(networks.value, params, batch.obs), jnp.argmax(batch.action, axis=-1))
    return jnp.mean(optax.huber_loss(q, jax.lax.stop_gradient(q_target))), jnp.mean(q)


def _pick(values: Array, choice: Array) -> Array:
    """Entry `choice [B]` of each row of `values [B, A]`."""
    return jnp.take_along_axis(values, choice[:, None], axis=1)[:, 0]


def update(networks: DDQNNetworks, key: Key, state: DDQNState, batch: Transition) -> tuple[DDQNState, Metrics]:
    """One gradient step on `batch [B, ...]`, without randomness; see `Learner.update`."""
    config = networks.config
    compute = jax.value_and_grad(partial(loss, networks), has_aux=True)
    (q_loss, q), gradient = compute(state.params, state.target, batch)
    steps, opt_state = networks.optimizer.update(gradient, state.opt_state, state.params)
    params: Params = optax.apply_updates(state.params, steps)
    num_updates = state.num_updates + 1
    is_due = num_updates % config.target_every == 0
    target = jax.tree.map(lambda new, old: jnp.where(is_due, new, old), params, state.target)
    metrics = {"q_loss": q_loss, "q": q, "epsilon": epsilon(config, num_updates)}
    return DDQNState(params, target, opt_state, num_updates), metrics


def make_ddqn(obs_size: int, num_actions: int, config: DDQNConfig | None = None) -> Learner:
    """Make the learner.

    Args:
        obs_size: `O`.
        num_actions: `A`. An action is one of them, as a one-hot vector `[A]`; of an action in a batch the largest entry
            counts.
        config: settings for the chain by default.

    Returns:
        A `Learner`. The metrics of `update` are `q_loss` (Huber's, with its bend at 1), `q` (mean value of the batch's
        actions) and `epsilon` (the share of random actions after the update).

    Raises:
        FieldError: `num_actions` below 2 or `obs_size` below 1; when it is traced, observations or a batch of other
            shapes.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> ddqn = make_ddqn(3, 2, DDQNConfig(hidden=(32,), batch_size=8))
        >>> state = ddqn.init(jax.random.key(0))
        >>> obs, flag = jnp.ones((8, 3)), jnp.zeros(8, bool)
        >>> batch = Transition(obs, jax.nn.one_hot(jnp.arange(8) % 2, 2), jnp.ones(8), obs, flag, flag)
        >>> state, metrics = jax.jit(ddqn.update)(jax.random.key(1), state, batch)
        >>> ddqn.act(jax.random.key(2), ddqn.actor(state), obs).shape
        (8, 2)
    """
    config = config or DDQNConfig()
    networks = make_networks(obs_size, num_actions, config)
    learner = Learner(
        init=partial(init, networks),
        actor=partial(get_actor, networks),
        act=partial(act, networks),
        act_greedily=partial(act_greedily, networks),
        update=partial(update, networks),
        batch_size=config.batch_size,
    )
    return checked(learner, obs_size, num_actions)
