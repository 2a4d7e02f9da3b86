"""Intrinsic rewards, read off what m networks predict.

Each takes a `Prediction` with `[M, N, O]` means, in normalised-delta units, or the change that happened, and gives one
reward per transition, `[N]`. They know nothing of where the networks came from.
"""

import math

import jax
import jax.numpy as jnp

from jaxplore import validate
from jaxplore.dynamics import LOG_VAR_BOUNDS, Prediction
from jaxplore.types import Array
from jaxplore.validate import FieldError

MIN_VAR, MAX_VAR = math.exp(LOG_VAR_BOUNDS[0]), math.exp(LOG_VAR_BOUNDS[1])
"""Smallest and largest variance that a Gaussian network states, per squared unit of normalised delta."""


def _check(prediction: Prediction) -> None:
    """Raise unless a prediction is of one model or more."""
    mean, var = jnp.shape(prediction.mean), prediction.var
    if len(mean) != 3 or not mean[0]:
        raise FieldError("prediction.mean", mean, "shape [M, N, O] with M of 1 or more", "is its shape")
    if var is not None and jnp.shape(var) != mean:
        raise FieldError("prediction.var", jnp.shape(var), f"shape {mean}, as the mean", "is its shape")


def variance(prediction: Prediction, delta_std: Array | None = None) -> Array:
    """Disagreement: equation 1 of Ratzlaff et al. (2020).

    `r = (1/m) sum_i |f_i - mean f|^2`: the population variance over *models*, summed over observation entries.

    Args:
        prediction: of m models, `[M, N, O]`.
        delta_std: standard deviations of the change of the observation, `[O]`. Given, the reward is in the
            observation's raw units squared; by default it is in normalised-delta units.

    Returns:
        `[N]`, at least 0.

    Raises:
        FieldError: a prediction of another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> float(variance(Prediction(jnp.array([[[0.0, 0.0]], [[2.0, 2.0]]])))[0])
        2.0
    """
    _check(prediction)
    spread = jnp.var(prediction.mean, axis=0)
    if delta_std is not None:
        validate.shape("delta_std", delta_std, prediction.mean.shape[2])
        spread = spread * delta_std[None, :] ** 2
    return jnp.sum(spread, axis=-1)


