"""A generator of networks: G(z; eta) turns Gaussian noise into the parameters of any Flax network.

One small MLP per layer of the target network maps the noise z to that layer's weights and biases (section 3.1 of
Ratzlaff et al. 2020, figure 1). The target network is given by example: any tree of parameters will do, so a
posterior can be put over any network.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxplore import validate
from jaxplore.beliefs.ensemble import Bootstrap
from jaxplore.networks import ACTIVATIONS, MLP, apply
from jaxplore.types import Array, Key, Params
from jaxplore.validate import Checks

Noise = Literal["shared", "per_layer"]
InitStd = Literal["match_example", "he", "lecun"]

NUM_CALIBRATION = 512
"""Draws of z by which heads are scaled at the start."""
DEAD_STD = 1e-3
"""A feature whose standard deviation over z is below this makes no difference between networks."""


@dataclass(frozen=True)
class GeneratorConfig:
    """Shape and initialisation of a generator."""

    noise_size: int = 32
    """Entries of z. Paper: 32."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of each layer generator. Paper: 64, 64 (ReLU)."""
    noise: Noise = "shared"
    """`shared`: one z for all layers (main text and figure 1). `per_layer`: an independent z each (appendix)."""
    init_std: InitStd = "match_example"
    """Standard deviation of a sampled network's kernel entries at the start: that of the example's own entries, or
    He's sqrt(2 / fan_in), or LeCun's sqrt(1 / fan_in)."""
    constant_fraction: float = 0.5
    """Share of that variance that does not depend on z, in [0, 1). 0: unrelated networks; near 1: nearly equal ones."""
    activation: str = "relu"
    """Of the features that a layer generator makes of z. Paper: `relu`, whose features die: what depends on z is noise
    to a fit, which pushes it down until all are 0 for every z, and all networks are one. `tanh` cannot."""
    normalize: bool = False
    """Whether features are normalised over their units, for each z: mean 0 and variance 1."""
    num_generators: int = 1
    """K, generators of their own within one belief, each with its own features and heads, and `num_particles / K` of
    the networks. Those of one generator differ by z, those of several by where they started, too. Paper: 1."""
    bootstrap: Bootstrap = "none"
    """Weights of transitions, fixed for each generator and transition as for a static ensemble's members; see
    `EnsembleConfig.bootstrap`."""
    bootstrap_std: float = 1.0
    """Standard deviation of those weights, in (0, 1]."""
    prior_scale: float = 0.0
    """Standard deviation of a random function of z and the inputs that is added to each network and never trained, so
    that networks differ where no data tell them to agree (Osband et al. 2018; linear in z as in Dwaracherla et al.
    2020); in output units, at inputs of one standard deviation. 0: none. Features no fewer than `noise_size` can learn
    to make up for it."""
    bias_std: float = 0.1
    """The same for entries of leaves with fewer than two axes (biases, scales), around the example's value."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.at_least("noise_size", 1)
        checks.widths("hidden")
        checks.one_of("noise", get_args(Noise))
        checks.one_of("init_std", get_args(InitStd))
        checks.in_range("constant_fraction", 0.0, 1.0, open_high=True)
        checks.in_range("bias_std", 0.0)
        checks.one_of("activation", ACTIVATIONS)
        checks.at_least("num_generators", 1)
        if self.normalize and self.hidden[-1] == 1:
            raise checks.refusal("normalize", "leaves nothing of one feature", "a last width of hidden of 2 or more")
        checks.one_of("bootstrap", get_args(Bootstrap))
        if self.bootstrap != "none" and self.num_generators == 1:
            allowed = "'none', or num_generators of 2 or more"
            raise checks.refusal("bootstrap", "tells generators apart, and there is one", allowed)
        checks.in_range("bootstrap_std", 0.0, 1.0, open_low=True)
        checks.in_range("prior_scale", 0.0)


class Generator(NamedTuple):
    """Pure functions of one generator."""

    init: Callable[[Key], Params]
    """`init(key) -> eta`."""
    sample_noise: Callable[[Key, int], Array]
    """`sample_noise(key, num) -> z`: `[num, Z]`, or `[num, layers, Z]` where each layer has its own."""
    generate: Callable[[Params, Array], Params]
    """`generate(eta, z) -> theta`: one network's parameters from one z, shaped like the example."""
    sample: Callable[[Params, Array], Params]
    """`sample(eta, zs) -> thetas`: `generate` under `vmap` over z; every leaf gets a leading axis `M`."""
    features: Callable[[Params, Array], Array] | None = None
    """`features(eta, zs) -> [layers, M, width]`: what each layer generator makes of z before its heads. None: it has
    no such thing."""


