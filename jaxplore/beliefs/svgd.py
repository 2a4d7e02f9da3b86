"""Amortised Stein variational gradient descent in function space (Ratzlaff et al. 2020, eqs. 4-6).

m networks drawn from a generator are particles; what the kernel compares is their *predictions* on a set of points.
Each particle's predictions are driven by the kernel-averaged score of the data and pushed apart by the kernel's
gradient; both are carried back to the generator's parameters eta by one vector-Jacobian product.

With residuals y - F of a batch of n out of N points, likelihood standard deviation sigma and temperature T:

    drive_i     = [ sum_{j != i} K_ij s_j + l s_i ] / (m - 1 + l),      s_j = (N / n) (y - F_j) / sigma^2 / T
    repulsion_i = [ sum_j grad_{R_j} K_ij ] / (m - 1 + l)
    grad eta    = -(1 / (m N)) sum_i  J_i^T (drive_i, repulsion_i, prior_i)

where R are the predictions at the repulsion points and l is the weight of a particle in its own average. l = 1 is
the paper's equation 6, and its variance is too small by a known factor (`experiments/results/README.md`, "What the
update converges to"). With l = 0 and noise redrawn at every step the exact posterior is stationary as m grows: the
variance is within 1 % of it from m = 16 on, 1.08 times it with 8, 1.3 with 4, and grows without end with 2, as it does
with any m where a flat prior and few data leave networks free.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from jaxplore import validate
from jaxplore.beliefs.generator import Generator, dead_share, fan_in
from jaxplore.types import Array, Key, Metrics, Params
from jaxplore.validate import Checks, FieldError

Bandwidth = Literal["median", "median_log", "mean", "fixed"]
Kernel = Literal["rbf", "imq"]
KernelOutputs = Literal["joint", "per_output"]
RepulsionPoints = Literal["batch", "perturbed", "independent", "uniform"]
Prior = Literal["flat", "weights", "gp"]
Tempering = Literal["constant", "per_datum"]
Redraw = Literal["every_step", "fixed"]
Batches = Literal["shared", "own"]

MIN_BANDWIDTH = 1e-6
"""Floor of the bandwidth: identical particles must not divide by zero."""


NUM_JUDGES = 64
"""Draws of z, always the same, on which it is judged whether a feature depends on z."""


@dataclass(frozen=True)
class SVGDConfig:
    """The choices that make up one posterior approximation. The defaults are what the paper prints."""

    num_particles: int = 32
    """m, networks drawn per update. Paper: 32."""
    self_weight: float = 1.0
    """l in [0, 1], weight of a particle in its own kernel average. Paper: 1. Below 1 needs `redraw="every_step"`."""
    kernel: Kernel = "rbf"
    """`rbf`: exp(-d / h), the paper's. `imq`: (1 + d / h)^(-1/2)."""
    kernel_outputs: KernelOutputs = "joint"
    """`joint`: one kernel over all outputs (paper). `per_output`: one per output, for heads with separate weights."""
    bandwidth: Bandwidth = "median"
    """How h follows from the pairwise distances d_ij, i < j. Paper: their median. `median_log`: over log m."""
    bandwidth_scale: float = 1.0
    """Factor on h; h itself where `bandwidth="fixed"` (in squared output units)."""
    likelihood_std: float = math.sqrt(0.5)
    """sigma, in output units. Paper: sqrt(1/2), as its loss is |y - f|^2 without the 1/2. Start value if learned."""
    learn_likelihood_std: bool = False
    """Whether sigma follows the residuals, one per output (its fixed point is RSS / (N - p) with l = 0)."""
    likelihood_std_floor: float = 0.05
    """Lowest learned sigma: a deterministic simulator would push it, and the posterior's spread, to 0."""
    temperature: float = 1.0
    """T on the likelihood. 1 is the posterior; more is hotter (wider)."""
    tempering: Tempering = "constant"
    """`constant`: T as it is. `per_datum`: T times N, so that the data term is a *mean* over the data and the
    posterior does not sharpen as data come in; `temperature` is then the weight of the repulsion beside it."""
    prior: Prior = "flat"
    """`flat` (paper), `weights`: a Gaussian on the parameters, `gp`: a Gaussian process on the repulsion points."""
    prior_scale: float = 3.0
    """Standard deviation of kernel entries under `weights`, in units of sqrt(2 / fan_in); amplitude of `gp`."""
    prior_bias_std: float = 1.5
    """Standard deviation of biases under `weights`."""
    prior_lengthscale: float = 1.0
    """Length-scale of `gp`, in input units."""
    repulsion_points: RepulsionPoints = "batch"
    """Where particles are pushed apart. `batch` (paper): on the batch. `perturbed`: also at the batch's inputs plus
    noise. `independent`: on a second batch. `uniform`: also on uniform points in a box of +-`repulsion_scale`."""
    repulsion_scale: float = 1.0
    """Standard deviation of the perturbation, or half-width of the box, in input units."""
    num_repulsion_points: int = 32
    """How many uniform points."""
    accept_improper: bool = False
    """Whether points beyond the data with a flat prior pass without a warning: you watch `repulsion_variance`."""
    redraw: Redraw = "every_step"
    """`every_step`: new noise z each update. `fixed`: one set drawn at the start (needs `self_weight=1`)."""
    batches: Batches = "shared"
    """`shared` (paper): networks meet on one batch. `own`: one each, as static networks have, so that a step sees m
    times the data for the same products. Nothing then compares networks, as no two are at the same points: each follows
    its own score alone, without kernel, repulsion or `prior="gp"`, and they differ by z and by `num_generators`."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.at_least("num_particles", 1)
        checks.in_range("self_weight", 0.0, 1.0)
        for field, names in (
            ("kernel", Kernel),
            ("kernel_outputs", KernelOutputs),
            ("bandwidth", Bandwidth),
            ("prior", Prior),
            ("tempering", Tempering),
            ("repulsion_points", RepulsionPoints),
            ("redraw", Redraw),
            ("batches", Batches),
        ):
            checks.one_of(field, get_args(names))
        positive = ("bandwidth_scale", "likelihood_std", "temperature", "prior_scale", "prior_bias_std")
        for field in (*positive, "prior_lengthscale", "repulsion_scale", "likelihood_std_floor"):
            checks.in_range(field, 0.0, open_low=True)
        checks.at_least("num_repulsion_points", 1)
        if self.redraw == "fixed" and self.self_weight < 1.0:
            problem = "diverges with redraw='fixed': a particle that is not pulled itself is pushed without end"
            raise checks.refusal("self_weight", problem, "self_weight=1, or redraw='every_step'")
        if self.batches == "own" and (self.prior == "gp" or self.repulsion_points != "batch"):
            problem = "leaves networks no points in common, to be pushed apart on or to have a prior at"
            raise checks.refusal("batches", problem, "'shared', or repulsion_points='batch' with another prior")


class SteinDirection(NamedTuple):
    """What moves the particles, and what to look at."""

    drive: Array
    """Kernel-averaged score on the data's values, `[M, n, O]`."""
    repulsion: Array
    """Kernel gradient on the repulsion points' values, `[M, r, O]`."""
    weights: Array
    """`[M, M]`, how much of particle j's score moves particle i (rows sum to at most 1; mean over outputs)."""
    bandwidth: Array
    """h, mean over kernels, scalar."""
    kernel_mean: Array
    """Mean of K_ij over i != j, scalar."""


