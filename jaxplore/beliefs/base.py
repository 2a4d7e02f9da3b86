"""Beliefs over the dynamics: what a method knows of the environment, and how it learns from data.

A belief is a named tuple of pure functions. `sample` draws m models from it, `predict` runs them, `update` takes one
gradient step on the replay, `fit` as many as a round has. A new belief is a new factory with this shape.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxplore import validate
from jaxplore.dynamics import DELTA, Encoding, Normalizers, Prediction
from jaxplore.replay import Replay
from jaxplore.types import Array, Key, Metrics, Transition, no_metrics, traced_once
from jaxplore.validate import Checks


@dataclass(frozen=True)
class FitConfig:
    """How a belief is fitted in each round. The defaults are the paper's; `epochs` after nnaisense/max."""

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
    restart: bool = False
    """Whether each round starts from new parameters (nnaisense/max) or continues from the last ones (paper: Algorithm 1
    initialises the generator once)."""
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


class Judgement(NamedTuple):
    """What models predict of transitions that happened, beside what happened; both as the belief's encoding has it."""

    prediction: Prediction
    """Of `M` models, `[M, N, O]`."""
    target: Array
    """What they should have predicted, `[N, O]`: the normalised delta, or the next state as one-hot."""


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
    num_models: int = 0
    """m, models drawn for a round."""
    num_groups: int = 1
    """K, of equal size, that a draw of models falls into one after the other: those of one generator. 1: all."""
    fit_config: FitConfig | None = None
    """How it is fitted in a round. None: not at all."""

    @property
    def has_groups(self) -> bool:
        """Whether there are several groups, of several models each."""
        return 1 < self.num_groups < self.num_models

    def imagine(self, models: Any, normalizers: Normalizers, obs: Array, action: Array) -> Prediction:
        """What models predict of `obs [N, O]` and `action [N, A]`, raw units: `[M, N, O]`.

        Raises:
            ValueError: this belief predicts nothing, or observations or actions have another shape.
        """
        if self.predict is None:
            raise ValueError("the belief predicts nothing. Allowed: a belief with `predict`.")
        validate.shape("obs", obs, "N", normalizers.obs.mean.shape[-1])
        validate.shape("action", action, obs.shape[0], normalizers.action.mean.shape[-1])
        return self.predict(models, self.encoding.inputs(normalizers, obs, action))

    def judge(self, models: Any, normalizers: Normalizers, transitions: Transition) -> Judgement:
        """What models predict of `transitions [N, ...]`, beside what happened. Raises as `imagine`."""
        prediction = self.imagine(models, normalizers, transitions.obs, transitions.action)
        return Judgement(prediction, self.encoding.targets(normalizers, transitions.obs, transitions.next_obs))


def fit(
    belief: Belief, key: Key, state: Any, data: Replay[Transition], normalizers: Normalizers, num_data: Array
) -> tuple[Any, Metrics]:
    """The gradient steps of one round (Algorithm 1, line 5), from a new state where the belief's `fit_config` says so.

    Args:
        belief: what is fitted.
        key: consumed.
        state: as the last round left it.
        data: all real transitions.
        normalizers: units of the models.
        num_data: transitions so far, int32; it sets the number of steps.

    Returns:
        `(state, metrics)`, the metrics those of the last step.
    """
    config = belief.fit_config
    if config is None:
        return state, {}
    init_key, steps_key = jax.random.split(key)
    start = belief.init(init_key) if config.restart else state

    update = traced_once(belief.update)

    def step(i: Array, carry: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
        return update(jax.random.fold_in(steps_key, i), carry[0], data, normalizers)

    metrics = no_metrics(lambda: update(steps_key, start, data, normalizers)[1])
    return jax.lax.fori_loop(0, config.num_steps(num_data), step, (start, metrics))


def make_no_belief() -> Belief:
    """The belief of a method that models nothing: an empty state that no data changes.

    Example:
        >>> make_no_belief().predict is None
        True
    """
    return Belief(
        init=lambda key: (),
        update=lambda key, state, data, normalizers: (state, {}),
        sample=lambda key, state, num: (),
        predict=None,
    )
