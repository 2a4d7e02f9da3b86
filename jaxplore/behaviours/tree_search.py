"""Behaviour by planning: no policy is learned, each real step is searched for in the belief's models.

For environments with finitely many states and actions. All models are asked about all of them once per round; what the
search needs are two tables.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import validate
from jaxplore.behaviours.base import Behaviour, Experience, check_imaginable
from jaxplore.behaviours.mcts import MCTSConfig, Tables, make_mcts
from jaxplore.behaviours.rollout import world_of
from jaxplore.dynamics import Normalizers
from jaxplore.signals.base import Seen, Signal
from jaxplore.types import Array, Key, Metrics, Transition
from jaxplore.validate import FieldError

DRAWS_PER_MODEL = 16
"""Next states drawn from each model for each pair, where models go by their probabilities."""


@struct.dataclass
class PlanningState:
    """What planning carries: the models' answers, with as many models as the search chooses from."""

    next_state: Array
    """int32 `[M, O, A]`"""
    utility: Array
    """`[O, A]`"""


class TreeSearch(NamedTuple):
    """The fixed parts of the behaviour."""

    signal: Signal
    plan: Callable[..., Any]
    """`jaxplore.behaviours.mcts.MCTS.plan`."""
    num_states: int
    num_actions: int
    samples: bool
    """Whether next states are drawn from the models' probabilities."""

    @property
    def num_tables(self) -> int:
        """Models that the search chooses from."""
        return self.signal.belief.num_models * (DRAWS_PER_MODEL if self.samples else 1)


def make_tree_search(signal: Signal, num_states: int, num_actions: int, config: MCTSConfig | None = None) -> Behaviour:
    """Plan every action by tree search (`jaxplore.behaviours.mcts`), and forget the tree.

    Args:
        signal: what is sought, as a function of state and action, with a belief whose models are searched. The change
            that it gets is the models' mean prediction.
        num_states: `O`; observations are one-hot.
        num_actions: `A`; so are actions.
        config: how the search goes.

    Returns:
        A `Behaviour`; `act` takes and gives one-hot vectors. The metrics of `improve` are over all states and actions:
        `utility` and `utility_max`, and `agreement`, the share where all models go to the same state.

    Raises:
        ValueError: a size is below 1, the signal cannot be imagined, `config` does not fit the number of actions, or
            next states are to be sampled and the belief does not predict probabilities.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, rewards, signals
        >>> belief = beliefs.make_generator_belief(6, 2, dynamics.DynamicsConfig(hidden=(8,), target="one_hot"))
        >>> reward = signals.Reward(lambda prediction, delta, normalizers: rewards.variance(prediction), "squared")
        >>> behaviour = make_tree_search(signals.make_belief_signal(belief, reward), 6, 2)
        >>> actor = behaviour.actor(behaviour.init(jax.random.key(0)))
        >>> obs = jax.nn.one_hot(3, 6)
        >>> int(behaviour.act(jax.random.key(1), actor, dynamics.init_normalizers(6, 2), obs).sum())
        1
    """
    check_imaginable(signal)
    validate.sizes(num_states=num_states, num_actions=num_actions)
    config = config or MCTSConfig()
    samples = config.model_step == "sample"
    if samples and not signal.belief.encoding.is_probability:
        raise FieldError(
            "model_step", "sample", "'arg_max', or DynamicsConfig.target='one_hot'", "needs probabilities", "MCTSConfig"
        )
    plan = make_mcts(num_actions, config).plan
    parts = TreeSearch(signal, plan, num_states, num_actions, samples)
    return Behaviour(
        init=functools.partial(init, parts),
        improve=functools.partial(improve, parts),
        actor=lambda state: state,
        act=functools.partial(act, parts),
    )


def init(parts: TreeSearch, key: Key) -> PlanningState:
    """Tables of zeros."""
    pairs = (parts.num_states, parts.num_actions)
    return PlanningState(jnp.zeros((parts.num_tables, *pairs), jnp.int32), jnp.zeros(pairs))


def improve(parts: TreeSearch, key: Key, state: PlanningState, experience: Experience) -> tuple[PlanningState, Metrics]:
    """Ask the round's models about all states and actions."""
    belief, models, normalizers, score, _ = world_of(parts.signal, experience)
    pairs = (parts.num_states, parts.num_actions)
    obs = jnp.repeat(jnp.eye(parts.num_states), parts.num_actions, axis=0)
    action = jnp.tile(jnp.eye(parts.num_actions), (parts.num_states, 1))
    prediction = belief.imagine(models, normalizers, obs, action)
    expected, never = jnp.mean(prediction.mean, axis=0), jnp.zeros(len(obs), bool)
    next_obs = belief.encoding.next_obs(normalizers, obs, expected)
    rows = Transition(obs, action, jnp.zeros(len(obs)), next_obs, never, never)
    utility = score(Seen(rows, prediction, expected, normalizers))
    successors = jax.vmap(belief.encoding.next_obs, in_axes=(None, None, 0))(normalizers, obs, prediction.mean)
    likely = jnp.argmax(successors, -1)
    next_state = likely
    if parts.samples:
        logits = jnp.log(prediction.mean)
        shape = (DRAWS_PER_MODEL, *likely.shape)
        next_state = jax.random.categorical(key, logits[None], shape=shape).reshape(parts.num_tables, -1)
    tables = PlanningState(next_state.astype(jnp.int32).reshape(parts.num_tables, *pairs), utility.reshape(pairs))
    return tables, {
        "utility": jnp.mean(utility),
        "utility_max": jnp.max(utility),
        "agreement": jnp.mean(jnp.all(likely == likely[:1], axis=0)),
    }


def act(parts: TreeSearch, key: Key, actor: PlanningState, normalizers: Normalizers, obs: Array) -> Array:
    """The action that a new search finds for each `obs [..., O]`, one-hot."""
    tables = Tables(actor.next_state, actor.utility)

    def one(key: Key, state: Array) -> Array:
        return parts.plan(key, tables, state)[0]

    leading = obs.shape[:-1]
    states = jnp.argmax(obs, axis=-1).astype(jnp.int32).reshape(-1)
    keys = jax.random.split(key, states.shape[0])
    return jax.nn.one_hot(jax.vmap(one)(keys, states).reshape(leading), parts.num_actions)
