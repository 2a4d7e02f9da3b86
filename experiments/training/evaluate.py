"""Evaluation: whole episodes without exploring, which change nothing in the run."""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from envs.stepper import make_stepper
from experiments.runs.config import RunConfig
from experiments.training.programs import EVALUATE, Programs
from jaxplore.exploration import Explorer, ExplorerState
from jaxplore.types import Transition

Evaluate: TypeAlias = Callable[[int, ExplorerState], dict[str, np.ndarray]]
"""`evaluate(step, explorer state [S]) -> metrics [S]`: `eval/return`, `eval/return_std`, `eval/length`."""


def make_evaluate(config: RunConfig, env: Environment, explorer: Explorer, programs: Programs) -> Evaluate:
    """Episodes from starts that follow from the seed and the step, by what the behaviour holds for the best.

    All episodes of all seeds run side by side, each for the longest that an episode can take.
    """
    spread, num = programs.stepping.spread, config.eval_episodes
    stepper = make_stepper(env, env.spec.episode_steps, explorer.act_greedily, spread)

    @jax.jit
    @spread
    def split(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
        own = jax.vmap(lambda key: jax.random.split(key, 2 * num))(keys)
        return own[:, :num].reshape(-1), own[:, num:].reshape(-1)

    repeat = jax.jit(spread(lambda actors: jax.tree.map(lambda leaf: jnp.repeat(leaf, num, axis=0), actors)))

    def evaluate(step: int, state: ExplorerState) -> dict[str, np.ndarray]:
        start_keys, act_keys = split(programs.keys(EVALUATE, step))
        actors = repeat(programs.actors(state, False))
        rows = stepper.collect(act_keys, stepper.init(start_keys), actors, env.spec.episode_steps)[1]
        returns, lengths = first_episodes(jax.device_get(rows))
        returns, lengths = returns.reshape(-1, num), lengths.reshape(-1, num)
        return {
            "eval/return": returns.mean(axis=1),
            "eval/return_std": returns.std(axis=1),
            "eval/length": lengths.mean(axis=1),
        }

    return evaluate


def first_episodes(rows: Transition) -> tuple[np.ndarray, np.ndarray]:
    """Return and length of the first episode in each row of transitions `[N, T]`, float64 `[N]`, int `[N]`.

    Example:
        >>> import numpy as np
        >>> from jaxplore.types import Transition
        >>> done = np.array([[False, True, False]])
        >>> reward = np.array([[1.0, 2.0, 4.0]])
        >>> first_episodes(Transition(None, None, reward, None, done, 0 * done))
        (array([3.]), array([2]))
    """
    done = rows.terminated | rows.truncated
    # Steps before which no episode has ended.
    first = np.cumsum(done, axis=1) - done == 0
    earned = np.where(first, rows.reward, 0.0).astype(np.float64)
    return np.asarray(earned.sum(axis=1)), np.asarray(first.sum(axis=1))
