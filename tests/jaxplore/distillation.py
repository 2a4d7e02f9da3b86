"""Random network distillation written out in NumPy."""

from typing import Any

import numpy as np

from jaxplore.signals.distillation import RNDState


def _run(params: Any, x: np.ndarray) -> np.ndarray:
    """A leaky-ReLU network."""
    for name in sorted(name for name in params if name.startswith("hidden_")):
        x = x @ params[name]["kernel"] + params[name]["bias"]
        x = np.where(x > 0, x, 0.01 * x)
    return x @ params["output"]["kernel"] + params["output"]["bias"]


def error(state: RNDState, obs: np.ndarray) -> np.ndarray:
    """Mean squared error of the predictor over features, `[N]`, for `obs [N, O]` that is clipped at 5."""
    seen = np.clip(obs, -5, 5)
    return np.mean((_run(state.target, seen) - _run(state.predictor, seen)) ** 2, axis=-1)
