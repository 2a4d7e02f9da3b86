"""Algorithm 1 of Ratzlaff et al. (2020) as pure functions: one round is one call.

A round takes in the transitions since the last one, fits the belief, draws models from it, and improves the
behaviour in what they imagine. Nothing here knows which method it runs.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import beliefs, dynamics, replay, validate
from jaxplore.behaviours.base import Behaviour, Experience
from jaxplore.behaviours.uniform import uniform_actions
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import Normalizers
from jaxplore.methods import Method, check_fits
from jaxplore.parts import divergence_reward
from jaxplore.replay import Replay
from jaxplore.signals import rewards
from jaxplore.signals.base import Score, Signal
from jaxplore.types import Array, Key, Metrics, Transition
from jaxplore.validate import FieldError


@struct.dataclass
class ExplorerState:
    """All that an agent carries from round to round."""

    belief: Any
    behaviour: Any
    data: Replay[Transition]
    """Real transitions."""
    normalizers: Normalizers
    frozen: Array
    """Whether the normalisers stay as they are, as a policy that was taken over needs them; bool."""
    signal: Any = ()
    """What the signal carries beside the belief, unless the behaviour carries it."""


@struct.dataclass
class Actor:
    """What acting needs."""

    behaviour: Any
    normalizers: Normalizers
    uniform: Array
    """Whether actions are uniform, in place of the behaviour's; bool."""


class Explorer(NamedTuple):
    """An exploring agent as pure functions; jit, vmap over seeds and scan them as you like."""

    init: Callable[[Key], ExplorerState]
    """`init(key) -> state`."""
    actor: Callable[..., Actor]
    """`actor(state, uniform=False) -> actor`: what acting needs, small enough to hand around, and how it acts: as the
    behaviour does, or with `uniform` (which may be traced) by uniform actions, as in the warm-up."""
    act: Callable[[Key, Actor, Array], Array]
    """`act(key, actor, obs [..., O]) -> action [..., A]`, as the actor says."""
    act_greedily: Callable[[Key, Actor, Array], Array]
    """`act_greedily(key, actor, obs [..., O]) -> action [..., A]`: what the behaviour holds for the best, for
    evaluation. Only a behaviour that searches at random needs the key."""
    act_uniformly: Callable[[Key, Array], Array]
    """`act_uniformly(key, obs [..., O]) -> action [..., A]`."""
    observe: Callable[[ExplorerState, Transition, Array], ExplorerState]
    """`observe(state, transitions [T, ...], valid [T]) -> state`: take real transitions in, learn nothing yet."""
    improve: Callable[[Key, ExplorerState, Array, Array], tuple[ExplorerState, Metrics]]
    """`improve(key, state, obs [O], num_data) -> (state, metrics)`: fit the belief, draw models, improve the
    behaviour. `obs` is where the environment stands. `num_data` (int32) is how many transitions have come; it sets
    how long the fit is and must be the same for all seeds under `vmap`, or each takes as long as the longest."""
    assess: Callable[[Key, ExplorerState, Transition, Array], Metrics]
    """`assess(key, state, transitions [T, ...], valid [T]) -> metrics`: what transitions that have not been learned
    from are worth. `intrinsic_reward` in the unit `reward_unit`, of every method that has one. Of every belief, so that
    methods can be compared, also the `variance` of its models (equation 1, in units of normalised delta or
    probability) and their `divergence` (Jensen-Renyi, of probabilities Jensen-Shannon, in nats), and where several
    generators draw them `variance_within` one of these; of each the mean, and with `_p95` the 95th percentile. And
    `model_error`, the mean squared error of the models' mean, per normalised-delta entry, where 1 is as good as
    predicting the mean change; or per probability."""
    adopt: Callable[[ExplorerState, Actor], ExplorerState] | None
    """`adopt(state, actor) -> state`: with the policy of another agent's actor and the statistics that it sees
    observations by, which stay as they are from now on, whatever comes: its weights mean nothing by others. What is
    learned with it, such as critics, is new, and there are no data. None: the method has no policy that could be taken
    over."""
    reward_unit: str | None
    """Of the intrinsic reward, for labels. None: the method has no intrinsic reward."""