def squared_distances(values: Array) -> Array:
    """Pairwise mean squared distances of particles.

    Args:
        values: one row per particle, `[M, K]`.

    Returns:
        `d_ij = |v_i - v_j|^2 / K`, `[M, M]`, 0 on the diagonal. Centred first: without that, float32 loses
        all digits of a spread of 1e-3 around 3.
    """
    centred = values - jnp.mean(values, axis=0, keepdims=True)
    gram = centred @ centred.T
    norms = jnp.diagonal(gram)
    distances = jnp.maximum(norms[:, None] + norms[None, :] - 2.0 * gram, 0.0) / values.shape[1]
    return distances * (1.0 - jnp.eye(values.shape[0]))


def bandwidth(distances: Array, config: SVGDConfig) -> Array:
    """The kernel's h, a scalar, without a gradient.

    The diagonal stays out of the median, and no gradient flows: through a median the repulsion would lose its radial
    part, and nothing would resist collapse.
    """
    num = distances.shape[0]
    if config.bandwidth == "fixed" or num == 1:
        return jnp.asarray(config.bandwidth_scale, distances.dtype)
    pairs = distances[jnp.triu_indices(num, 1)]
    centre = jnp.mean(pairs) if config.bandwidth == "mean" else jnp.median(pairs)
    # log 1 = 0 cannot divide; two particles are the fewest that reach this line.
    divisor = math.log(num) if config.bandwidth == "median_log" else 1.0
    return jax.lax.stop_gradient(jnp.maximum(config.bandwidth_scale * centre / divisor, MIN_BANDWIDTH))


