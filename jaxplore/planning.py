"""Behaviour by planning: no policy is learned, each real step is searched for in the belief's models.

For environments with finitely many states and actions. All models are asked about all of them once per round; what the
search needs are two tables.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore.behaviours import Behaviour, Experience
from jaxplore.beliefs import Belief
from jaxplore.dynamics import ONE_HOT, Normalizers
from jaxplore.imagination import Reward
from jaxplore.mcts import MCTSConfig, Tables, make_mcts
from jaxplore.types import Array, Key, Metrics

DRAWS_PER_MODEL = 16
"""Next states drawn from each model for each pair, where models go by their probabilities."""


@struct.dataclass
class PlanningState:
    """What planning carries: the models' answers, with as many models as the search chooses from."""

    next_state: Array
    """int32 `[M, O, A]`"""
    utility: Array
    """`[O, A]`"""


def make_tree_search(
    belief: Belief, reward: Reward, num_states: int, num_actions: int, num_models: int, config: MCTSConfig | None = None
) -> Behaviour:
    """Plan every action by tree search (`jaxplore.mcts`), and forget the tree.

    Args:
        belief: whose models are searched; it must predict.
        reward: the intrinsic reward, as a function of state and action. The change that it is told of is the models'
            mean prediction.
        num_states: `O`; observations are one-hot.
        num_actions: `A`; so are actions.
        num_models: m, models that come with an `Experience`.
        config: how the search goes.

    Returns:
        A `Behaviour`; `act` takes and gives one-hot vectors. The metrics of `improve` are over all states and actions:
        `utility` and `utility_max`, and `agreement`, the share where all models go to the same state.

    Raises:
        ValueError: the belief does not predict, `config` does not fit the number of actions, or next states are to be
            sampled and the belief does not predict probabilities.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore import beliefs, dynamics, rewards
        >>> belief = beliefs.make_generator_belief(6, 2, dynamics.DynamicsConfig(hidden=(8,), target="one_hot"))
        >>> behaviour = make_tree_search(
        ...     belief, lambda prediction, delta, normalizers: rewards.variance(prediction), 6, 2, num_models=5)
        >>> actor = behaviour.actor(behaviour.init(jax.random.key(0)))
        >>> obs = jax.nn.one_hot(3, 6)
        >>> int(behaviour.act(jax.random.key(1), actor, dynamics.init_normalizers(6, 2), obs).sum())
        1
    """
    predict, encoding = belief.predict, belief.encoding
    if predict is None:
        raise ValueError("belief predicts nothing, so nothing can be searched. Allowed: a belief with `predict`.")
    config = config or MCTSConfig()
    plan = make_mcts(num_actions, config).plan
    samples = config.model_step == "sample"
    if samples and encoding is not ONE_HOT:
        raise ValueError(
            "MCTSConfig.model_step='sample' needs probabilities. "
            "Allowed: 'arg_max', or DynamicsConfig.target='one_hot'."
        )
    obs = jnp.repeat(jnp.eye(num_states), num_actions, axis=0)
    action = jnp.tile(jnp.eye(num_actions), (num_states, 1))
    num_tables = num_models * (DRAWS_PER_MODEL if samples else 1)

    def init(key: Key) -> PlanningState:
        pairs = (num_states, num_actions)
        return PlanningState(jnp.zeros((num_tables, *pairs), jnp.int32), jnp.zeros(pairs))

    def improve(key: Key, state: PlanningState, experience: Experience) -> tuple[PlanningState, Metrics]:
        normalizers = experience.normalizers
        prediction = predict(experience.models, encoding.inputs(normalizers, obs, action))
        utility = reward(prediction, jnp.mean(prediction.mean, axis=0), normalizers)
        likely = jnp.argmax(jax.vmap(encoding.next_obs, in_axes=(None, None, 0))(normalizers, obs, prediction.mean), -1)
        next_state = likely
        if samples:
            logits = jnp.log(prediction.mean)
            shape = (DRAWS_PER_MODEL, *likely.shape)
            next_state = jax.random.categorical(key, logits[None], shape=shape).reshape(num_tables, -1)
        pairs = (num_states, num_actions)
        tables = PlanningState(next_state.astype(jnp.int32).reshape(num_tables, *pairs), utility.reshape(pairs))
        return tables, {
            "utility": jnp.mean(utility),
            "utility_max": jnp.max(utility),
            "agreement": jnp.mean(jnp.all(likely == likely[:1], axis=0)),
        }

    def act(key: Key, actor: PlanningState, normalizers: Normalizers, obs: Array) -> Array:
        tables = Tables(actor.next_state, actor.utility)

        def one(key: Key, state: Array) -> Array:
            return plan(key, tables, state)[0]

        leading = obs.shape[:-1]
        states = jnp.argmax(obs, axis=-1).astype(jnp.int32).reshape(-1)
        keys = jax.random.split(key, states.shape[0])
        return jax.nn.one_hot(jax.vmap(one)(keys, states).reshape(leading), num_actions)

    return Behaviour(init, improve, lambda state: state, act)
