"""SAC whose policy also seeks information: what its actions would tell is worth something beside reward and entropy.

MaxInfoSAC of Sukhija et al. (2024), arXiv 2412.12098. Two weights are learned, the entropy's and the information's: the
latter grows while the policy gains less information than a slow copy of itself, and shrinks while it gains more. The
defaults are those of the authors' code, sukhijab/maxinforl_jax and maxinforl_torch. What information is, the caller
says. Theirs has no value network; here what the policy's actions would tell enters the value of a state, as entropy
does.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore import normalizer
from jaxplore.learners import sac
from jaxplore.learners.base import Learner, checked
from jaxplore.learners.sac import SACConfig, SACNetworks, SACState
from jaxplore.normalizer import Normalizer
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import Checks

Gain: TypeAlias = Callable[[Array, Array], Array]
"""`gain(obs [N, O], action [N, A]) -> [N]`: what an action would tell, differentiable in it. Observations are as the
learner sees them."""

MEMORY = 1e6
"""Information gains that their running statistics remember; the authors' code: a million."""


@dataclass(frozen=True)
class InformationConfig:
    """Settings of a policy that seeks information beside a task. The defaults are those of Sukhija et al.'s code."""

    weight: float = 1.0
    """Weight of the information beside the reward, at the start if it is learned. Sukhija et al.: 1."""
    learn_weight: bool = True
    """Whether it is learned, at SAC's rate, so that the policy gains as much information as its slow copy. Sukhija et
    al.: yes."""
    normalize: bool = True
    """Whether gains are counted in their standard deviations from their mean, of the last million that were computed.
    Sukhija et al.: yes."""
    noise_std: float = 1e-3
    """Standard deviation of the noise that gains are relative to, per entry of a prediction, where models state none.
    Sukhija et al.: 1e-3."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.in_range("weight", 0.0, open_low=self.learn_weight)
        checks.in_range("noise_std", 0.0, open_low=True)


@struct.dataclass
class MaxInfoState:
    """What the learner carries."""

    sac: SACState
    """With `learn_weight` its `params` also have `"log_information_weight"`."""
    slow_policy: Params
    """Slow copy of the policy, with the slow value network's step."""
    gains: Normalizer
    """Of the information gains so far, `[1]`."""


class MaxInfo(NamedTuple):
    """The fixed parts of the learner, which its functions take first."""

    networks: SACNetworks
    gain: Gain
    config: InformationConfig


def init(parts: MaxInfo, key: Key) -> MaxInfoState:
    """A state with freshly initialised networks; see `Learner.init`."""
    first = sac.init(parts.networks, key)
    if parts.config.learn_weight:
        params = {**first.params, "log_information_weight": jnp.log(jnp.float32(parts.config.weight))}
        first = SACState(params, first.target_v, parts.networks.optimizer.init(params))
    return MaxInfoState(first, jax.tree.map(jnp.copy, first.params["policy"]), normalizer.init(1))


def adopt(state: MaxInfoState, actor: Params) -> MaxInfoState:
    """The state with another's policy, which its slow copy starts from, too; see `sac.adopt`."""
    return replace(state, sac=sac.adopt(state.sac, actor), slow_policy=jax.tree.map(jnp.copy, actor))


class Noise(NamedTuple):
    """What an update draws, standard normal, each `[B, A]`."""

    policy: Array
    slow_policy: Array


def noise(parts: MaxInfo, key: Key, num: int | None = None) -> Noise:
    """What an update on `num` transitions draws, for the policy the same as SAC's; see `Learner.noise`."""
    slow_key = jax.random.fold_in(key, 1)
    return Noise(sac.noise(parts.networks, key, num), sac.noise(parts.networks, slow_key, num))


def remember(state: Normalizer, gains: Array) -> Normalizer:
    """Statistics with the gains `[N]` taken in, as if no more than `MEMORY` had come."""
    after = normalizer.update(state, gains[:, None])
    count = jnp.minimum(after.count, MEMORY)
    return replace(after, count=count, sum_squares=after.sum_squares * count / after.count)