def stein_direction(scores: Array, repulsion_values: Array, config: SVGDConfig) -> SteinDirection:
    """phi* of equation 6, with the drive on the data's values and the repulsion on the repulsion points' values.

    Args:
        scores: gradient of the log-likelihood of each particle with respect to its own values on the data,
            `[M, n, O]`.
        repulsion_values: each particle's values at the points the kernel compares them on, `[M, r, O]`.
        config: kernel, bandwidth and self weight.

    Returns:
        A `SteinDirection`. On particles that are free to move (no generator) with the same points in both roles,
        `drive + repulsion` is the update of Liu & Wang (2016).

    Raises:
        FieldError: scores and values of other shapes, or of different numbers of particles.

    Example:
        Two particles that both fit perfectly move apart:

        >>> import jax.numpy as jnp
        >>> values = jnp.array([[[0.0]], [[1.0]]])
        >>> direction = stein_direction(jnp.zeros_like(values), values, SVGDConfig(num_particles=2))
        >>> bool(direction.repulsion[0, 0, 0] < 0 < direction.repulsion[1, 0, 0])
        True
    """
    validate.shape("repulsion_values", repulsion_values, "M", "r", "O")
    num = repulsion_values.shape[0]
    validate.shape("scores", scores, num, "n", repulsion_values.shape[2])
    # A lone particle has nobody else's score to follow.
    self_weight = 1.0 if num == 1 else config.self_weight
    norm = num - 1 + self_weight
    eye = jnp.eye(num)

    def one_kernel(score: Array, values: Array) -> tuple[Array, Array, Array, Array, Array]:
        """`score [M, n * outputs]`, `values [M, r * outputs]`."""
        distances = squared_distances(values)
        h = bandwidth(distances, config)
        if config.kernel == "rbf":
            kernel = jnp.exp(-distances / h)
            slope = kernel / h
        else:
            kernel = (1.0 + distances / h) ** -0.5
            slope = 0.5 / h * (1.0 + distances / h) ** -1.5
        weights = (kernel * (1.0 - eye) + self_weight * eye) / norm
        pull = jnp.sum(slope, axis=1)[:, None] * values - slope @ values
        repulsion = 2.0 / values.shape[1] * pull / norm
        kernel_mean = jnp.sum(kernel * (1.0 - eye)) / max(num * (num - 1), 1)
        return weights @ score, repulsion, weights, h, kernel_mean

    if config.kernel_outputs == "joint":
        drive, repulsion, weights, h, kernel_mean = one_kernel(
            scores.reshape(num, -1), repulsion_values.reshape(num, -1)
        )
        return SteinDirection(
            drive.reshape(scores.shape), repulsion.reshape(repulsion_values.shape), weights, h, kernel_mean
        )
    outputs = jax.vmap(one_kernel, in_axes=2, out_axes=(2, 2, 0, 0, 0))(scores, repulsion_values)
    drive, repulsion, weights, h, kernel_mean = outputs
    return SteinDirection(drive, repulsion, jnp.mean(weights, axis=0), jnp.mean(h), jnp.mean(kernel_mean))


