"""Rollouts of a policy in sampled models: all m models, all actors, the whole horizon in one program."""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import jax
import jax.numpy as jnp

from jaxplore import normalizer, validate
from jaxplore.behaviours.base import Experience
from jaxplore.beliefs.base import Belief
from jaxplore.dynamics import Normalizers, Prediction
from jaxplore.signals.base import Seen, Signal
from jaxplore.types import Array, Key, Transition
from jaxplore.validate import FieldError

Mover: TypeAlias = Literal["per_step", "per_rollout", "mean"]
"""Which model moves an actor: a random one at each step (nnaisense/max), one for its whole rollout, or the mean."""


class World(NamedTuple):
    """What a policy is imagined in."""

    belief: Belief
    """Whose models predict; it must predict."""
    models: Any
    """As the belief samples them, with a leading axis `M`."""
    normalizers: Normalizers
    """Units of the models."""
    score: Callable[[Seen], Array]
    """`score(seen) -> [N]`: the intrinsic reward of each imagined step."""
    step: Callable[[Array, Array], Array] | None = None
    """`step(obs [N, O], action [N, A]) -> next_obs [N, O]`, raw units: where actors go, if a simulator stands in for
    the models there; what a step is worth is still read off the models. None: a model says."""


def world_of(signal: Signal, experience: Experience) -> World:
    """What a round's models and signal make of the world."""
    assert signal.score is not None
    score = functools.partial(signal.score, experience.own)
    return World(signal.belief, experience.models, experience.normalizers, score)


def rollout(
    key: Key,
    act: Callable[[Key, Array], Array],
    world: World,
    start: Array,
    horizon: int,
    mover: Mover = "per_step",
    bound: float = 0.0,
) -> Transition:
    """Imagine what a policy would meet.

    Every model predicts every actor at every step: the reward is read off all of them, and one of them (or their
    mean) says where the actor goes; one that states a variance is drawn from, as in nnaisense/max. Nothing terminates
    in imagination.

    Args:
        key: consumed.
        act: `act(key, obs [N, O]) -> action [N, A]`, on raw observations.
        world: the belief, models drawn from it, their units, the intrinsic reward, and perhaps a simulator.
        start: where each actor starts, `[N, O]`.
        horizon: steps, `H`.
        mover: which model moves an actor.
        bound: imagined observations stay within this many standard deviations of the real data's mean, and changes
            within as many of theirs: errors of a model feed on themselves. 0: no bound.

    Returns:
        Transitions `[H, N, ...]` with the intrinsic reward.

    Raises:
        FieldError: an unknown `mover`, `horizon` below 1, or a negative `bound`; `start` of another width.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, rewards
        >>> belief = beliefs.make_generator_belief(2, 1, dynamics.DynamicsConfig(hidden=(8,)))
        >>> models = belief.sample(jax.random.key(0), belief.init(jax.random.key(1)), 4)
        >>> world = World(
        ...     belief, models, dynamics.init_normalizers(2, 1), lambda seen: rewards.variance(seen.prediction))
        >>> imagined = rollout(
        ...     jax.random.key(2), lambda key, obs: jax.random.uniform(key, (obs.shape[0], 1)), world,
        ...     jnp.zeros((16, 2)), horizon=5)
        >>> imagined.next_obs.shape
        (5, 16, 2)
    """
    belief, models, normalizers, score, simulate = world
    validate.one_of("mover", mover, get_args(Mover))
    validate.at_least("horizon", horizon, 1)
    validate.in_range("bound", bound, 0.0)
    if start.ndim != 2 or start.shape[1] != normalizers.obs.mean.shape[-1]:
        raise FieldError("start", start.shape, f"shape [N, {normalizers.obs.mean.shape[-1]}]", "is its shape")
    member_key, scan_key = jax.random.split(key)
    num_actors = start.shape[0]
    members = jax.random.randint(member_key, (num_actors,), 0, jax.tree.leaves(models)[0].shape[0])

    def step(obs: Array, step_key: Key) -> tuple[Array, Transition]:
        act_key, mover_key = jax.random.split(step_key)
        action = act(act_key, obs)
        prediction = belief.imagine(models, normalizers, obs, action)
        if simulate is None:
            delta = _change(mover_key, prediction, mover, members)
            delta, next_obs = _arrive(belief, normalizers, obs, delta, bound)
        else:
            next_obs = simulate(obs, action)
            delta = belief.encoding.targets(normalizers, obs, next_obs)
        never = jnp.zeros(num_actors, bool)
        row = Transition(obs, action, jnp.zeros(num_actors), next_obs, never, never)
        return next_obs, row._replace(reward=score(Seen(row, prediction, delta, normalizers)))

    return jax.lax.scan(step, start, jax.random.split(scan_key, horizon))[1]


def _change(key: Key, prediction: Prediction, mover: Mover, members: Array) -> Array:
    """The change `[N, O]` that `mover` takes from what all models predict."""
    if mover == "mean":
        return jnp.mean(prediction.mean, axis=0)
    num_models, num_actors = prediction.mean.shape[:2]
    chosen = members if mover == "per_rollout" else jax.random.randint(key, (num_actors,), 0, num_models)
    delta = prediction.mean[chosen, jnp.arange(num_actors)]
    if prediction.var is None:
        return delta
    std = jnp.sqrt(prediction.var[chosen, jnp.arange(num_actors)])
    return delta + std * jax.random.normal(jax.random.fold_in(key, 1), delta.shape)


def _arrive(belief: Belief, normalizers: Normalizers, obs: Array, delta: Array, bound: float) -> tuple[Array, Array]:
    """`(delta, next_obs)` within the bound, if there is one."""
    if not bound:
        return delta, belief.encoding.next_obs(normalizers, obs, delta)
    delta = jnp.clip(delta, -bound, bound)
    seen = normalizer.normalize(normalizers.obs, belief.encoding.next_obs(normalizers, obs, delta), limit=None)
    return delta, normalizer.denormalize(normalizers.obs, jnp.clip(seen, -bound, bound))
