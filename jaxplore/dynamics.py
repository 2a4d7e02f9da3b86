"""The dynamics model: what goes into a network, what comes out, and in which units.

A network sees the observation and the action, each entry in standard deviations from its mean, and predicts the
*change* of the observation in standard deviations of that change ("normalised delta"). Losses, variances and
intrinsic rewards are in these units unless something says otherwise.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from flax import struct

from jaxplore import normalizer
from jaxplore.networks import ACTIVATIONS, MLP
from jaxplore.normalizer import Normalizer
from jaxplore.types import Array, Transition
from jaxplore.validate import Checks


@dataclass(frozen=True)
class DynamicsConfig:
    """Shape of one dynamics network."""

    hidden: tuple[int, ...] = (512, 512, 512, 512)
    """Widths of the hidden layers. Paper: 4 x 512."""
    activation: str = "relu"
    """Paper: ReLU for all methods but MAX, which has swish."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.widths("hidden")
        checks.one_of("activation", ACTIVATIONS)


class Prediction(NamedTuple):
    """What m networks say of the same transitions, in normalised-delta units."""

    mean: Array
    """`[M, N, O]`"""
    var: Array | None = None
    """Variance that a Gaussian network states, `[M, N, O]`; None for deterministic networks."""


@struct.dataclass
class Normalizers:
    """Statistics of all real transitions so far."""

    obs: Normalizer
    action: Normalizer
    delta: Normalizer
    """Of `next_obs - obs`."""


def make_network(config: DynamicsConfig, obs_size: int) -> MLP:
    """One deterministic dynamics network, `[..., O + A] -> [..., O]`, He and LeCun initialised.

    Example:
        One step of a network on its own, from raw observations to raw observations:

        >>> import jax, jax.numpy as jnp
        >>> network = make_network(DynamicsConfig(hidden=(16,)), obs_size=3)
        >>> params = network.init(jax.random.key(0), jnp.zeros(4))["params"]
        >>> obs, action, normalizers = jnp.ones((7, 3)), jnp.zeros((7, 1)), init_normalizers(3, 1)
        >>> delta = network.apply({"params": params}, model_inputs(normalizers, obs, action))
        >>> apply_delta(normalizers, obs, delta).shape
        (7, 3)
    """
    return MLP(config.hidden, obs_size, config.activation, "he", "lecun")


def init_normalizers(obs_size: int, action_size: int) -> Normalizers:
    """Statistics of no transitions: identity."""
    return Normalizers(normalizer.init(obs_size), normalizer.init(action_size), normalizer.init(obs_size))


def update_normalizers(state: Normalizers, transitions: Transition, valid: Array) -> Normalizers:
    """Take the transitions `[B, ...]` in where `valid [B]` is set."""
    weights = valid.astype(jnp.float32)
    return Normalizers(
        obs=normalizer.update(state.obs, transitions.obs, weights),
        action=normalizer.update(state.action, transitions.action, weights),
        delta=normalizer.update(state.delta, transitions.next_obs - transitions.obs, weights),
    )


def model_inputs(state: Normalizers, obs: Array, action: Array) -> Array:
    """What a network sees: `obs [..., O]`, `action [..., A]` -> `[..., O + A]`, normalised."""
    return jnp.concatenate([normalizer.normalize(state.obs, obs), normalizer.normalize(state.action, action)], axis=-1)


def model_targets(state: Normalizers, obs: Array, next_obs: Array) -> Array:
    """What a network should say: the normalised delta, `[..., O]`."""
    return normalizer.normalize(state.delta, next_obs - obs)


def apply_delta(state: Normalizers, obs: Array, delta: Array) -> Array:
    """The next observation `[..., O]`, in raw units, that a normalised delta leads to."""
    return obs + normalizer.denormalize(state.delta, delta)
