"""Beliefs over the dynamics: what a method knows of the environment, and how it learns from data.

A belief is a named tuple of pure functions. `sample` draws m models from it, `predict` runs them, `update` takes one
gradient step on the replay. A new belief is a new factory with this shape.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxplore import dynamics, networks, replay
from jaxplore.dynamics import DELTA, ENCODINGS, DynamicsConfig, Encoding, Normalizers, Prediction
from jaxplore.generator import GeneratorConfig, make_generator
from jaxplore.replay import Replay
from jaxplore.svgd import SVGDConfig, SVGDState, make_amortized_svgd
from jaxplore.types import Array, Key, Metrics, Transition
from jaxplore.validate import Checks


@dataclass(frozen=True)
class FitConfig:
    """How a belief is fitted in each round. The defaults are the paper's; `epochs`, `restart` after nnaisense/max."""

    lr: float = 1e-4
    """Adam's learning rate. Paper: 1e-4."""
    weight_decay: float = 1e-5
    """Factor of the parameters added to their gradient. Paper: 1e-5."""
    batch_size: int = 256
    """Transitions per step, one batch for all particles. Paper: 256."""
    epochs: int = 50
    """Passes over the data per round: `epochs * max(1, N // batch_size)` steps. 0: `steps` instead."""
    steps: int = 60
    """Gradient steps per round where `epochs` is 0."""
    restart: bool = True
    """Whether each round starts from new parameters (nnaisense/max) or goes on from the last ones."""
    clip_value: float = 5.0
    """Bound on each entry of a gradient (nnaisense/max: 5). 0: none."""
    clip_norm: float = 0.0
    """Bound on the norm of a gradient. 0: none."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.in_range("lr", 0.0, open_low=True)
        for field in ("weight_decay", "clip_value", "clip_norm"):
            checks.in_range(field, 0.0)
        checks.at_least("batch_size", 1)
        checks.at_least("epochs", 0)
        checks.at_least("steps", 1)

    def num_steps(self, num_data: Array) -> Array:
        """Gradient steps of a round with `num_data` transitions, int32."""
        if self.epochs == 0:
            return jnp.asarray(self.steps, jnp.int32)
        return self.epochs * jnp.maximum(num_data // self.batch_size, 1)


def make_optimizer(config: FitConfig) -> optax.GradientTransformation:
    """Clipping, weight decay added to the gradient, and Adam, as `config` says."""
    parts = []
    if config.clip_value:
        parts.append(optax.clip(config.clip_value))
    if config.clip_norm:
        parts.append(optax.clip_by_global_norm(config.clip_norm))
    if config.weight_decay:
        parts.append(optax.add_decayed_weights(config.weight_decay))
    return optax.chain(*parts, optax.adam(config.lr))


class Belief(NamedTuple):
    """A belief over the dynamics as pure functions."""

    init: Callable[[Key], Any]
    """`init(key) -> state`."""
    update: Callable[[Key, Any, Replay[Transition], Normalizers], tuple[Any, Metrics]]
    """`update(key, state, replay, normalizers) -> (state, metrics)`: one gradient step."""
    sample: Callable[[Key, Any, int], Any]
    """`sample(key, state, num) -> models`: a tree whose leaves have a leading axis `M = num`."""
    predict: Callable[[Any, Array], Prediction] | None
    """`predict(models, inputs [N, O + A]) -> Prediction` of `[M, N, O]`. None: this belief predicts nothing."""
    encoding: Encoding = DELTA
    """What `inputs` and predictions are."""


def make_generator_belief(
    obs_size: int,
    action_size: int,
    dynamics_config: DynamicsConfig | None = None,
    generator_config: GeneratorConfig | None = None,
    svgd_config: SVGDConfig | None = None,
    fit_config: FitConfig | None = None,
) -> Belief:
    """The paper's belief: a generator of dynamics networks, trained by amortised SVGD.

    Args:
        obs_size: `O`.
        action_size: `A`.
        dynamics_config: shape of a dynamics network.
        generator_config: shape of the generator.
        svgd_config: how the posterior is approximated.
        fit_config: batch size and optimiser.

    Returns:
        A `Belief` whose models are parameter trees.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> belief = make_generator_belief(3, 1, DynamicsConfig(hidden=(16,)))
        >>> state = belief.init(jax.random.key(0))
        >>> models = belief.sample(jax.random.key(1), state, 32)
        >>> belief.predict(models, jnp.zeros((5, 4))).mean.shape
        (32, 5, 3)
    """
    fit_config = fit_config or FitConfig()
    svgd_config = svgd_config or SVGDConfig()
    dynamics_config = dynamics_config or DynamicsConfig()
    encoding = ENCODINGS[dynamics_config.target]
    network = dynamics.make_network(dynamics_config, obs_size)
    # Only the example's shapes and spread are used; a fixed key keeps the factory pure.
    example = network.init(jax.random.key(0), jnp.zeros(obs_size + action_size))["params"]
    generator = make_generator(example, generator_config)

    def apply(params: Any, inputs: Array) -> Array:
        return encoding.outputs(networks.apply(network, params, inputs))

    posterior = make_amortized_svgd(generator, apply, obs_size, make_optimizer(fit_config), svgd_config)

    def update(
        key: Key, state: SVGDState, data: Replay[Transition], normalizers: Normalizers
    ) -> tuple[SVGDState, Metrics]:
        batch_key, extra_key, update_key = jax.random.split(key, 3)
        batch = replay.sample(batch_key, data, fit_config.batch_size)
        inputs = encoding.inputs(normalizers, batch.obs, batch.action)
        targets = encoding.targets(normalizers, batch.obs, batch.next_obs)
        extra_inputs = None
        if svgd_config.repulsion_points == "independent":
            extra = replay.sample(extra_key, data, fit_config.batch_size)
            extra_inputs = encoding.inputs(normalizers, extra.obs, extra.action)
        num_data = jnp.maximum(data.size, 1)
        return posterior.update(update_key, state, inputs, targets, num_data, extra_inputs)

    def sample(key: Key, state: SVGDState, num: int) -> Any:
        if svgd_config.redraw == "fixed" and num == svgd_config.num_particles:
            return generator.sample(state.eta, state.z)
        return generator.sample(state.eta, generator.sample_noise(key, num))

    def predict(models: Any, inputs: Array) -> Prediction:
        return Prediction(jax.vmap(apply, in_axes=(0, None))(models, inputs))

    return Belief(posterior.init, update, sample, predict, encoding)


def make_no_belief() -> Belief:
    """The belief of a method that models nothing: an empty state that no data changes."""
    return Belief(
        init=lambda key: (),
        update=lambda key, state, data, normalizers: (state, {}),
        sample=lambda key, state, num: (),
        predict=None,
    )
