"""Ask a belief about real transitions: its data, new steps of its own policy, and uniform actions elsewhere."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from envs.stepper import Act, make_walk, prepared
from experiments.analysis.calibration import DATA, HELD_OUT, SEEN, UNSEEN, Judged
from experiments.runs.config import RunConfig
from experiments.training.build import make_belief
from experiments.training.programs import RunState
from jaxplore.beliefs.base import Belief
from jaxplore.dynamics import Normalizers
from jaxplore.exploration import Explorer, ExplorerState
from jaxplore.signals import rewards
from jaxplore.types import Array, Key, Transition

MOST_DATA = 2_000
"""Rows of the data that are looked at, drawn at random."""
NEW_STEPS = 600
"""Steps of the agent's own that the belief was not fitted to."""
STARTS = 140
"""Starts elsewhere, spread evenly over the cells; where there are more cells than this, in some of them."""
STEPS_EACH = 10
"""Uniform actions after each of them."""
CHUNK = 500
"""Transitions predicted at once: all models and the paper's networks then take 0.3 GiB."""


class Judge(NamedTuple):
    """A belief and an environment to ask it in."""

    belief: Belief
    env: Environment

    def __call__(self, models: Any, normalizers: Normalizers, transitions: Transition) -> Judged:
        """What the models make of `transitions [N, ...]`.

        Raises:
            ValueError: the belief predicts nothing.
        """
        if self.belief.predict is None:
            raise ValueError("this method has no belief to ask. Allowed: a method with models of the environment.")
        num = len(transitions.obs)
        # Chunks of one size, the last filled up, so that there is one program.
        rows = np.arange(-(-num // CHUNK) * CHUNK) % num
        chunks = [jax.tree.map(lambda leaf, at=at: leaf[at], transitions) for at in rows.reshape(-1, CHUNK)]
        judge = jax.jit(self.judge_some)
        parts = [jax.device_get(judge(models, normalizers, chunk)) for chunk in chunks]
        return Judged(*(np.concatenate(column)[:num] for column in zip(*parts, strict=True)))

    def judge_some(self, models: Any, normalizers: Normalizers, rows: Transition) -> tuple[Array, ...]:
        """The entries of `Judged`, of `rows [CHUNK, ...]`."""
        prediction, target = self.belief.judge(models, normalizers, rows)
        stated = 0.0 * target if prediction.var is None else jnp.mean(prediction.var, axis=0)
        return (
            rewards.variance(prediction),
            rewards.prediction_error(prediction, target),
            jnp.sum(stated, axis=-1),
            jax.vmap(self.env.coverage.cell)(rows.obs),
        )


def walk(env: Environment, key: Key, act: Act, num_steps: int) -> Transition:
    """`num_steps` of acting from a new start, episode after episode; those whose physics diverged are left out."""
    start_key, key = jax.random.split(key)
    _, rows, valid = jax.device_get(make_walk(env, num_steps)(key, env.reset(start_key), act, num_steps))
    return jax.tree.map(lambda leaf: leaf[valid], rows)


def walk_elsewhere(env: Environment, key: Key, act: Act) -> Transition | None:
    """Uniform actions from starts all over the environment; None where it cannot be put where one likes."""
    if env.reset_in is None:
        return None
    step = prepared(env).step
    cells = np.arange(env.coverage.num_cells)
    if len(cells) > STARTS:
        cells = np.random.default_rng(0).choice(cells, STARTS, replace=False)
    keys = jax.random.split(key, STARTS // len(cells) * len(cells))
    found = []
    for start_key, cell in zip(keys, np.resize(cells, len(keys)), strict=True):
        state = env.reset_in(start_key, int(cell))
        for t in range(STEPS_EACH):
            state, transition = step(state, act(jax.random.fold_in(start_key, t + 1), jnp.asarray(state.obs)))
            found.append(transition)
            if transition.terminated | transition.truncated:
                break
    rows = jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(found))
    finite = np.isfinite(rows.obs).all(axis=-1) & np.isfinite(rows.next_obs).all(axis=-1)
    return jax.tree.map(lambda leaf: leaf[finite], rows)


def ask(config: RunConfig, env: Environment, explorer: Explorer, state: RunState, index: int) -> dict[str, Judged]:
    """Put the three kinds of transitions to the belief of one of a run's seeds.

    Args:
        config: the run's.
        env: where the agent acts.
        explorer: the agent.
        state: the run's last.
        index: which of its seeds.

    Returns:
        Name of a kind -> what the belief makes of it.

    Raises:
        ValueError: the method has no belief.
    """
    own: ExplorerState = jax.tree.map(lambda leaf: leaf[index], state.explorer)
    belief = make_belief(config, env)
    judge = Judge(belief, env)
    model_key, data_key, new_key, elsewhere_key = jax.random.split(jax.random.key(config.seed + index), 4)
    models = jax.jit(belief.sample, static_argnums=2)(model_key, own.belief, belief.num_models)

    actor = explorer.actor(own)
    act = jax.jit(lambda key, obs: explorer.act(key, actor, obs))
    rows = jax.random.permutation(data_key, int(own.data.size))[:MOST_DATA]
    kinds = {
        DATA: jax.tree.map(lambda leaf: np.asarray(leaf[rows]), own.data.rows),
        HELD_OUT: walk(env, new_key, act, NEW_STEPS),
    }
    judged = {name: judge(models, own.normalizers, transitions) for name, transitions in kinds.items()}
    elsewhere = walk_elsewhere(env, elsewhere_key, jax.jit(explorer.act_uniformly))
    if elsewhere is not None:
        all_over = judge(models, own.normalizers, elsewhere)
        seen = (all_over.cell >= 0) & state.visited[index][all_over.cell]
        judged |= {SEEN: all_over[seen], UNSEEN: all_over[~seen & (all_over.cell >= 0)]}
    return judged
