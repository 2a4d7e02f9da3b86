"""Algorithm 1 of Ratzlaff et al. (2020) as pure functions: one round is one call.

A round takes in the transitions since the last one, fits the belief, draws models from it, and improves the
behaviour in what they imagine. Nothing here knows which method it runs.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxplore import dynamics, replay, rewards
from jaxplore.behaviours import Experience, uniform_actions
from jaxplore.dynamics import Normalizers
from jaxplore.methods import ExplorationConfig, Method, Sizes, check_fits, divergence_reward
from jaxplore.replay import Replay
from jaxplore.types import Array, Key, Metrics, Transition, no_metrics


@struct.dataclass
class ExplorerState:
    """All that an agent carries from round to round."""

    belief: Any
    behaviour: Any
    data: Replay[Transition]
    """Real transitions."""
    normalizers: Normalizers


class Explorer(NamedTuple):
    """An exploring agent as pure functions; jit, vmap over seeds and scan them as you like."""

    init: Callable[[Key], ExplorerState]
    """`init(key) -> state`."""
    actor: Callable[[ExplorerState], Any]
    """`actor(state) -> actor`: the part of the state that acting needs, small enough to hand around."""
    act: Callable[[Key, Any, Array], Array]
    """`act(key, actor, obs [..., O]) -> action [..., A]` of the behaviour."""
    act_uniformly: Callable[[Key, Array], Array]
    """`act_uniformly(key, obs [..., O]) -> action [..., A]`, for the warm-up."""
    observe: Callable[[ExplorerState, Transition, Array], ExplorerState]
    """`observe(state, transitions [T, ...], valid [T]) -> state`: take real transitions in, learn nothing yet."""
    improve: Callable[[Key, ExplorerState, Array, Array], tuple[ExplorerState, Metrics]]
    """`improve(key, state, obs [O], num_data) -> (state, metrics)`: fit the belief, draw models, improve the
    behaviour. `obs` is where the environment stands. `num_data` (int32) is how many transitions have come; it sets
    how long the fit is and must be the same for all seeds under `vmap`, or each takes as long as the longest."""
    assess: Callable[[Key, ExplorerState, Transition, Array], Metrics]
    """`assess(key, state, transitions [T, ...], valid [T]) -> metrics`: what the belief makes of transitions it has
    not seen. `intrinsic_reward` in the reward's own units; so that methods can be compared, of every belief also the
    `variance` of its models (equation 1, in units of normalised delta or probability) and their `divergence`
    (Jensen-Renyi, of probabilities Jensen-Shannon, in nats); of each the mean, and with `_p95` the 95th percentile. And
    `model_error`, the mean squared error of the models' mean, per normalised-delta entry, where 1 is as good as
    predicting the mean change; or per probability."""


def make_explorer(method: Method, sizes: Sizes, config: ExplorationConfig) -> Explorer:
    """Put a method together for an environment of the given sizes.

    Args:
        method: a row of `jaxplore.methods.METHODS`, or your own.
        sizes: entries of an observation and of an action.
        config: all settings.

    Returns:
        An `Explorer`.

    Raises:
        ValueError: the method needs another kind of action, or a reward where there is none;
            `dynamics.target="one_hot"` where observations are not one-hot; or what a part of the method refuses.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxplore.methods import METHODS
        >>> explorer = make_explorer(METHODS["random"], Sizes(obs=3, action=1), ExplorationConfig())
        >>> state = explorer.init(jax.random.key(0))
        >>> explorer.act(jax.random.key(1), explorer.actor(state), jnp.zeros(3)).shape
        (1,)
    """
    if config.dynamics.target == "one_hot" and not sizes.one_hot_obs:
        raise ValueError(
            "DynamicsConfig.target='one_hot' predicts which of finitely many states comes next, and this environment's "
            "observations are not one-hot. Allowed: 'delta'."
        )
    check_fits(method, sizes)
    belief = method.belief(sizes, config)
    reward = method.reward(config)
    behaviour = method.behaviour(sizes, config, belief, reward)
    divergence = divergence_reward(config)
    flag = jnp.zeros((), bool)
    example = Transition(jnp.zeros(sizes.obs), jnp.zeros(sizes.action), jnp.zeros(()), jnp.zeros(sizes.obs), flag, flag)

    def init(key: Key) -> ExplorerState:
        belief_key, behaviour_key = jax.random.split(key)
        return ExplorerState(
            belief=belief.init(belief_key),
            behaviour=behaviour.init(behaviour_key),
            data=replay.init(example, config.data_capacity),
            normalizers=dynamics.init_normalizers(sizes.obs, sizes.action),
        )

    def actor(state: ExplorerState) -> Any:
        return behaviour.actor(state.behaviour), state.normalizers

    def act(key: Key, actor: Any, obs: Array) -> Array:
        behaviour_actor, normalizers = actor
        return behaviour.act(key, behaviour_actor, normalizers, obs)

    def act_uniformly(key: Key, obs: Array) -> Array:
        return uniform_actions(key, obs, sizes.action, sizes.discrete)

    def observe(state: ExplorerState, transitions: Transition, valid: Array) -> ExplorerState:
        return dataclasses.replace(
            state,
            data=replay.add(state.data, transitions, valid),
            normalizers=dynamics.update_normalizers(state.normalizers, transitions, valid),
        )

    def fit(key: Key, state: ExplorerState, num_data: Array) -> tuple[Any, Metrics]:
        init_key, steps_key = jax.random.split(key)
        start = belief.init(init_key) if config.fit.restart else state.belief

        def step(i: Array, carry: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
            return belief.update(jax.random.fold_in(steps_key, i), carry[0], state.data, state.normalizers)

        metrics = no_metrics(lambda: belief.update(steps_key, start, state.data, state.normalizers)[1])
        return jax.lax.fori_loop(0, config.fit.num_steps(num_data), step, (start, metrics))

    def improve(key: Key, state: ExplorerState, obs: Array, num_data: Array) -> tuple[ExplorerState, Metrics]:
        fit_key, models_key, improve_key = jax.random.split(key, 3)
        fitted, fit_metrics = fit(fit_key, state, num_data)
        models = belief.sample(models_key, fitted, config.imagination.num_models)
        experience = Experience(models, state.data, num_data, state.normalizers, obs)
        improved, metrics = behaviour.improve(improve_key, state.behaviour, experience)
        return dataclasses.replace(state, belief=fitted, behaviour=improved), {
            **{f"fit/{name}": value for name, value in fit_metrics.items()},
            **{f"policy/{name}": value for name, value in metrics.items()},
        }

    def assess(key: Key, state: ExplorerState, transitions: Transition, valid: Array) -> Metrics:
        if belief.predict is None:
            return {}
        models = belief.sample(key, state.belief, config.imagination.num_models)
        # Valid rows take the others' places: a reward may compare rows.
        count = jnp.sum(valid)
        order = jnp.argsort(~valid)[jnp.arange(valid.shape[0]) % jnp.maximum(count, 1)]
        rows = jax.tree.map(lambda leaf: leaf[order], transitions)
        counts = jnp.arange(valid.shape[0]) < count
        inputs = belief.encoding.inputs(state.normalizers, rows.obs, rows.action)
        delta = belief.encoding.targets(state.normalizers, rows.obs, rows.next_obs)
        prediction = belief.predict(models, inputs)
        of_each = {
            "intrinsic_reward": reward(prediction, delta, state.normalizers),
            "variance": rewards.variance(prediction),
            "divergence": divergence(prediction, delta, state.normalizers),
        }
        metrics = {}
        for name, values in of_each.items():
            held = jnp.where(counts, values, jnp.nan)
            metrics |= {name: jnp.nanmean(held), f"{name}_p95": jnp.nanpercentile(held, 95.0)}
        errors = jnp.mean((jnp.mean(prediction.mean, axis=0) - delta) ** 2, axis=-1)
        return {**metrics, "model_error": jnp.nanmean(jnp.where(counts, errors, jnp.nan))}

    return Explorer(init, actor, act, act_uniformly, observe, improve, assess)