def make_explorer(method: Method, sizes: Sizes, config: ExplorationConfig) -> Explorer:
    """Put a method together for an environment of the given sizes.

    Args:
        method: a row of `jaxplore.methods.METHODS`, or your own.
        sizes: entries of an observation and of an action.
        config: all settings.

    Returns:
        An `Explorer`.

    Raises:
        ValueError: a size is below 1; the method needs another kind of action, or a reward where there is none;
            `dynamics.target="one_hot"` where observations are not one-hot; or what a part of the method refuses. When
            its functions are traced, observations and transitions of other shapes.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore.methods import METHODS
        >>> explorer = make_explorer(METHODS["random"], Sizes(obs=3, action=1), ExplorationConfig())
        >>> state = explorer.init(jax.random.key(0))
        >>> explorer.act(jax.random.key(1), explorer.actor(state), jnp.zeros(3)).shape
        (1,)
    """
    validate.sizes(obs=sizes.obs, action=sizes.action)
    if config.dynamics.target == "one_hot" and not sizes.one_hot_obs:
        raise FieldError(
            "target",
            "one_hot",
            "'delta'",
            "predicts which of finitely many states comes next, and this environment's observations are not one-hot",
            "DynamicsConfig",
        )
    check_fits(method, sizes)
    signal = method.signal(sizes, config)
    behaviour = method.behaviour(sizes, config, signal)
    agent = Agent(signal, divergence_reward(config).score, behaviour, sizes, config.data_capacity)
    return Explorer(
        init=functools.partial(init, agent),
        actor=functools.partial(actor, agent),
        act=functools.partial(act, agent),
        act_greedily=functools.partial(act_greedily, agent),
        act_uniformly=functools.partial(act_uniformly, agent),
        observe=observe,
        improve=functools.partial(improve, agent),
        assess=functools.partial(assess, agent),
        adopt=functools.partial(adopt, agent) if behaviour.adopt else None,
        reward_unit=signal.unit,
    )


class Agent(NamedTuple):
    """The fixed parts of an explorer."""

    signal: Signal
    divergence: Score
    """Logged of every belief."""
    behaviour: Behaviour
    sizes: Sizes
    data_capacity: int

    @property
    def carries(self) -> bool:
        """Whether it carries, and fits, something of the signal's beside the belief: not if the behaviour does."""
        return self.signal.init is not None and self.behaviour.score is None


def init(agent: Agent, key: Key) -> ExplorerState:
    """An agent that has seen nothing."""
    sizes = agent.sizes
    flag = jnp.zeros((), bool)
    example = Transition(jnp.zeros(sizes.obs), jnp.zeros(sizes.action), jnp.zeros(()), jnp.zeros(sizes.obs), flag, flag)
    belief_key, behaviour_key = jax.random.split(key)
    own = ()
    # What carries nothing takes no key either.
    if agent.carries:
        assert agent.signal.init is not None
        behaviour_key, own_key = jax.random.split(behaviour_key)
        own = agent.signal.init(own_key)
    return ExplorerState(
        belief=agent.signal.belief.init(belief_key),
        behaviour=agent.behaviour.init(behaviour_key),
        data=replay.init(example, agent.data_capacity),
        normalizers=dynamics.init_normalizers(sizes.obs, sizes.action),
        frozen=jnp.zeros((), bool),
        signal=own,
    )


def actor(agent: Agent, state: ExplorerState, uniform: bool | Array = False) -> Actor:
    """What acting needs of a state."""
    return Actor(agent.behaviour.actor(state.behaviour), state.normalizers, jnp.asarray(uniform))


def adopt(agent: Agent, state: ExplorerState, actor: Actor) -> ExplorerState:
    """The state with another agent's policy and normalisers, which are frozen."""
    assert agent.behaviour.adopt is not None
    behaviour = agent.behaviour.adopt(state.behaviour, actor.behaviour)
    frozen = jnp.ones_like(state.frozen)
    return dataclasses.replace(state, behaviour=behaviour, normalizers=actor.normalizers, frozen=frozen)


def act(agent: Agent, key: Key, actor: Actor, obs: Array) -> Array:
    """An action `[..., A]` for `obs [..., O]`, as the actor says."""
    validate.shape("obs", obs, "...", agent.sizes.obs)
    drawn = agent.behaviour.act(key, actor.behaviour, actor.normalizers, obs)
    return jnp.where(actor.uniform, act_uniformly(agent, key, obs), drawn)