class GeneratorSpec(NamedTuple):
    """The fixed parts of a generator, which its functions take first; `make_spec` derives them from an example."""

    layers: dict[str, tuple[int, ...]]
    """Each layer's leaves, by their place in the flattened tree."""
    shapes: tuple[tuple[int, ...], ...]
    """Of each leaf."""
    treedef: Any
    """Structure of the tree that the leaves are put into."""
    targets: tuple[tuple[np.ndarray, float], ...]
    """Means `[size]` and standard deviation that each leaf's numbers start with."""
    features: MLP
    """All but the last layer of each layer generator."""
    config: GeneratorConfig


def fan_in(leaf: Array) -> int:
    """Inputs that feed one output of a kernel in Flax's layout `[..., in, out]`."""
    return math.prod(leaf.shape[:-1])


def kernel_std(leaf: Array, rule: InitStd) -> float:
    """Standard deviation that `rule` gives the entries of a kernel."""
    if rule == "match_example":
        return float(np.sqrt(np.mean(np.square(np.asarray(leaf)))))
    return math.sqrt((2.0 if rule == "he" else 1.0) / fan_in(leaf))


def make_spec(example: Params, config: GeneratorConfig) -> GeneratorSpec:
    """The fixed parts of a generator of networks shaped like `example`; raises as `make_generator`."""
    paths_and_leaves, treedef = jax.tree_util.tree_flatten_with_path(example)
    if not paths_and_leaves:
        raise ValueError("example has no leaves. Allowed: a tree with at least one parameter array.")
    layers: dict[str, tuple[int, ...]] = {}
    for index, (path, _) in enumerate(paths_and_leaves):
        name = jax.tree_util.keystr(path[:-1], simple=True, separator="/") or "root"
        layers[name] = (*layers.get(name, ()), index)
    return GeneratorSpec(
        layers=layers,
        shapes=tuple(leaf.shape for _, leaf in paths_and_leaves),
        treedef=treedef,
        targets=tuple(_targets(path, leaf, config) for path, leaf in paths_and_leaves),
        features=MLP(config.hidden[:-1], config.hidden[-1], config.activation, "he", "he"),
        config=config,
    )


def _targets(path: Any, leaf: Array, config: GeneratorConfig) -> tuple[np.ndarray, float]:
    """Means `[size]` and standard deviation that a leaf's numbers start with, over networks and initialisations."""
    if leaf.ndim < 2:
        return np.ravel(np.asarray(leaf, np.float32)), config.bias_std
    std = kernel_std(leaf, config.init_std)
    if std == 0.0:
        raise ValueError(
            f"example{jax.tree_util.keystr(path)} is all zeros, so its spread cannot be matched. "
            "Allowed: an initialised network, or init_std='he' or 'lecun'."
        )
    return np.zeros(leaf.size, np.float32), std


def features_of(spec: GeneratorSpec, params: Params, z: Array) -> Array:
    """What one layer generator makes of one z `[Z]`, `[width]`."""
    found = ACTIVATIONS[spec.config.activation](apply(spec.features, params, z))
    if not spec.config.normalize:
        return found
    found = found - jnp.mean(found)
    return found * jax.lax.rsqrt(jnp.mean(found**2) + 1e-6)


def init_head(config: GeneratorConfig, key: Key, features: Array, centre: np.ndarray, std: float) -> Array:
    """What maps a layer's features to one leaf, `[width + 1, size]`: a column for each number of the leaf.

    The bias is the last row, that of a feature which is always 1: its gradient is then part of one matrix product. A
    leaf has its own so that nothing is cut up and put together again. The long axis is the last, so that what is done
    entry by entry, as by Adam, runs along it.

    Args:
        config: its last hidden width is the features'.
        key: consumed.
        features: of many z, `[N, width]`: their mean and variance decide how far z moves the numbers.
        centre: means that the leaf's numbers start with, `[size]`.
        std: their standard deviation.
    """
    kernel_key, bias_key = jax.random.split(key)
    width, size = config.hidden[-1], centre.size
    mean, spread = jnp.mean(features, axis=0), jnp.sum(jnp.var(features, axis=0))
    kernel_std = std * jnp.sqrt((1.0 - config.constant_fraction) / spread)
    kernel = kernel_std * jax.random.normal(kernel_key, (size, width)).T
    constant = std * math.sqrt(config.constant_fraction) * jax.random.normal(bias_key, (size,))
    # Features that are never negative have a mean, and what it comes to is the same for every z.
    return jnp.concatenate([kernel, (centre + constant - mean @ kernel)[None]])


