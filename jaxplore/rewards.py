"""Intrinsic rewards, read off what m networks predict.

Each takes a `Prediction` with `[M, N, O]` means, in normalised-delta units, and gives one reward per transition,
`[N]`. They know nothing of where the networks came from.
"""

import jax.numpy as jnp

from jaxplore.dynamics import Prediction
from jaxplore.types import Array


def variance(prediction: Prediction, delta_std: Array | None = None) -> Array:
    """Disagreement: equation 1 of Ratzlaff et al. (2020).

    `r = (1/m) sum_i |f_i - mean f|^2`: the population variance over *models*, summed over observation entries.

    Args:
        prediction: of m models, `[M, N, O]`.
        delta_std: standard deviations of the change of the observation, `[O]`. Given, the reward is in the
            observation's raw units squared; by default it is in normalised-delta units.

    Returns:
        `[N]`, at least 0.

    Example:
        >>> import jax.numpy as jnp
        >>> float(variance(Prediction(jnp.array([[[0.0, 0.0]], [[2.0, 2.0]]])))[0])
        2.0
    """
    spread = jnp.var(prediction.mean, axis=0)
    if delta_std is not None:
        spread = spread * delta_std[None, :] ** 2
    return jnp.sum(spread, axis=-1)