@struct.dataclass
class SVGDState:
    """What amortised SVGD carries."""

    eta: Params
    """Parameters of the generator."""
    opt_state: optax.OptState
    likelihood_var: Array
    """sigma^2 per output, `[O]`."""
    z: Array
    """The noise in use where it is fixed, `[M, Z]`; otherwise the last one drawn."""


class AmortizedSVGD(NamedTuple):
    """Pure functions of one amortised posterior."""

    init: Callable[[Key], SVGDState]
    """`init(key) -> state`."""
    update: Callable[..., tuple[SVGDState, Metrics]]
    """`update(key, state, inputs [B, I], targets [B, O], num_data, extra_inputs=None, weights=None)`, jitted, gives
    `(state, metrics)`; inputs and targets are `[M, B, ...]` where `batches="own"`."""


class SVGDSpec(NamedTuple):
    """The fixed parts of one amortised posterior, which its functions take first; see `make_amortized_svgd`."""

    generator: Generator
    apply: Callable[[Params, Array], Array]
    """`apply(theta, inputs [B, I]) -> [B, O]`, one network on a batch."""
    num_outputs: int
    """`O`"""
    optimizer: optax.GradientTransformation
    """Of eta."""
    config: SVGDConfig
    repulsion_inputs: Callable[[Key, Array], Array] | None = None
    """`(key, inputs [B, I]) -> [R, I]`; replaces `config.repulsion_points`."""

    @property
    def stands_in(self) -> bool:
        """Whether the repulsion points stand in for the batch (an independent one) rather than join it."""
        return self.config.repulsion_points == "independent" and self.repulsion_inputs is None


def init(spec: SVGDSpec, key: Key) -> SVGDState:
    """A state with a freshly initialised generator; see `AmortizedSVGD.init`."""
    eta_key, noise_key = jax.random.split(key)
    eta = spec.generator.init(eta_key)
    return SVGDState(
        eta=eta,
        opt_state=spec.optimizer.init(eta),
        likelihood_var=jnp.full(spec.num_outputs, spec.config.likelihood_std**2),
        z=spec.generator.sample_noise(noise_key, spec.config.num_particles),
    )


def further_points(spec: SVGDSpec, key: Key, inputs: Array, extra_inputs: Array | None) -> Array | None:
    """Further points `[r, I]` that the networks run on, beside the batch `inputs [B, I]`; None for none."""
    config = spec.config
    if spec.repulsion_inputs is not None:
        return spec.repulsion_inputs(key, inputs)
    if config.repulsion_points == "perturbed":
        return inputs + config.repulsion_scale * jax.random.normal(key, inputs.shape)
    if config.repulsion_points == "uniform":
        shape = (config.num_repulsion_points, inputs.shape[1])
        return jax.random.uniform(key, shape, minval=-config.repulsion_scale, maxval=config.repulsion_scale)
    if config.repulsion_points == "independent":
        if extra_inputs is None:
            raise ValueError("repulsion_points='independent' needs extra_inputs, a second batch [B, I].")
        return extra_inputs
    return None


def _check_batch(spec: SVGDSpec, inputs: Array, targets: Array, extra_inputs: Array | None) -> None:
    if spec.config.batches == "own":
        num = spec.config.num_particles
        validate.shape("inputs", inputs, num, "B", "I")
        validate.shape("targets", targets, num, jnp.shape(inputs)[1], spec.num_outputs)
        return
    shapes = {"inputs": jnp.shape(inputs), "targets": jnp.shape(targets)}
    if len(shapes["inputs"]) != 2 or not shapes["inputs"][0]:
        raise FieldError("inputs", shapes["inputs"], "shape [B, I] with B of 1 or more", "is their shape")
    wanted = (shapes["inputs"][0], spec.num_outputs)
    if shapes["targets"] != wanted:
        raise FieldError("targets", shapes["targets"], f"shape {wanted}", "is their shape")
    if extra_inputs is not None and jnp.shape(extra_inputs)[1:] != shapes["inputs"][1:]:
        allowed = f"shape [B, {shapes['inputs'][1]}], as the inputs"
        raise FieldError("extra_inputs", jnp.shape(extra_inputs), allowed, "is their shape")


