"""A classic task in a few lines: a pole on a cart that is pushed at will (Barto, Sutton & Anderson 1983)."""

import jax
import jax.numpy as jnp

from jaxplore import replay
from jaxplore.learners.base import Learner
from jaxplore.types import Array, Key, Transition

EPISODE = 200
SIZES = (2.4, 2.0, 0.21, 2.0)
"""What is divided by for a learner off policy: about the largest values while the pole is up."""
GRAVITY, CART, POLE, HALF_LENGTH, FORCE, DT = 9.8, 1.0, 0.1, 0.5, 10.0, 0.02


def reset(key: Key) -> Array:
    """Position, velocity, angle from upright and its velocity, `[4]`."""
    return jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05)


def step(state: Array, action: Array) -> tuple[Array, Array]:
    """`(next state, whether it fell)`. The reward is 1 for each step."""
    x, speed, angle, spin = state
    force = FORCE * jnp.clip(action[0], -1.0, 1.0)
    push = (force + POLE * HALF_LENGTH * spin**2 * jnp.sin(angle)) / (CART + POLE)
    inertia = HALF_LENGTH * (4 / 3 - POLE * jnp.cos(angle) ** 2 / (CART + POLE))
    turn = (GRAVITY * jnp.sin(angle) - jnp.cos(angle) * push) / inertia
    slide = push - POLE * HALF_LENGTH * turn * jnp.cos(angle) / (CART + POLE)
    after = jnp.stack([x + DT * speed, speed + DT * slide, angle + DT * spin, spin + DT * turn])
    return after, (jnp.abs(after[0]) > 2.4) | (jnp.abs(after[2]) > 0.21)


def advance(key: Key, state: Array, count: Array, action: Array) -> tuple[Array, Array, Transition]:
    """`(where the next step starts, its number in the episode, the transition)`."""
    after, fell = step(state, action)
    cut = count + 1 >= EPISODE
    transition = Transition(state, action, jnp.float32(1), after, fell, cut)
    done = fell | cut
    return jnp.where(done, reset(key), after), jnp.where(done, 0, count + 1), transition


def episode_length(act, key: Key, num: int = 20) -> float:
    """Mean length of episodes under `act(key, obs)`."""

    def one(key: Key) -> Array:
        def go(carry, step_key):
            state, up = carry
            after, fell = step(state, act(step_key, state))
            return (after, up & ~fell), up

        return jnp.sum(jax.lax.scan(go, (reset(key), jnp.bool_(True)), jax.random.split(key, EPISODE))[1])

    return float(jnp.mean(jax.jit(jax.vmap(one))(jax.random.split(key, num))))


def train_off_policy(learner: Learner, num_steps: int, num_random: int = 1000) -> float:
    """One update a step after random ones; the mean length of the episodes in the last third of training."""
    obs, flag, sizes = jnp.zeros(4), jnp.zeros((), bool), jnp.array(SIZES)
    data = replay.init(Transition(obs, jnp.zeros(1), jnp.zeros(()), obs, flag, flag), num_steps)

    def go(carry, t):
        learned, data, state, count = carry
        act_key, reset_key, batch_key, update_key, random_key = jax.random.split(
            jax.random.fold_in(jax.random.key(1), t), 5
        )
        drawn = learner.act(act_key, learner.actor(learned), state / sizes)
        action = jnp.where(t < num_random, jax.random.uniform(random_key, (1,), minval=-1.0, maxval=1.0), drawn)
        state, count, row = advance(reset_key, state, count, action)
        row = row._replace(obs=row.obs / sizes, next_obs=row.next_obs / sizes)
        data = replay.add(data, jax.tree.map(lambda x: x[None], row))
        batch = replay.sample(batch_key, data, learner.batch_size)
        after = learner.update(update_key, learned, batch)[0]
        learned = jax.tree.map(lambda new, old: jnp.where(t < num_random, old, new), after, learned)
        return (learned, data, state, count), row.terminated | row.truncated

    start = (learner.init(jax.random.key(0)), data, reset(jax.random.key(2)), jnp.int32(0))
    ends = jax.jit(lambda: jax.lax.scan(go, start, jnp.arange(num_steps))[1])()
    last = num_steps // 3
    return last / max(1, int(jnp.sum(ends[-last:])))
