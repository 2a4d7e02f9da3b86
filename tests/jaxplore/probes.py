"""Environments so small that the best policy and its soft values are known, after andyljones.com's probes.

Each gives batches of transitions, as a replay that has seen uniform actions would.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxplore.types import Array, Key, Transition
from tests.jaxplore import programs


def _batch(obs: Array, action: Array, reward: Array, next_obs: Array, terminated: Array) -> Transition:
    return Transition(obs, action, reward, next_obs, terminated, jnp.zeros(len(obs), bool))


def _draw(key: Key, num: int) -> tuple[Array, Array]:
    """Observations of -1 or 1 and uniform actions, each `[num, 1]`."""
    obs_key, action_key = jax.random.split(key)
    obs = jnp.sign(jax.random.normal(obs_key, (num, 1)))
    return obs, jax.random.uniform(action_key, (num, 1), minval=-1.0, maxval=1.0)


def constant(key: Key, num: int) -> Transition:
    """Reward 1, then the end. Q = 1; V = 1 + alpha * entropy of the policy."""
    obs, action = _draw(key, num)
    return _batch(0 * obs, action, jnp.ones(num), 0 * obs, jnp.ones(num, bool))


def predictable(key: Key, num: int) -> Transition:
    """The reward is the observation, -1 or 1, then the end. Q = obs."""
    obs, action = _draw(key, num)
    return _batch(obs, action, obs[:, 0], obs, jnp.ones(num, bool))


def two_steps(key: Key, num: int) -> Transition:
    """From -1 to 1 without a reward, from 1 to the end with reward 1. Q(1) = 1, Q(-1) = the discount."""
    obs, action = _draw(key, num)
    last = obs[:, 0] > 0
    return _batch(obs, action, last.astype(jnp.float32), jnp.ones_like(obs), last)


def endless(key: Key, num: int) -> Transition:
    """Reward 1 for ever, cut by a time limit at every step. Q = 1 / (1 - discount): truncation is not an end."""
    obs, action = _draw(key, num)
    batch = _batch(0 * obs, action, jnp.ones(num), 0 * obs, jnp.zeros(num, bool))
    return batch._replace(truncated=jnp.ones(num, bool))


def target_action(key: Key, num: int) -> Transition:
    """Reward -(action - obs / 2)^2, then the end. The best action is obs / 2, and Q there is 0."""
    obs, action = _draw(key, num)
    return _batch(obs, action, -((action - obs / 2)[:, 0] ** 2), obs, jnp.ones(num, bool))


PROBES: dict[str, Callable[[Key, int], Transition]] = {
    probe.__name__: probe for probe in (constant, predictable, two_steps, endless, target_action)
}

BATCH_SIZE = 64


def train_on_each(
    makers: Sequence[Callable[[Key, int], Transition]], learn: Callable[..., Any], steps: int, *more: Array
) -> list[Any]:
    """What `learn(batches [steps, BATCH_SIZE, ...], *more)` gives for each probe, as NumPy arrays; one program for all.

    Args:
        makers: the probes.
        learn: what is done with each.
        steps: batches.
        *more: one row for each probe.
    """

    @programs.compiled
    def run(key: Key) -> Any:
        rows = [maker(key, steps * BATCH_SIZE) for maker in makers]
        batches = jax.tree.map(
            lambda *leaves: jnp.stack([leaf.reshape(steps, BATCH_SIZE, *leaf.shape[1:]) for leaf in leaves]), *rows
        )
        return jax.vmap(learn)(batches, *more)

    learned = jax.device_get(run(jax.random.key(2)))
    return [jax.tree.map(lambda leaf, i=i: leaf[i], learned) for i in range(len(makers))]