def variance_within(prediction: Prediction, num_groups: int) -> Array:
    """How far apart models of one group are: those that one of several generators draws.

    The unbiased variance over the models of a group, summed over observation entries, its mean over groups. Beside
    `variance` it tells how much of the disagreement is a generator's own: 0 where all its draws are one network.

    Args:
        prediction: of m models, `[M, N, O]`, those of a group one after the other.
        num_groups: K, of equal size, at least 2 models each.

    Returns:
        `[N]`, at least 0, in the prediction's units squared.

    Raises:
        FieldError: a prediction of another shape, or a number of groups that leaves no pairs.

    Example:
        >>> import jax.numpy as jnp
        >>> models = jnp.array([[[0.0]], [[2.0]], [[5.0]], [[5.0]]])
        >>> float(variance_within(Prediction(models), 2)[0])
        1.0
    """
    _check(prediction)
    num = prediction.mean.shape[0]
    if num_groups < 1 or num % num_groups or num // num_groups < 2:
        raise FieldError("num_groups", num_groups, f"a divisor of {num} models that leaves 2 or more in each")
    groups = prediction.mean.reshape(num_groups, num // num_groups, *prediction.mean.shape[1:])
    return jnp.sum(jnp.mean(jnp.var(groups, axis=1, ddof=1), axis=0), axis=-1)


def jensen_renyi(prediction: Prediction, decay: float = 0.1) -> Array:
    """Jensen-Renyi divergence of order 2 between Gaussian predictions (Shyam et al. 2019; nnaisense/max).

    The entropy of the mixture of all m Gaussians less their mean entropy, both Renyi's of order 2, in nats:

        -log (1/m^2) sum_ij N(f_i - f_j; 0, V_i + V_j)  -  (1/m) sum_i (log |4 pi V_i|) / 2

    nnaisense/max first moves each variance v towards the largest that a network can state, to
    `MAX_VAR - decay (MAX_VAR - v)`: with its decay of 0.1 the divergence says little but how far the means
    lie apart, and is about 1.4 times `variance` where that is small.

    Args:
        prediction: of m models, `[M, N, O]`. Networks that state no variance count as if they stated `MIN_VAR`.
        decay: in (0, 1]. 1: the variances as they are stated.

    Returns:
        `[N]`, at most ln m. At least 0 where all models state the same variance; Renyi's entropy of order 2 is not
        concave, so where variances differ and means do not it falls a little below.

    Raises:
        FieldError: `decay` outside of (0, 1], or a prediction of another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> apart = Prediction(jnp.array([[[0.0]], [[100.0]]]))
        >>> round(float(jensen_renyi(apart)[0]), 4)  # ln 2
        0.6931
    """
    _check(prediction)
    if validate.known(decay):
        validate.in_range("decay", float(decay), 0.0, 1.0, open_low=True)
    # Entries first: sums over them then run over whole rows of models and transitions.
    mean = jnp.moveaxis(prediction.mean, -1, 0)
    stated = jnp.full_like(mean, MIN_VAR) if prediction.var is None else jnp.moveaxis(prediction.var, -1, 0)
    var = MAX_VAR - decay * (MAX_VAR - stated)
    num = mean.shape[1]

    def log_overlaps(shift: Array) -> Array:
        """Of each model i with model i + shift: log N(f_i - f_j; 0, V_i + V_j) plus O log(4 pi) / 2, `[M, N]`."""
        total = var + jnp.roll(var, shift, axis=1)
        distance = jnp.sum((mean - jnp.roll(mean, shift, axis=1)) ** 2 / total, axis=0)
        return -0.5 * (distance + _sum_of_logs(0.5 * total))

    # One shift at a time: all pairs at once are m times the predictions' memory. Shifts up to m / 2 meet each pair
    # once, and twice where shift and m - shift are the same.
    own = -0.5 * _sum_of_logs(var)
    shifts = jnp.arange(1, num // 2 + 1)
    twice = jnp.where(2 * shifts == num, 0.0, math.log(2.0))[:, None, None]
    overlaps = jnp.concatenate([own[None], jax.lax.map(log_overlaps, shifts) + twice])
    return 2.0 * math.log(num) - jax.nn.logsumexp(overlaps, axis=(0, 1)) + jnp.mean(own, axis=0)


def _sum_of_logs(var: Array) -> Array:
    """Sum over the first axis of log `var`. Logarithms are most of the divergence's cost, so products of eight are
    taken first; even of the smallest variances they stay far from float32's smallest number.
    """
    return sum((jnp.log(jnp.prod(var[i : i + 8], axis=0)) for i in range(0, len(var), 8)), jnp.zeros(var.shape[1:]))


def jensen_shannon(prediction: Prediction) -> Array:
    """Jensen-Shannon divergence between predicted probabilities: what MAX seeks where states are finitely many.

    The entropy of the models' mean less their mean entropy, in nats.

    Args:
        prediction: of m models; means are probabilities, `[M, N, O]`.

    Returns:
        `[N]`, in [0, ln m].

    Raises:
        FieldError: a prediction of another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> certain = Prediction(jnp.array([[[1.0, 0.0]], [[0.0, 1.0]]]))
        >>> round(float(jensen_shannon(certain)[0]), 4)  # ln 2
        0.6931
    """
    _check(prediction)
    entropy = jnp.sum(jax.scipy.special.entr(prediction.mean), axis=-1)
    mixture = jnp.sum(jax.scipy.special.entr(jnp.mean(prediction.mean, axis=0)), axis=-1)
    return mixture - jnp.mean(entropy, axis=0)


def information_gain(prediction: Prediction, noise_std: float = 1e-3) -> Array:
    """How much more than noise the models disagree: `sum_o log(1 + V_o / s_o^2)` (Sukhija et al. 2024).

    `V_o` is the population variance of the models' means and `s_o^2` that of the noise. If the true change were a
    Gaussian of variance V, independent in each entry, half of this would be what observing it in that noise tells.

    Args:
        prediction: of m models, `[M, N, O]`. Where they state variances, the noise is their mean.
        noise_std: standard deviation of the noise, per entry in units of the prediction, where models state none; no
            stated noise counts as less. Sukhija et al.'s code: 1e-3.

    Returns:
        `[N]`, nats, at least 0.

    Raises:
        FieldError: a prediction of another shape, or no noise at all.

    Example:
        >>> import jax.numpy as jnp
        >>> apart = Prediction(jnp.array([[[0.0, 1.0]], [[2.0, 1.0]]]))  # variances 1 and 0
        >>> round(float(information_gain(apart, noise_std=1.0)[0]), 4)  # ln 2
        0.6931
    """
    _check(prediction)
    if validate.known(noise_std):
        validate.in_range("noise_std", float(noise_std), 0.0, open_low=True)
    spread = jnp.var(prediction.mean, axis=0)
    noise = noise_std**2
    if prediction.var is not None:
        noise = jnp.maximum(jnp.mean(prediction.var, axis=0), noise)
    return jnp.sum(jnp.log1p(spread / noise), axis=-1)


def prediction_error(prediction: Prediction, delta: Array, scale: Array | None = None) -> Array:
    """How far the models' mean is from what happened: `sum_o (mean_i f_io - delta_o)^2`.

    Only real transitions have something that happened. Against a model's own imagination this is on average the
    `variance` of the models.

    Args:
        prediction: of m models, `[M, N, O]`.
        delta: the change that happened, `[N, O]`, normalised.
        scale: the length of one unit of normalised delta in the units wanted, `[O]`. nnaisense/max counts in standard
            deviations of the observation: `delta std / obs std`. By default normalised delta.

    Returns:
        `[N]`, at least 0.

    Raises:
        FieldError: a prediction, change or scale of another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> prediction = Prediction(jnp.array([[[0.0, 0.0]], [[2.0, 0.0]]]))
        >>> float(prediction_error(prediction, jnp.array([[0.0, 3.0]]))[0])
        10.0
    """
    _check(prediction)
    validate.shape("delta", delta, *prediction.mean.shape[1:])
    error = jnp.mean(prediction.mean, axis=0) - delta
    if scale is not None:
        validate.shape("scale", scale, prediction.mean.shape[2])
        error = error * scale[None]
    return jnp.sum(error**2, axis=-1)


def trajectory_spread(delta: Array) -> Array:
    """How far apart the changes are that actors side by side met: `sum_o std_n delta_no` (nnaisense/max's TVAX).

    Args:
        delta: the changes that happened, `[N, O]`, normalised; one row per actor.

    Returns:
        `[N]`, the same number for every actor: the unbiased standard deviation over actors, summed over entries; 0 for
        a single actor.

    Raises:
        FieldError: changes of another shape.

    Example:
        >>> import jax.numpy as jnp
        >>> trajectory_spread(jnp.array([[0.0], [2.0]])).tolist()
        [1.4142135381698608, 1.4142135381698608]
    """
    validate.shape("delta", delta, "N", "O")
    num_actors = delta.shape[0]
    if num_actors < 2:
        return jnp.zeros(num_actors)
    return jnp.full(num_actors, jnp.sum(jnp.std(delta, axis=0, ddof=1)))