def loss(
    parts: MaxInfo, params: Params, noise: Noise, state: MaxInfoState, batch: Transition
) -> tuple[Array, tuple[Metrics, Normalizer]]:
    """SAC's loss with the information that the policy's actions give, and that of the information's weight.

    Args:
        parts: the fixed parts.
        params: as `MaxInfoState.sac.params`.
        noise: of the policy's and its slow copy's actions.
        state: the rest of the state.
        batch: `[B, ...]`.

    Returns:
        `(loss, (metrics, statistics of gains with this batch's))`.
    """
    networks, config = parts.networks, parts.config
    drawn = sac.draw(networks, params["policy"], noise.policy, batch.obs)
    slow = sac.draw(networks, state.slow_policy, noise.slow_policy, batch.obs)
    twice = jnp.concatenate([batch.obs, batch.obs])
    gains = parts.gain(twice, jnp.concatenate([drawn.action, slow.action]))
    statistics = remember(state.gains, jax.lax.stop_gradient(gains))
    units = gains
    if config.normalize:
        units = normalizer.normalize(statistics, gains[:, None], limit=None)[:, 0]
    own, of_slow = jnp.split(units, 2)
    weight = jnp.float32(config.weight)
    if config.learn_weight:
        weight = jnp.exp(jax.lax.stop_gradient(params["log_information_weight"]))
    total, metrics = sac.loss(networks, params, drawn, state.sac.target_v, batch, weight * own)
    if config.learn_weight:
        surplus = jax.lax.stop_gradient(jnp.mean(own) - jnp.mean(of_slow))
        total = total + params["log_information_weight"] * surplus
    means = [jnp.mean(half) for half in jnp.split(gains, 2)]
    return total, ({**metrics, "information": means[0], "slow_information": means[1]}, statistics)


def update(parts: MaxInfo, key: Key, state: MaxInfoState, batch: Transition) -> tuple[MaxInfoState, Metrics]:
    """One gradient step of every network on `batch [B, ...]`; see `Learner.update`."""
    return update_given(parts, noise(parts, key, batch.reward.shape[0]), state, batch)


def update_given(parts: MaxInfo, noise: Noise, state: MaxInfoState, batch: Transition) -> tuple[MaxInfoState, Metrics]:
    """The same with its noise; see `Learner.update_given`."""

    def objective(params: Params) -> tuple[Array, tuple[Metrics, Normalizer]]:
        return loss(parts, params, noise, state, batch)

    gradient, (metrics, statistics) = jax.grad(objective, has_aux=True)(state.sac.params)
    after, moved = sac.step(parts.networks, state.sac, gradient)
    slow_policy = optax.incremental_update(after.params["policy"], state.slow_policy, parts.networks.config.tau)
    if parts.config.learn_weight:
        moved = {**moved, "information_weight": jnp.exp(after.params["log_information_weight"])}
    return MaxInfoState(after, slow_policy, statistics), {**metrics, **moved}


def make_maxinfo_sac(
    obs_size: int,
    action_size: int,
    gain: Gain,
    config: SACConfig | None = None,
    information: InformationConfig | None = None,
) -> Learner:
    """Make the learner.

    Args:
        obs_size: `O`.
        action_size: `A`, each entry of an action in [-1, 1].
        gain: what the policy seeks beside the reward. Learners that differ in it alone can take turns on one state.
        config: of SAC; the paper's exploration settings by default.
        information: how much of it.

    Returns:
        A `Learner`. The metrics are those of `make_sac` and `information`, `slow_information` (mean gain of the
        policy's actions and of its slow copy's, in the gain's own unit); where it is learned `information_weight`,
        after the update.

    Raises:
        FieldError: a size below 1; when it is traced, observations or a batch of other shapes.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> to_the_right = lambda obs, action: action[:, 0]
        >>> learner = make_maxinfo_sac(3, 1, to_the_right, SACConfig(hidden=(32, 32), batch_size=8))
        >>> state = learner.init(jax.random.key(0))
        >>> obs, flag = jnp.ones((8, 3)), jnp.zeros(8, bool)
        >>> batch = Transition(obs, jnp.zeros((8, 1)), jnp.ones(8), obs, flag, flag)
        >>> state, metrics = jax.jit(learner.update)(jax.random.key(1), state, batch)
        >>> learner.act_greedily(learner.actor(state), obs[0]).shape
        (1,)
    """
    config = config or SACConfig()
    networks = sac.make_networks(obs_size, action_size, config)
    parts = MaxInfo(networks, gain, information or InformationConfig())
    learner = Learner(
        init=partial(init, parts),
        actor=lambda state: sac.get_actor(state.sac),
        act=partial(sac.act, networks),
        act_greedily=partial(sac.act_greedily, networks),
        update=partial(update, parts),
        batch_size=config.batch_size,
        noise=partial(noise, parts),
        update_given=partial(update_given, parts),
        adopt=adopt,
    )
    return checked(learner, obs_size, action_size)