def update(
    spec: SVGDSpec,
    key: Key,
    state: SVGDState,
    inputs: Array,
    targets: Array,
    num_data: int | Array,
    extra_inputs: Array | None = None,
    weights: Array | None = None,
) -> tuple[SVGDState, Metrics]:
    """Draw m networks and move eta once; see `AmortizedSVGD.update` and `make_amortized_svgd`.

    Args:
        spec: the fixed parts.
        key: consumed.
        state: before the update.
        inputs: the batch, `[B, I]`; one for each network, `[M, B, I]`, where `batches="own"`.
        targets: `[B, O]`, or `[M, B, O]`.
        num_data: N, of which the batch is a part.
        extra_inputs: a second batch `[B, I]`, for `repulsion_points="independent"`.
        weights: how much each datum of the batch counts, `[B]` or `[M, B]`, of mean 1; by default all count 1.

    Returns:
        `(state, metrics)`.

    Raises:
        FieldError: an empty batch, or inputs and targets that do not go together.
    """
    config, generator = spec.config, spec.generator
    _check_batch(spec, inputs, targets, extra_inputs)
    noise_key, points_key = jax.random.split(key)
    z = state.z if config.redraw == "fixed" else generator.sample_noise(noise_key, config.num_particles)
    if config.batches == "own":
        return _update_apart(spec, state, z, inputs, targets, num_data, weights)
    batch_size = inputs.shape[0]
    further = further_points(spec, points_key, inputs, extra_inputs)
    all_inputs = inputs if further is None else jnp.concatenate([inputs, further])

    thetas, to_eta = jax.vjp(lambda eta: generator.sample(eta, z), state.eta)
    values, to_theta = jax.vjp(lambda thetas: jax.vmap(spec.apply, in_axes=(0, None))(thetas, all_inputs), thetas)
    start = batch_size if spec.stands_in else 0
    repulsion_values, repulsion_points = values[:, start:], all_inputs[start:]

    num_data = jnp.asarray(num_data, jnp.float32)
    temperature = config.temperature * (num_data if config.tempering == "per_datum" else 1.0)
    residuals = targets[None] - values[:, :batch_size]
    scores = num_data / batch_size / temperature * residuals / state.likelihood_var[None, None]
    scores = scores if weights is None else weights[None, :, None] * scores
    direction = stein_direction(scores, repulsion_values, config)

    repulsion = direction.repulsion
    if config.prior == "gp":
        prior_scores = _gp_scores(repulsion_points, repulsion_values, config)
        repulsion = repulsion + jnp.einsum("ij,jro->iro", direction.weights, prior_scores)
    if spec.stands_in:
        value_move = jnp.concatenate([direction.drive, repulsion], axis=1)
    else:
        value_move = repulsion.at[:, :batch_size].add(direction.drive)
    (theta_move,) = to_theta(value_move)
    if config.prior == "weights":
        theta_move = jax.tree.map(jnp.add, theta_move, _weight_prior_move(thetas, direction.weights, config))
    (eta_move,) = to_eta(theta_move)
    gradient = jax.tree.map(lambda move: -temperature / (config.num_particles * num_data) * move, eta_move)
    after, metrics = _step(spec, state, z, gradient, residuals)
    return after, {
        **metrics,
        "variance": jnp.mean(jnp.var(values[:, :batch_size], axis=0)),
        "repulsion_variance": jnp.mean(jnp.var(repulsion_values, axis=0)),
        "bandwidth": direction.bandwidth,
        "kernel_mean": direction.kernel_mean,
    }


