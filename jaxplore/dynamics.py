"""The dynamics model: what goes into a network, what comes out, and in which units.

A network sees the observation and the action, each entry in standard deviations from its mean, and predicts the
*change* of the observation in standard deviations of that change ("normalised delta"). Losses, variances and
intrinsic rewards are in these units unless something says otherwise.

Where observations are one of finitely many states, a network may see them as they are and predict the probability of
each state instead. Which of the two it is, is an `Encoding`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, get_args

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import normalizer, validate
from jaxplore.networks import ACTIVATIONS, MLP
from jaxplore.normalizer import Normalizer
from jaxplore.types import Array, Transition
from jaxplore.validate import Checks

Target: TypeAlias = Literal["delta", "one_hot"]

LOG_VAR_BOUNDS = (-5.0, -1.0)
"""Within which a Gaussian network states the log of its variance, in normalised-delta units. nnaisense/max: -5, -1."""


@dataclass(frozen=True)
class DynamicsConfig:
    """Shape of one dynamics network, and what it predicts."""

    hidden: tuple[int, ...] = (512, 512, 512, 512)
    """Widths of the hidden layers. Paper: 4 x 512."""
    activation: str = "relu"
    """Paper: ReLU for all methods but MAX, which has swish."""
    target: Target = "delta"
    """`delta`: the normalised change of the observation. `one_hot`: the probability of each next state, for one-hot
    observations; paper: the chain."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.one_of("target", get_args(Target))
        checks.widths("hidden")
        checks.one_of("activation", ACTIVATIONS)


class Prediction(NamedTuple):
    """What m networks say of the same transitions: normalised deltas, or probabilities of each next state."""

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
    # A choice that was never taken is far away, too; but a policy that climbs a gradient needs the action's everywhere.
    near = action + jax.lax.stop_gradient(normalizer.clip(state.action, action) - action)
    inputs = [normalizer.normalize(state.obs, obs), normalizer.normalize(state.action, near, limit=None)]
    return jnp.concatenate(inputs, axis=-1)


def model_targets(state: Normalizers, obs: Array, next_obs: Array) -> Array:
    """What a network should say: the normalised delta, `[..., O]`."""
    validate.shape("obs", obs, "...", state.obs.mean.shape[-1])
    validate.shape("next_obs", next_obs, "...", state.obs.mean.shape[-1])
    return normalizer.normalize(state.delta, next_obs - obs)


def apply_delta(state: Normalizers, obs: Array, delta: Array) -> Array:
    """The next observation `[..., O]`, in raw units, that a normalised delta leads to."""
    validate.shape("obs", obs, "...", state.obs.mean.shape[-1])
    return obs + normalizer.denormalize(state.delta, delta)


class Encoding(NamedTuple):
    """How a transition is written for a network, and how what the network says is read."""

    inputs: Callable[[Normalizers, Array, Array], Array]
    """`inputs(normalizers, obs [..., O], action [..., A]) -> [..., O + A]`: what a network sees."""
    targets: Callable[[Normalizers, Array, Array], Array]
    """`targets(normalizers, obs [..., O], next_obs [..., O]) -> [..., O]`: what it should say."""
    outputs: Callable[[Array], Array]
    """`outputs(last layer [..., O]) -> [..., O]`: what it says. Losses, variances and kernels see this."""
    next_obs: Callable[[Normalizers, Array, Array], Array]
    """`next_obs(normalizers, obs [..., O], outputs [..., O]) -> [..., O]`: where that leads, as an observation."""
    is_probability: bool = False
    """Whether outputs are probabilities of next states, in place of changes of the observation."""


@jax.custom_vjp
def probabilities(logits: Array) -> Array:
    """Softmax over the last axis, whose gradient passes straight through to the logits.

    Squared error alone has no gradient where a network is sure and wrong: a pair met for the first time can then keep a
    wrong successor for good, with all networks agreeing on it. Carried straight to the logits, the residual `y - p` of
    squared error is the gradient of cross-entropy, which does not vanish.
    """
    return jax.nn.softmax(logits)


probabilities.defvjp(lambda logits: (jax.nn.softmax(logits), None), lambda _, cotangent: (cotangent,))


def _most_likely(normalizers: Normalizers, obs: Array, outputs: Array) -> Array:
    return jax.nn.one_hot(jnp.argmax(outputs, axis=-1), outputs.shape[-1])


DELTA = Encoding(model_inputs, model_targets, lambda last: last, apply_delta)
"""Everything normalised; the network predicts the change of the observation."""

ONE_HOT = Encoding(
    inputs=lambda normalizers, obs, action: jnp.concatenate([obs, action], axis=-1),
    targets=lambda normalizers, obs, next_obs: next_obs,
    outputs=probabilities,
    next_obs=_most_likely,
    is_probability=True,
)
"""Nothing normalised; the network predicts the probability of each next state, and the most likely one comes."""

ENCODINGS: dict[str, Encoding] = {"delta": DELTA, "one_hot": ONE_HOT}
"""`DynamicsConfig.target` -> encoding."""
