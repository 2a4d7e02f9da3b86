"""Functions drawn from a Gaussian process: a belief is fitted to noisy values of one, and what it believes elsewhere is
compared with the exact posterior.

A function of two inputs, of unit variance and a length-scale of one, is seen at `NUM_DATA` points of a standard normal
distribution with noise of standard deviation `NOISE`. At `NUM_TEST` further points of a distribution twice as wide, so
that many are where no data are, the divergence KL(exact || belief) is taken of single points, and of ten points at a
time, where it also matters which errors go together.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.analysis.tables import text_table
from jaxplore import dynamics, normalizer
from jaxplore.beliefs.base import Belief
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.methods import METHODS
from jaxplore.types import Array, Transition

NUM_DATA, NUM_TEST, TOGETHER = 60, 200, 10
NOISE, LENGTH = 0.1, 1.0
FUNCTIONS = 4
"""Functions that one figure is the mean of."""
FLOOR = 1e-3
"""Variance that is added to both sides: 32 draws of ten points at a time would otherwise be singular at times."""


class Divergences(NamedTuple):
    """Nats, means over points and functions."""

    single: float
    """KL(exact || belief) at one point."""
    together: float
    """KL(exact || belief) at ten points at a time."""
    error: float
    """Squared error of the belief's mean against the exact mean."""
    spread: float
    """Geometric mean of the belief's standard deviation over the exact one."""


class Problem(NamedTuple):
    """One function: data, test points, and the exact posterior there."""

    inputs: np.ndarray
    """`[NUM_DATA, 2]`"""
    values: np.ndarray
    """`[NUM_DATA]`, with noise."""
    test: np.ndarray
    """`[NUM_TEST, 2]`"""
    mean: np.ndarray
    """`[NUM_TEST]`"""
    covariance: np.ndarray
    """`[NUM_TEST, NUM_TEST]`"""


def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Covariance of the function's values, `[N, M]`."""
    squared = np.sum((a[:, None] - b[None]) ** 2, axis=-1)
    return np.exp(-0.5 * squared / LENGTH**2)


def draw_problem(seed: int) -> Problem:
    """A function and its exact posterior."""
    rng = np.random.default_rng(seed)
    inputs, test = rng.normal(size=(NUM_DATA, 2)), 2.0 * rng.normal(size=(NUM_TEST, 2))
    prior = kernel(inputs, inputs)
    function = np.linalg.cholesky(prior + 1e-9 * np.eye(NUM_DATA)) @ rng.normal(size=NUM_DATA)
    values = function + NOISE * rng.normal(size=NUM_DATA)
    seen = prior + NOISE**2 * np.eye(NUM_DATA)
    across = kernel(test, inputs)
    mean = across @ np.linalg.solve(seen, values)
    covariance = kernel(test, test) - across @ np.linalg.solve(seen, across.T)
    return Problem(inputs, values, test, mean, covariance)


def divergence(mean: np.ndarray, covariance: np.ndarray, own_mean: np.ndarray, own_covariance: np.ndarray) -> float:
    """KL(N(mean, covariance) || N(own)) in nats, of `K` points.

    Example:
        >>> import numpy as np
        >>> round(divergence(np.zeros(1), np.eye(1), np.ones(1), np.eye(1)), 6)
        0.5
    """
    own = np.linalg.inv(own_covariance)
    away = own_mean - mean
    logs = np.linalg.slogdet(own_covariance)[1] - np.linalg.slogdet(covariance)[1]
    return float(0.5 * (np.trace(own @ covariance) + away @ own @ away - len(mean) + logs))


def divergences(method: str, config: ExplorationConfig, steps: int, seed: int) -> Divergences:
    """What the belief of a method comes to, over `FUNCTIONS` functions."""
    from benchmarks.beliefs import make_fit

    belief = METHODS[method].signal(Sizes(1, 1), config).belief
    fit = make_fit(belief)
    found = [_one(belief, fit, steps, seed * FUNCTIONS + i) for i in range(FUNCTIONS)]
    return Divergences(*(float(np.mean(column)) for column in zip(*found, strict=True)))


def _one(belief: Belief, fit: Callable[..., Any], steps: int, seed: int) -> tuple[float, float, float, float]:
    problem = draw_problem(seed)
    # One input stands for the observation, the other for the action, and the value for the change.
    data = _as_transitions(problem.inputs, problem.values)
    normalizers = dynamics.Normalizers(*(normalizer.init(1) for _ in range(3)))
    state = fit(data, normalizers, steps, seed).state
    models = jax.jit(belief.sample, static_argnums=2)(jax.random.key(seed), state, belief.num_models)
    test = _as_transitions(problem.test, np.zeros(NUM_TEST))
    prediction: Any = jax.jit(lambda models: belief.imagine(models, normalizers, test.obs, test.action))(models)
    draws = np.asarray(prediction.mean, float)[:, :, 0]
    own_mean, own_covariance = draws.mean(axis=0), np.atleast_2d(np.cov(draws.T, ddof=1))
    floor = FLOOR * np.eye(NUM_TEST)
    exact, own = problem.covariance + floor, own_covariance + floor
    single = [
        divergence(problem.mean[i : i + 1], exact[i : i + 1, i : i + 1], own_mean[i : i + 1], own[i : i + 1, i : i + 1])
        for i in range(NUM_TEST)
    ]
    together = []
    for start in range(0, NUM_TEST, TOGETHER):
        at = slice(start, start + TOGETHER)
        together.append(divergence(problem.mean[at], exact[at, at], own_mean[at], own[at, at]))
    spread = np.exp(0.5 * np.mean(np.log(np.diag(own)) - np.log(np.diag(exact))))
    error = np.mean((own_mean - problem.mean) ** 2)
    return float(np.mean(single)), float(np.mean(together)), float(error), float(spread)


def _as_transitions(inputs: np.ndarray, values: np.ndarray) -> Transition:
    obs, action = inputs[:, :1].astype(np.float32), inputs[:, 1:].astype(np.float32)
    flags: Array = jnp.zeros(len(obs), bool)
    next_obs = obs + values[:, None].astype(np.float32)
    return Transition(jnp.asarray(obs), jnp.asarray(action), jnp.zeros(len(obs)), jnp.asarray(next_obs), flags, flags)


def table(found: Sequence[Divergences]) -> str:
    """The figures as text: means over fits."""
    head = ("Gaussian process", "KL, one point", "KL, ten at a time", "error of the mean", "spread over exact")
    means = [float(np.mean(column)) for column in zip(*found, strict=True)]
    count = f"{len(found) * FUNCTIONS} functions"
    return text_table(head, [(count, f"{means[0]:.2f}", f"{means[1]:.1f}", f"{means[2]:.3f}", f"{means[3]:.2f}")])