def act_greedily(agent: Agent, key: Key, actor: Actor, obs: Array) -> Array:
    """The action `[..., A]` that the behaviour holds for the best."""
    validate.shape("obs", obs, "...", agent.sizes.obs)
    best = agent.behaviour.act_greedily or agent.behaviour.act
    return best(key, actor.behaviour, actor.normalizers, obs)


def act_uniformly(agent: Agent, key: Key, obs: Array) -> Array:
    """A uniform action `[..., A]`."""
    validate.shape("obs", obs, "...", agent.sizes.obs)
    return uniform_actions(key, obs, agent.sizes.action, agent.sizes.discrete)


def observe(state: ExplorerState, transitions: Transition, valid: Array) -> ExplorerState:
    """Take real transitions `[T, ...]` in where `valid [T]` is set; nothing is learned yet."""
    data = replay.add(state.data, transitions, valid)
    updated = dynamics.update_normalizers(state.normalizers, transitions, valid)
    normalizers = jax.tree.map(lambda new, old: jnp.where(state.frozen, old, new), updated, state.normalizers)
    return dataclasses.replace(state, data=data, normalizers=normalizers)


def improve(agent: Agent, key: Key, state: ExplorerState, obs: Array, num_data: Array) -> tuple[ExplorerState, Metrics]:
    """Fit the belief and the signal, draw models, improve the behaviour (Algorithm 1, lines 5 to 9)."""
    belief, behaviour = agent.signal.belief, agent.behaviour
    validate.shape("obs", obs, agent.sizes.obs)
    fit_key, models_key, improve_key = jax.random.split(key, 3)
    fitted, fit_metrics = beliefs.fit(belief, fit_key, state.belief, state.data, state.normalizers, num_data)
    models = belief.sample(models_key, fitted, belief.num_models)
    own, own_metrics = state.signal, {}
    if agent.carries:
        own, own_metrics = agent.signal.fit(own, state.data, state.normalizers)
    experience = Experience(models, state.data, num_data, state.normalizers, obs, own)
    improved, metrics = behaviour.improve(improve_key, state.behaviour, experience)
    return dataclasses.replace(state, belief=fitted, behaviour=improved, signal=own), {
        **{f"fit/{name}": value for name, value in fit_metrics.items()},
        **{f"policy/{name}": value for name, value in (metrics | own_metrics).items()},
    }


def assess(agent: Agent, key: Key, state: ExplorerState, transitions: Transition, valid: Array) -> Metrics:
    """What transitions `[T, ...]` that have not been learned from are worth; see `Explorer.assess`."""
    signal, belief = agent.signal, agent.signal.belief
    if belief.predict is None and signal.score is None:
        return {}
    validate.shape("transitions.obs", transitions.obs, "T", agent.sizes.obs)
    validate.shape("valid", valid, transitions.obs.shape[0])
    # Valid rows take the others' places: a reward may compare rows.
    count = jnp.sum(valid)
    order = jnp.argsort(~valid)[jnp.arange(valid.shape[0]) % jnp.maximum(count, 1)]
    rows = jax.tree.map(lambda leaf: leaf[order], transitions)
    counts = jnp.arange(valid.shape[0]) < count
    models = belief.sample(key, state.belief, belief.num_models)
    seen = signal.see(models, state.normalizers, rows)
    of_each = {}
    if agent.behaviour.score:
        of_each["intrinsic_reward"] = agent.behaviour.score(state.behaviour, state.normalizers, rows)
    elif signal.score:
        of_each["intrinsic_reward"] = signal.score(state.signal, seen)
    if belief.predict is None:
        return _spreads(of_each, counts)
    of_each["variance"] = rewards.variance(seen.prediction)
    if belief.has_groups:
        of_each["variance_within"] = rewards.variance_within(seen.prediction, belief.num_groups)
    of_each["divergence"] = agent.divergence(seen.prediction, seen.delta, state.normalizers)
    errors = jnp.mean((jnp.mean(seen.prediction.mean, axis=0) - seen.delta) ** 2, axis=-1)
    return {**_spreads(of_each, counts), "model_error": jnp.nanmean(jnp.where(counts, errors, jnp.nan))}


def _spreads(of_each: dict[str, Array], counts: Array) -> Metrics:
    """Mean and 95th percentile of each, over the rows that count."""
    metrics = {}
    for name, values in of_each.items():
        held = jnp.where(counts, values, jnp.nan)
        metrics |= {name: jnp.nanmean(held), f"{name}_p95": jnp.nanpercentile(held, 95.0)}
    return metrics