def _update_apart(
    spec: SVGDSpec,
    state: SVGDState,
    z: Array,
    inputs: Array,
    targets: Array,
    num_data: int | Array,
    weights: Array | None,
) -> tuple[SVGDState, Metrics]:
    """`update` where each network of noise `z` follows its own score on a batch of its own, `[M, B, ...]`."""
    config = spec.config
    thetas, to_eta = jax.vjp(lambda eta: spec.generator.sample(eta, z), state.eta)
    values, to_theta = jax.vjp(lambda thetas: jax.vmap(spec.apply)(thetas, inputs), thetas)
    residuals = targets - values
    scores = residuals / state.likelihood_var[None, None]
    (theta_move,) = to_theta(scores if weights is None else weights[..., None] * scores)
    if config.prior == "weights":
        # Beside the data's mean the prior counts T / N, or T where T is for one datum.
        weight = inputs.shape[1] * config.temperature / (1.0 if config.tempering == "per_datum" else num_data)
        prior_move = _weight_prior_move(thetas, jnp.eye(config.num_particles), config)
        theta_move = jax.tree.map(lambda move, prior: move + weight * prior, theta_move, prior_move)
    (eta_move,) = to_eta(theta_move)
    gradient = jax.tree.map(lambda move: -move / (config.num_particles * inputs.shape[1]), eta_move)
    return _step(spec, state, z, gradient, residuals)


def _step(spec: SVGDSpec, state: SVGDState, z: Array, gradient: Params, residuals: Array) -> tuple[SVGDState, Metrics]:
    """Eta's step down `gradient`, where networks of noise `z` missed targets by `residuals [M, B, O]`, and what every
    update reports.
    """
    config, generator = spec.config, spec.generator
    steps, opt_state = spec.optimizer.update(gradient, state.opt_state, state.eta)
    likelihood_var = state.likelihood_var
    if config.learn_likelihood_std:
        likelihood_var = _follow_residuals(likelihood_var, residuals, config)
    metrics = {
        "loss": jnp.mean(residuals**2),
        "likelihood_std": jnp.mean(jnp.sqrt(likelihood_var)),
        "gradient_norm": optax.tree.norm(gradient),
    }
    if generator.features is not None:
        # Not on `z`, of which there may be one or two.
        judges = generator.sample_noise(jax.random.key(0), NUM_JUDGES)
        metrics["dead_features"] = dead_share(generator.features(state.eta, judges))
    eta = optax.apply_updates(state.eta, steps)
    return SVGDState(eta=eta, opt_state=opt_state, likelihood_var=likelihood_var, z=z), metrics


def _follow_residuals(likelihood_var: Array, residuals: Array, config: SVGDConfig) -> Array:
    """sigma^2 `[O]` one step closer to the mean square of `residuals [M, B, O]`."""
    observed = jnp.mean(residuals**2, axis=(0, 1))
    floor = config.likelihood_std_floor**2
    return jnp.maximum(0.99 * likelihood_var + 0.01 * observed, floor)


def _weight_prior_move(thetas: Params, weights: Array, config: SVGDConfig) -> Params:
    """Kernel-averaged score of the Gaussian weight prior, shaped like `thetas`."""

    def leaf_move(theta: Array) -> Array:
        one = theta[0]
        std = config.prior_scale * math.sqrt(2.0 / fan_in(one)) if one.ndim >= 2 else config.prior_bias_std
        flat = theta.reshape(theta.shape[0], -1)
        return (weights @ (-flat / std**2)).reshape(theta.shape)

    return jax.tree.map(leaf_move, thetas)


def _gp_scores(points: Array, values: Array, config: SVGDConfig) -> Array:
    """Score of a zero-mean Gaussian process prior at `points [r, I]`, for `values [M, r, O]`."""
    distances = jnp.sum((points[:, None, :] - points[None, :, :]) ** 2, axis=-1)
    covariance = config.prior_scale**2 * jnp.exp(-0.5 * distances / config.prior_lengthscale**2)
    # A relative nugget keeps the Cholesky factor real in float32 where points nearly coincide.
    covariance = covariance + 1e-4 * config.prior_scale**2 * jnp.eye(points.shape[0])
    factor = jax.scipy.linalg.cho_factor(covariance)
    flat = jnp.moveaxis(values, 0, 2).reshape(points.shape[0], -1)
    scores = -jax.scipy.linalg.cho_solve(factor, flat)
    return jnp.moveaxis(scores.reshape(points.shape[0], values.shape[2], values.shape[0]), 2, 0)


