"""The paper's belief: a generator of dynamics networks, trained by amortised SVGD on the replay."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxplore import dynamics, networks, replay, validate
from jaxplore.beliefs.base import Belief, FitConfig, make_optimizer
from jaxplore.beliefs.ensemble import Bootstrap, member_weights
from jaxplore.beliefs.generator import Generator, GeneratorConfig, make_generator
from jaxplore.beliefs.svgd import AmortizedSVGD, SVGDConfig, SVGDState, make_amortized_svgd
from jaxplore.dynamics import ENCODINGS, DynamicsConfig, Encoding, Normalizers, Prediction
from jaxplore.replay import Replay
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import FieldError


class GeneratorBelief(NamedTuple):
    """The fixed parts of the belief."""

    generator: Generator
    posterior: AmortizedSVGD
    apply: Callable[[Params, Array], Array]
    """`apply(params, inputs [N, O + A]) -> [N, O]`: one network's prediction."""
    encoding: Encoding
    input_size: int
    """`O + A`"""
    batch_size: int
    svgd: SVGDConfig
    num_generators: int
    """K, each with its own state along a leading axis where there are several."""
    bootstrap: Bootstrap
    bootstrap_std: float


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

    Raises:
        FieldError: a size below 1, or a number of generators that does not divide that of the networks.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> belief = make_generator_belief(3, 1, DynamicsConfig(hidden=(16,)))
        >>> state = belief.init(jax.random.key(0))
        >>> models = belief.sample(jax.random.key(1), state, 32)
        >>> belief.predict(models, jnp.zeros((5, 4))).mean.shape
        (32, 5, 3)
    """
    validate.sizes(obs_size=obs_size, action_size=action_size)
    fit_config, svgd_config = fit_config or FitConfig(), svgd_config or SVGDConfig()
    dynamics_config = dynamics_config or DynamicsConfig()
    encoding = ENCODINGS[dynamics_config.target]
    network = dynamics.make_network(dynamics_config, obs_size)
    # Only the example's shapes and spread are used; a fixed key keeps the factory pure.
    example = network.init(jax.random.key(0), jnp.zeros(obs_size + action_size))["params"]
    generator_config = generator_config or GeneratorConfig()
    generator, count = make_generator(example, generator_config), generator_config.num_generators
    if svgd_config.num_particles % count:
        allowed = f"a divisor of svgd.num_particles={svgd_config.num_particles}"
        raise FieldError("num_generators", count, allowed, "shares the networks unequally", "GeneratorConfig")
    svgd_config = dataclasses.replace(svgd_config, num_particles=svgd_config.num_particles // count)
    apply = functools.partial(_run, network, encoding)
    if generator_config.prior_scale:
        generator, apply = add_prior(generator, generator_config.prior_scale, network, encoding, obs_size + action_size)
    posterior = make_amortized_svgd(generator, apply, obs_size, make_optimizer(fit_config), svgd_config)
    input_size = obs_size + action_size
    parts = GeneratorBelief(
        generator,
        posterior,
        apply,
        encoding,
        input_size,
        fit_config.batch_size,
        svgd_config,
        count,
        generator_config.bootstrap,
        generator_config.bootstrap_std,
    )
    return Belief(
        init=functools.partial(init, parts),
        update=functools.partial(update, parts),
        sample=functools.partial(sample, parts),
        predict=functools.partial(predict, parts),
        encoding=encoding,
        num_models=svgd_config.num_particles * count,
        num_groups=count,
        fit_config=fit_config,
    )


def add_prior(
    generator: Generator, scale: float, network: networks.MLP, encoding: Encoding, input_size: int
) -> tuple[Generator, Callable[[Params, Array], Array]]:
    """A generator whose networks have a random function added to them that is never trained; see
    `GeneratorConfig.prior_scale`.

    The function is the last layer, drawn linearly from z, of a random network with the hidden layers of `network`.

    Args:
        generator: of networks like `network`.
        scale: standard deviation of the function's values, over z and standard normal inputs.
        network: architecture of a dynamics network.
        encoding: how its last layer is read.
        input_size: `I`.

    Returns:
        `(generator, apply)`: parameters are `{"network": ..., "prior": [width, O]}`, and `apply(params, inputs [N, I])`
        gives `[N, O]`.
    """
    # Fixed keys, as for the example: what is frozen follows from the settings alone.
    features_key, map_key, inputs_key = jax.random.split(jax.random.key(1), 3)
    features = networks.MLP(network.hidden[:-1], network.hidden[-1], network.activation, "he", "he")
    frozen = features.init(features_key, jnp.zeros(input_size))["params"]

    def features_of(inputs: Array) -> Array:
        return networks.ACTIVATIONS[network.activation](networks.apply(features, frozen, inputs))

    power = jnp.mean(jnp.sum(features_of(jax.random.normal(inputs_key, (512, input_size))) ** 2, axis=1))
    z_size = jax.eval_shape(lambda: generator.sample_noise(map_key, 1)).size
    shape = (z_size, network.hidden[-1], network.output_size)
    from_z = scale / jnp.sqrt(power * z_size) * jax.random.normal(map_key, shape)

    def generate(eta: Params, z: Array) -> Params:
        return {"network": generator.generate(eta, z), "prior": jnp.tensordot(z.reshape(-1), from_z, axes=1)}

    def apply(params: Params, inputs: Array) -> Array:
        prior = features_of(inputs) @ params["prior"]
        return encoding.outputs(networks.apply(network, params["network"], inputs) + prior)

    return generator._replace(generate=generate, sample=jax.vmap(generate, in_axes=(None, 0))), apply


def init(parts: GeneratorBelief, key: Key) -> SVGDState:
    """New generators; several along a leading axis `K`."""
    if parts.num_generators == 1:
        return parts.posterior.init(key)
    return jax.vmap(parts.posterior.init)(jax.random.split(key, parts.num_generators))


def update(
    parts: GeneratorBelief, key: Key, state: SVGDState, data: Replay[Transition], normalizers: Normalizers
) -> tuple[SVGDState, Metrics]:
    """One step of amortised SVGD on a minibatch of `data`, each generator on one of its own; metrics are means."""
    if parts.num_generators == 1:
        return update_one(parts, key, state, data, normalizers)
    keys = jax.random.split(key, parts.num_generators)
    one = jax.vmap(functools.partial(update_one, parts), in_axes=(0, 0, None, None, 0))
    state, metrics = one(keys, state, data, normalizers, jnp.arange(parts.num_generators))
    return state, {name: jnp.mean(values) for name, values in metrics.items()}


def update_one(
    parts: GeneratorBelief,
    key: Key,
    state: SVGDState,
    data: Replay[Transition],
    normalizers: Normalizers,
    number: int | Array = 0,
) -> tuple[SVGDState, Metrics]:
    """`update` of one generator, the `number`-th."""
    batch_key, extra_key, update_key = jax.random.split(key, 3)
    own = parts.svgd.num_particles if parts.svgd.batches == "own" else 0
    index = replay.choose(batch_key, data, max(own, 1) * parts.batch_size)
    index = index.reshape(own, -1) if own else index
    batch, weights = replay.take(data, index), None
    if parts.bootstrap != "none":
        weights = member_weights(parts.bootstrap, parts.num_generators, number, index, parts.bootstrap_std)
    inputs = parts.encoding.inputs(normalizers, batch.obs, batch.action)
    targets = parts.encoding.targets(normalizers, batch.obs, batch.next_obs)
    extra_inputs = None
    if parts.svgd.repulsion_points == "independent":
        extra = replay.sample(extra_key, data, parts.batch_size)
        extra_inputs = parts.encoding.inputs(normalizers, extra.obs, extra.action)
    num_data = jnp.maximum(data.size, 1)
    return parts.posterior.update(update_key, state, inputs, targets, num_data, extra_inputs, weights)


def sample(parts: GeneratorBelief, key: Key, state: SVGDState, num: int) -> Params:
    """`num` networks, each leaf with a leading axis `M = num`, as many from each generator; the particles themselves
    where their noise is fixed.

    Raises:
        FieldError: `num` below 1, or not as many from each generator.
    """
    validate.at_least("num", num, 1)
    count = parts.num_generators
    if count == 1:
        return sample_one(parts, key, state, num)
    if num % count:
        raise FieldError("num", num, f"a multiple of num_generators={count}", "are not as many from each generator")
    one = jax.vmap(functools.partial(sample_one, parts, num=num // count))
    networks = one(jax.random.split(key, count), state)
    return jax.tree.map(lambda leaf: leaf.reshape(num, *leaf.shape[2:]), networks)


def sample_one(parts: GeneratorBelief, key: Key, state: SVGDState, num: int) -> Params:
    """`num` networks of one generator."""
    if parts.svgd.redraw == "fixed" and num == parts.svgd.num_particles:
        return parts.generator.sample(state.eta, state.z)
    return parts.generator.sample(state.eta, parts.generator.sample_noise(key, num))


def predict(parts: GeneratorBelief, models: Params, inputs: Array) -> Prediction:
    """What networks say of `inputs [N, O + A]`: `[M, N, O]`."""
    validate.shape("inputs", inputs, "N", parts.input_size)
    return Prediction(jax.vmap(parts.apply, in_axes=(0, None))(models, inputs))


def _run(network: networks.MLP, encoding: Encoding, params: Params, inputs: Array) -> Array:
    return encoding.outputs(networks.apply(network, params, inputs))
