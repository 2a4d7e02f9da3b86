"""The networks: a plain MLP, value heads and the tanh-Gaussian policy. The only file that knows linen and distrax.

distrax, with the probability library behind it, takes as long to import as JAX itself, so it is imported when the first
action is drawn. Every network is unbatched-friendly: leading axes of the input pass through.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxplore import validate
from jaxplore.types import Array, Key, Params

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "relu": nn.relu,
    "leaky_relu": nn.leaky_relu,
    "swish": nn.swish,
    "tanh": jnp.tanh,
}
"""Activations by name. `leaky_relu` has slope 0.01; `swish` is x * sigmoid(x)."""


def _small_uniform() -> Callable[..., Array]:
    return lambda key, shape, dtype=jnp.float32: jax.random.uniform(key, shape, dtype, -3e-3, 3e-3)


INITIALIZERS = {
    "he": nn.initializers.he_normal,
    "lecun": nn.initializers.lecun_normal,
    "orthogonal": nn.initializers.orthogonal,
    "orthogonal_relu": lambda: nn.initializers.orthogonal(2.0**0.5),
    "orthogonal_small": lambda: nn.initializers.orthogonal(0.01),
    "small_uniform": _small_uniform,
    "xavier": nn.initializers.xavier_uniform,
    "xavier_normal": nn.initializers.xavier_normal,
}
"""Kernel initialisers by name; biases start at 0. `orthogonal_relu` has gain sqrt(2), which keeps the size of what ReLU
lets through, `orthogonal_small` 0.01; `small_uniform` is within 0.003."""


class Dense(nn.Module):
    """A linear layer of several inputs side by side, into several outputs side by side.

    `[..., I]` and `[..., J]` count as their concatenation, which is not made: what depends on one of them alone is
    computed, and differentiated, alone. So are the outputs, where `sizes` names more than one.
    """

    sizes: tuple[int, ...]
    init_name: str

    @nn.compact
    def __call__(self, *inputs: Array) -> tuple[Array, ...]:
        """An array `[..., size]` for each of the sizes."""
        widths = [one.shape[-1] for one in inputs]
        kernel = self.param("kernel", INITIALIZERS[self.init_name](), (sum(widths), sum(self.sizes)))
        bias = self.param("bias", nn.initializers.zeros_init(), (sum(self.sizes),))
        outputs, column = [], 0
        for size in self.sizes:
            products, row, columns = [], 0, slice(column, column + size)
            for one, width in zip(inputs, widths, strict=True):
                products.append(one @ kernel[row : row + width, columns])
                row += width
            outputs.append(sum(products[1:], products[0]) + bias[columns].reshape(*(1,) * (inputs[0].ndim - 1), size))
            column += size
        return tuple(outputs)


class MLP(nn.Module):
    """A multi-layer perceptron with a linear last layer: `[..., I] -> [..., output_size]`.

    Several inputs are taken side by side, as if concatenated.

    Raises:
        ValueError: unknown `activation` or `init`, naming the nearest match.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> net = MLP(hidden=(64, 64), output_size=3)
        >>> params = net.init(jax.random.key(0), jnp.zeros(5))["params"]
        >>> net.apply({"params": params}, jnp.ones((7, 5))).shape
        (7, 3)
    """

    hidden: tuple[int, ...]
    output_size: int
    activation: str = "relu"
    init_name: str = "he"
    """Initialiser of the hidden layers."""
    output_init_name: str = "lecun"
    """Initialiser of the last layer, which no activation follows."""
    layer_norm: bool = False
    """Whether hidden layers are normalised (Ba et al. 2016) before their activation."""
    num_outputs: int = 1
    """Equal parts that the output comes in; more than one as a tuple."""

    def __post_init__(self) -> None:
        validate.one_of("activation", self.activation, ACTIVATIONS)
        validate.one_of("init_name", self.init_name, INITIALIZERS)
        validate.one_of("output_init_name", self.output_init_name, INITIALIZERS)
        super().__post_init__()

    @nn.compact
    def __call__(self, *inputs: Array) -> Any:
        """Run the network."""
        for i, width in enumerate(self.hidden):
            (x,) = Dense((width,), self.init_name, name=f"hidden_{i}")(*inputs)
            if self.layer_norm:
                x = nn.LayerNorm(name=f"norm_{i}")(x)
            inputs = (ACTIVATIONS[self.activation](x),)
        sizes = (self.output_size // self.num_outputs,) * self.num_outputs
        outputs = Dense(sizes, self.output_init_name, name="output")(*inputs)
        return outputs[0] if self.num_outputs == 1 else outputs


LOG_STD_MAPS: dict[str, Callable[[Array, float, float], Array]] = {
    "tanh": lambda head, low, high: low + 0.5 * (high - low) * (jnp.tanh(head) + 1.0),
    "clip": lambda head, low, high: jnp.clip(head, low, high),
}
"""From a policy's head to its log standard deviation, within bounds. `tanh` has a gradient everywhere and starts in the
middle between them (nnaisense/max, `sac.py`); `clip` is the head itself, which starts at 0 (haarnoja/sac)."""


class GaussianParams(NamedTuple):
    """A diagonal Gaussian before the squash."""

    mean: Array
    """`[..., A]`"""
    log_std: Array
    """`[..., A]`"""


class TanhGaussianPolicy(nn.Module):
    """Network of a tanh-squashed diagonal Gaussian policy: `[..., O] -> GaussianParams` of `[..., A]`.

    How its head becomes the log standard deviation, within `log_std_bounds`, is one of `LOG_STD_MAPS`.

    Raises:
        ValueError: unknown `log_std_map`, naming the nearest match.
    """

    hidden: tuple[int, ...]
    action_size: int
    activation: str = "leaky_relu"
    init_name: str = "orthogonal"
    log_std_bounds: tuple[float, float] = (-20.0, 2.0)
    log_std_map: str = "tanh"

    def __post_init__(self) -> None:
        validate.one_of("log_std_map", self.log_std_map, LOG_STD_MAPS)
        super().__post_init__()

    @nn.compact
    def __call__(self, obs: Array) -> GaussianParams:
        """Run the network."""
        inits = self.init_name, self.init_name
        mlp = MLP(self.hidden, 2 * self.action_size, self.activation, *inits, num_outputs=2, name="mlp")
        mean, head = mlp(obs)
        return GaussianParams(mean, LOG_STD_MAPS[self.log_std_map](head, *self.log_std_bounds))


def sample_tanh_gaussian(key: Key, params: GaussianParams) -> tuple[Array, Array]:
    """Draw an action and its log-density.

    Args:
        key: consumed.
        params: mean and log standard deviation before the squash, each `[..., A]`.

    Returns:
        `(action [..., A] in [-1, 1], log_prob [...])`. The gradient flows through both (reparametrised).

    Example:
        >>> import jax, jax.numpy as jnp
        >>> action, log_prob = sample_tanh_gaussian(jax.random.key(0), GaussianParams(jnp.zeros(2), jnp.zeros(2)))
        >>> action.shape, log_prob.shape
        ((2,), ())
    """
    return tanh_gaussian_of(jax.random.normal(key, params.mean.shape), params)


def tanh_gaussian_of(noise: Array, params: GaussianParams) -> tuple[Array, Array]:
    """The action that standard normal noise `[..., A]` stands for, and its log-density; see `sample_tanh_gaussian`.

    The pair comes out of one pass: a density recomputed from a saturated action is not finite (distrax issue 7).
    """
    # The first call may be traced, and what a module makes at its import must not be.
    with jax.ensure_compile_time_eval(), jax.numpy_rank_promotion("allow"):
        import distrax

    before = params.mean + jnp.exp(params.log_std) * noise
    density = jnp.sum(-0.5 * noise**2 - 0.5 * math.log(2.0 * math.pi) - params.log_std, axis=-1)
    action, log_slope = distrax.Block(distrax.Tanh(), 1).forward_and_log_det(before)
    return jnp.asarray(action), density - jnp.asarray(log_slope)


def tanh_mean(params: GaussianParams) -> Array:
    """The deterministic action `[..., A]`: the squashed mean of the Gaussian (not the mean of the squashed one)."""
    return jnp.tanh(params.mean)


def apply(network: nn.Module, params: Params, *inputs: Array) -> Any:
    """What a network with these parameters makes of its inputs."""
    return network.apply({"params": params}, *inputs)


def count_params(params: object) -> int:
    """How many numbers a parameter tree holds."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))
