"""The interface of a learner: pure functions that turn transitions with rewards into a policy."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxplore import validate
from jaxplore.types import Array, Key, Metrics, Transition


class Learner(NamedTuple):
    """A learner as pure functions, such as `make_sac`, `make_ddqn` and `make_ddpg` build.

    Example:
        One that learns nothing and always takes the action that its parameter holds:

        >>> import jax, jax.numpy as jnp
        >>> learner = Learner(
        ...     init=lambda key: jnp.array([0.3]),
        ...     actor=lambda state: state,
        ...     act=lambda key, actor, obs: actor,
        ...     act_greedily=lambda actor, obs: actor,
        ...     update=lambda key, state, batch: (state, {}),
        ...     batch_size=1)
        >>> learner.act_greedily(learner.actor(learner.init(jax.random.key(0))), jnp.zeros(2)).shape
        (1,)
    """

    init: Callable[[Key], Any]
    """`init(key) -> state`."""
    actor: Callable[[Any], Any]
    """`actor(state) -> actor`: the part of the state that acting needs."""
    act: Callable[[Key, Any, Array], Array]
    """`act(key, actor, obs [..., O]) -> action [..., A]`, drawn as the policy explores."""
    act_greedily: Callable[[Any, Array], Array]
    """`act_greedily(actor, obs [..., O]) -> action [..., A]`, the one that the policy considers best."""
    update: Callable[[Key, Any, Transition], tuple[Any, Metrics]]
    """`update(key, state, batch [B, ...]) -> (state, metrics)`, one gradient step of every network."""
    batch_size: int
    """Transitions that an update expects, `B`."""
    noise: Callable[[Key], Any] | None = None
    """`noise(key) -> noise`: all that `update` draws at random from its key for a batch of `batch_size`, so that it
    can be drawn for many updates at once. None: `update` has to draw it itself."""
    update_given: Callable[[Any, Any, Transition], tuple[Any, Metrics]] | None = None
    """`update_given(noise, state, batch [B, ...]) -> (state, metrics)`: `update` with its noise."""
    adopt: Callable[[Any, Any], Any] | None = None
    """`adopt(state, actor) -> state`: with the policy of another state's `actor` and everything else, such as critics,
    as in `state`. None: it has no policy that can be taken over."""


def checked(learner: Learner, obs_size: int, action_size: int) -> Learner:
    """The learner, refusing observations and batches of other shapes, when they are traced.

    Args:
        learner: of your own, say; those of this package are checked.
        obs_size: `O`.
        action_size: `A`.

    Returns:
        A `Learner` that raises `FieldError` where an observation is not `[..., O]`, or a batch is empty or of other
        widths.

    Raises:
        FieldError: a size below 1.
    """
    validate.sizes(obs_size=obs_size, action_size=action_size)

    def act(key: Key, actor: Any, obs: Array) -> Array:
        validate.shape("obs", obs, "...", obs_size)
        return learner.act(key, actor, obs)

    def act_greedily(actor: Any, obs: Array) -> Array:
        validate.shape("obs", obs, "...", obs_size)
        return learner.act_greedily(actor, obs)

    def check(batch: Transition) -> None:
        validate.shape("batch.obs", batch.obs, "B", obs_size)
        num = batch.obs.shape[0]
        validate.shape("batch.action", batch.action, num, action_size)
        validate.shape("batch.next_obs", batch.next_obs, num, obs_size)
        validate.shape("batch.reward", batch.reward, num)
        validate.shape("batch.terminated", batch.terminated, num)

    def update(key: Key, state: Any, batch: Transition) -> tuple[Any, Metrics]:
        check(batch)
        return learner.update(key, state, batch)

    def update_given(noise: Any, state: Any, batch: Transition) -> tuple[Any, Metrics]:
        assert learner.update_given is not None
        check(batch)
        return learner.update_given(noise, state, batch)

    given = update_given if learner.update_given else None
    return learner._replace(act=act, act_greedily=act_greedily, update=update, update_given=given)