def make_amortized_svgd(
    generator: Generator,
    apply: Callable[[Params, Array], Array],
    num_outputs: int,
    optimizer: optax.GradientTransformation,
    config: SVGDConfig | None = None,
    repulsion_inputs: Callable[[Key, Array], Array] | None = None,
) -> AmortizedSVGD:
    """Make the update that trains a generator towards the posterior over networks.

    Args:
        generator: of networks that `apply` runs.
        apply: `apply(theta, inputs [B, I]) -> [B, O]`, one network on a batch.
        num_outputs: `O`.
        optimizer: optax transformation for eta. The gradient it sees is scaled by T / (m N), so its size is that of
            a mean squared error's, whatever the data's number and the temperature.
        config: the paper's choices by default.
        repulsion_inputs: your own rule for further repulsion points, `(key, inputs [B, I]) -> [R, I]`; they join the
            batch's own. Replaces `config.repulsion_points`.

    Returns:
        `AmortizedSVGD(init, update)`. `update` draws m networks, moves eta once, and reports `loss` (mean squared
        error per output), `variance` (of the networks' predictions on the batch, mean over points and outputs),
        `repulsion_variance` (the same at the repulsion points: watch it for growth), `bandwidth`, `kernel_mean`,
        `likelihood_std` and `gradient_norm`. With `batches="own"` there is nothing to compare networks on: it reports
        `loss`, `likelihood_std` and `gradient_norm`.

    Warns:
        UserWarning: points beyond the data with a flat prior: no posterior exists there, the variance keeps growing.

    Example:
        >>> import jax, jax.numpy as jnp, optax
        >>> from jaxplore.networks import MLP
        >>> from jaxplore.beliefs.generator import make_generator
        >>> net = MLP(hidden=(16,), output_size=1)
        >>> apply = lambda theta, x: net.apply({"params": theta}, x)
        >>> generator = make_generator(net.init(jax.random.key(0), jnp.zeros(1))["params"])
        >>> posterior = make_amortized_svgd(generator, apply, 1, optax.adam(1e-3))
        >>> state = posterior.init(jax.random.key(1))
        >>> x = jnp.linspace(-1.0, 1.0, 20)[:, None]
        >>> state, metrics = posterior.update(jax.random.key(2), state, x, jnp.sin(3 * x), num_data=20)
        >>> thetas = generator.sample(state.eta, generator.sample_noise(jax.random.key(3), 8))
    """
    config = config or SVGDConfig()
    beyond_data = repulsion_inputs is not None or config.repulsion_points in ("perturbed", "uniform")
    if beyond_data and config.prior == "flat" and not config.accept_improper:
        warnings.warn(
            "Repulsion points beyond the data with prior='flat': no proper posterior exists there and the variance "
            "grows without bound in a long run. Use prior='weights', or watch the metric 'repulsion_variance' and "
            "set accept_improper.",
            UserWarning,
            stacklevel=2,
        )
    spec = SVGDSpec(generator, apply, num_outputs, optimizer, config, repulsion_inputs)
    jitted = jax.jit(partial(update, spec))

    def checked_update(
        key: Key,
        state: SVGDState,
        inputs: Array,
        targets: Array,
        num_data: int | Array,
        extra_inputs: Array | None = None,
        weights: Array | None = None,
    ) -> tuple[SVGDState, Metrics]:
        # Here, where it may still be known: within the program it is not.
        if validate.known(num_data) and not np.all(np.asarray(num_data) > 0):
            raise FieldError("num_data", num_data, "1 or more, the data that the batch is a part of", "is out of range")
        return jitted(key, state, inputs, targets, num_data, extra_inputs, weights)

    return AmortizedSVGD(init=partial(init, spec), update=checked_update)
