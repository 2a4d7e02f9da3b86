"""What a signal is: how interesting a transition is, and what is carried from round to round to tell."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp

from jaxplore.beliefs.base import Belief, make_no_belief
from jaxplore.dynamics import Normalizers, Prediction
from jaxplore.replay import Replay
from jaxplore.types import Array, Key, Metrics, Transition

Score: TypeAlias = Callable[[Prediction, Array, Normalizers], Array]
"""`score(prediction [M, N, O], delta [N, O], normalizers) -> [N]`, `delta` being the change that happened."""


class Reward(NamedTuple):
    """An intrinsic reward that is read off a belief's predictions."""

    score: Score
    """What each transition is worth. Differentiable in the prediction, for behaviours that climb its gradient."""
    unit: str
    """Of the score, for labels: `"nats"`."""


class Seen(NamedTuple):
    """Transitions as a signal sees them, real or imagined, `N` of them."""

    transitions: Transition
    """`[N, ...]`, raw units. The reward of imagined ones is 0."""
    prediction: Any
    """What the belief's models predict, a `Prediction` of `[M, N, O]`. None: without a belief."""
    delta: Any
    """The change that happened, `[N, O]`, as the belief's encoding has it. None: without a belief."""
    normalizers: Normalizers


class Learning(NamedTuple):
    """How a signal that learns by itself does so, step by step, for a behaviour that says when."""

    measure: Callable[[Any, Seen, Array], tuple[Any, Array]]
    """`measure(own, seen, valid [N]) -> (own, score [N])`: the score of transitions in the order in which they came,
    and how large scores are by those with `valid`."""
    learn: Callable[[Any, Seen, Array], tuple[Any, Array]]
    """`learn(own, seen, weights [N]) -> (own, error)`: one gradient step."""


def _learn_nothing(own: Any, data: Replay[Transition], normalizers: Normalizers) -> tuple[Any, Metrics]:
    return own, {}


class Signal(NamedTuple):
    """How interesting a transition is, as pure functions, and the belief over the dynamics that comes with it.

    In a round the belief is fitted and models are drawn from it, and what the signal carries beside it, its `own`, is
    fitted; both then stand still while a behaviour learns.
    """

    score: Callable[[Any, Seen], Array] | None
    """`score(own, seen) -> [N]`: what each transition is worth. None: what the environment says it is, which nobody
    knows of an imagined one."""
    unit: str | None
    """Of the score, for labels. None: there is no intrinsic reward."""
    belief: Belief = make_no_belief()
    """Whose models predict what the score is read off, and imagine. With one that predicts nothing, nothing can be."""
    init: Callable[[Key], Any] | None = None
    """`init(key) -> own`: what it carries beside the belief. None: nothing, `()`."""
    fit: Callable[[Any, Replay[Transition], Normalizers], tuple[Any, Metrics]] = _learn_nothing
    """`fit(own, data, normalizers) -> (own, metrics)`: what a round with all real transitions teaches."""
    std: Callable[[Any], Array | float] = lambda own: 1.0
    """`std(own)`: what scores are divided by for a learner, unless it takes their standard deviation itself."""
    learning: Learning | None = None
    """What `fit` does, in steps. None: a behaviour cannot take that over."""

    def see(self, models: Any, normalizers: Normalizers, transitions: Transition) -> Seen:
        """Real transitions `[N, ...]`, and what models drawn from the belief say of them."""
        predicted = self.belief.judge(models, normalizers, transitions) if self.belief.predict else (None, None)
        return Seen(transitions, *predicted, normalizers)

    def judge(self, models: Any, own: Any, normalizers: Normalizers, transitions: Transition) -> Array:
        """What real transitions `[N, ...]` are worth, `[N]`, by models drawn from the belief."""
        assert self.score is not None
        return self.score(own, self.see(models, normalizers, transitions))

    def expect(self, models: Any, own: Any, normalizers: Normalizers, obs: Array, action: Array) -> Array:
        """What it would be worth, `[N]`, to take `action [N, A]` at `obs [N, O]`, raw units, if that led to where
        models drawn from the belief expect on average. Differentiable in the action.
        """
        assert self.score is not None
        prediction = self.belief.imagine(models, normalizers, obs, action)
        expected = jnp.mean(prediction.mean, axis=0)
        next_obs = self.belief.encoding.next_obs(normalizers, obs, expected)
        reward, flag = jnp.zeros(obs.shape[0]), jnp.zeros(obs.shape[0], bool)
        rows = Transition(obs, action, reward, next_obs, flag, flag)
        return self.score(own, Seen(rows, prediction, expected, normalizers))


def make_belief_signal(belief: Belief, reward: Reward) -> Signal:
    """A belief over the dynamics, and an intrinsic reward that is read off what its models predict.

    Raises:
        ValueError: the belief predicts nothing.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, rewards
        >>> belief = beliefs.make_ensemble_belief(2, 1, dynamics_config=dynamics.DynamicsConfig(hidden=(8,)))
        >>> variance = Reward(lambda prediction, delta, normalizers: rewards.variance(prediction), "squared")
        >>> make_belief_signal(belief, variance).unit
        'squared'
    """
    if belief.predict is None:
        raise ValueError("belief predicts nothing, so no reward can be read off it. Allowed: a belief with `predict`.")

    return Signal(lambda own, seen: reward.score(seen.prediction, seen.delta, seen.normalizers), reward.unit, belief)