def init(spec: GeneratorSpec, key: Key) -> Params:
    """Freshly initialised eta, by layer: `features` and the head of each leaf; see `Generator.init`."""
    eta = {}
    for name, layer_key in zip(spec.layers, jax.random.split(key, len(spec.layers)), strict=True):
        indices = spec.layers[name]
        features_key, *keys = jax.random.split(layer_key, 1 + len(indices))
        params = spec.features.init(features_key, jnp.zeros(spec.config.noise_size))["params"]
        # Always the same z: that of the networks is drawn from keys of its own.
        zs = jax.random.normal(jax.random.key(0), (NUM_CALIBRATION, spec.config.noise_size))
        features = jax.vmap(partial(features_of, spec, params))(zs)
        heads = {
            str(i): init_head(spec.config, key, features, *spec.targets[i])
            for i, key in zip(indices, keys, strict=True)
        }
        eta[name] = {"features": params, **heads}
    return eta


def sample_noise(spec: GeneratorSpec, key: Key, num: int) -> Array:
    """Standard normal noise, `[num, Z]` or `[num, layers, Z]`; see `Generator.sample_noise`.

    Raises:
        FieldError: `num` below 1.
    """
    validate.at_least("num", num, 1)
    size = spec.config.noise_size
    shape = (num, size) if spec.config.noise == "shared" else (num, len(spec.layers), size)
    return jax.random.normal(key, shape)


def generate(spec: GeneratorSpec, eta: Params, z: Array) -> Params:
    """The parameters of one network from one z, `[Z]` or `[layers, Z]`; see `Generator.generate`."""
    generated: list[Array | None] = [None] * len(spec.shapes)
    for number, (name, indices) in enumerate(spec.layers.items()):
        own_z = z if spec.config.noise == "shared" else z[number]
        inputs = jnp.append(features_of(spec, eta[name]["features"], own_z), 1.0)
        # Under `vmap` the product by 1 puts a network's inputs into a column, where their gradients come out, too: with
        # one generator XLA then runs that product of long and thin matrices the quick way round (paper's step: -12 %).
        inputs = jnp.eye(inputs.size) @ inputs
        for i in indices:
            generated[i] = jnp.einsum("wn,w->n", eta[name][str(i)], inputs).reshape(spec.shapes[i])
    return jax.tree.unflatten(spec.treedef, generated)


def features(spec: GeneratorSpec, eta: Params, zs: Array) -> Array:
    """The features of all layers for all z, `[layers, M, width]`; see `Generator.features`."""
    shared = spec.config.noise == "shared"
    return jnp.stack(
        [
            jax.vmap(partial(features_of, spec, eta[name]["features"]))(zs if shared else zs[:, number])
            for number, name in enumerate(spec.layers)
        ]
    )


def dead_share(features: Array) -> Array:
    """Share of features `[layers, M, width]` that hardly depend on z: standard deviation over z below `DEAD_STD`."""
    return jnp.mean(jnp.std(features, axis=1) < DEAD_STD)


def make_generator(example: Params, config: GeneratorConfig | None = None) -> Generator:
    """Make a generator of networks with parameters shaped like `example`.

    Args:
        example: the parameter tree of one network, freshly initialised. Leaves that share a parent (a layer's kernel
            and bias) come from one layer generator.
        config: shape and initialisation; the paper's by default.

    Returns:
        A `Generator`.

    Raises:
        ValueError: `example` has no leaves, or `init_std="match_example"` and a kernel of it is all zeros.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> net = MLP(hidden=(64,), output_size=2)
        >>> example = net.init(jax.random.key(0), jnp.zeros(3))["params"]
        >>> generator = make_generator(example)
        >>> eta = generator.init(jax.random.key(1))
        >>> thetas = generator.sample(eta, generator.sample_noise(jax.random.key(2), 32))
        >>> jax.vmap(lambda theta: net.apply({"params": theta}, jnp.ones(3)))(thetas).shape
        (32, 2)
    """
    spec = make_spec(example, config or GeneratorConfig())
    generate_one = partial(generate, spec)
    return Generator(
        init=partial(init, spec),
        sample_noise=partial(sample_noise, spec),
        generate=generate_one,
        sample=jax.vmap(generate_one, in_axes=(None, 0)),
        features=partial(features, spec),
    )
