"""`python -m experiments.posterior RUN ...`: what the belief of a finished run knows, and whether it knows that.

A belief is asked about three kinds of real transitions: the data it was fitted to, what its own agent meets in episodes
that it was not fitted to, and uniform actions elsewhere, in every part of the environment, been to or not. For each,
the models' disagreement (equation 1 of Ratzlaff et al. 2020) is held against the squared error of their mean.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from envs.base import Environment
from envs.wrappers import Act, make_collect
from experiments import loop, plot
from experiments.config import RunConfig
from experiments.errors import RunError, disk_error
from experiments.log import number, table
from jaxplore import rewards
from jaxplore.beliefs import Belief
from jaxplore.dynamics import Normalizers
from jaxplore.exploration import Explorer, ExplorerState
from jaxplore.methods import get_method, reward_unit
from jaxplore.types import Array, Key, Transition

FILE = "posterior.json"
PICTURE = "posterior.png"

DATA, HELD_OUT, SEEN, UNSEEN = "its data", "new, its own policy", "elsewhere, cells seen", "elsewhere, cells not seen"
MOST_DATA = 2_000
"""Rows of the data that are looked at, drawn at random."""
NEW_STEPS = 600
"""Steps of the agent's own that the belief was not fitted to."""
STARTS = 140
"""Starts elsewhere, spread evenly over the cells; where there are more cells than this, in some of them."""
STEPS_EACH = 10
"""Uniform actions after each of them."""
FEWEST = 20
"""Of fewer transitions than these no figure is given."""
CHUNK = 500
"""Transitions predicted at once: all models and the paper's networks then take 0.3 GiB."""


class Judged(NamedTuple):
    """What a belief makes of some transitions, in units of normalised delta (or of probability), squared."""

    variance: np.ndarray
    """Equation 1: variance over models, summed over entries, `[N]`."""
    error: np.ndarray
    """Squared error of the models' mean, summed over entries, `[N]`."""
    stated: np.ndarray
    """Variance that Gaussian networks state, mean over models, summed over entries, `[N]`; 0 of other networks."""
    cell: np.ndarray
    """Coverage cell that the observation lies in, `[N]`, or -1."""

    def __getitem__(self, rows: Any) -> "Judged":  # pyright: ignore[reportIncompatibleMethodOverride]
        """Some of the transitions."""
        return Judged(self.variance[rows], self.error[rows], self.stated[rows], self.cell[rows])


@dataclasses.dataclass(frozen=True)
class Calibration:
    """How predicted variance orders and sizes the true error on one set of transitions."""

    num: int
    """Transitions."""
    error: float
    """Mean squared error of the models' mean."""
    variance: float
    """Mean variance over models."""
    error_per_variance: float | None
    """Their ratio: 1 where uncertainty is as large as errors are, above where the belief is too sure, below where it
    knows more than it thinks. None: there is no variance."""
    error_per_predictive: float | None
    """The same with the variance that Gaussian networks state added to the variance over models."""
    rank: float | None
    """Spearman's rank correlation of variance and squared error: 1 where the order is right. None: one is constant."""


def calibration(judged: Judged) -> Calibration | None:
    """The figures of one set of transitions; None where there are fewer than `FEWEST`."""
    num = len(judged.variance)
    if num < FEWEST:
        return None
    error, variance = float(np.mean(judged.error)), float(np.mean(judged.variance))
    predictive = variance + float(np.mean(judged.stated))
    constant = np.ptp(judged.variance) == 0 or np.ptp(judged.error) == 0
    return Calibration(
        num=num,
        error=error,
        variance=variance,
        error_per_variance=error / variance if variance > 0 else None,
        error_per_predictive=error / predictive if predictive > 0 else None,
        rank=None if constant else float(stats.spearmanr(judged.variance, judged.error)[0]),  # pyright: ignore[reportArgumentType]
    )


def told_apart(low: np.ndarray, high: np.ndarray) -> float | None:
    """How often a value of `high` is above one of `low`, ties half: 1 tells all apart, 0.5 none (the area under the
    receiver's curve). None where either has fewer than `FEWEST` values.
    """
    if min(len(low), len(high)) < FEWEST:
        return None
    return float(stats.mannwhitneyu(high, low).statistic / (len(low) * len(high)))


def make_judge(belief: Belief, env: Environment) -> Callable[[Any, Normalizers, Transition], Judged]:
    """`judge(models, normalizers, transitions [N, ...]) -> Judged`.

    Raises:
        ValueError: the belief predicts nothing.
    """
    predict = belief.predict
    if predict is None:
        raise ValueError("this method has no belief to ask. Allowed: a method with models of the environment.")

    @jax.jit
    def some(models: Any, normalizers: Normalizers, rows: Transition) -> tuple[Array, ...]:
        prediction = predict(models, belief.encoding.inputs(normalizers, rows.obs, rows.action))
        target = belief.encoding.targets(normalizers, rows.obs, rows.next_obs)
        stated = 0.0 * target if prediction.var is None else jnp.mean(prediction.var, axis=0)
        return (
            rewards.variance(prediction),
            rewards.prediction_error(prediction, target),
            jnp.sum(stated, axis=-1),
            jax.vmap(env.coverage.cell)(rows.obs),
        )

    def judge(models: Any, normalizers: Normalizers, transitions: Transition) -> Judged:
        num = len(transitions.obs)
        # Chunks of one size, the last filled up, so that there is one program.
        rows = np.arange(-(-num // CHUNK) * CHUNK) % num
        chunks = [jax.tree.map(lambda leaf, at=at: leaf[at], transitions) for at in rows.reshape(-1, CHUNK)]
        parts = [jax.device_get(some(models, normalizers, chunk)) for chunk in chunks]
        return Judged(*(np.concatenate(column)[:num] for column in zip(*parts, strict=True)))

    return judge


def walk(env: Environment, key: Key, act: Act, num_steps: int) -> Transition:
    """`num_steps` of acting from a new start, episode after episode; those whose physics diverged are left out."""
    collect = make_collect(env, num_steps)
    if env.compiled:
        collect = jax.jit(collect, static_argnums=(2, 3))
    start_key, key = jax.random.split(key)
    _, rows, valid = jax.device_get(collect(key, env.reset(start_key), act, num_steps))
    return jax.tree.map(lambda leaf: leaf[valid], rows)


def walk_elsewhere(env: Environment, key: Key, act: Act) -> Transition | None:
    """Uniform actions from starts all over the environment; None where it cannot be put where one likes."""
    if env.reset_in is None:
        return None
    step = jax.jit(env.step) if env.compiled else env.step
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


def ask(config: RunConfig, env: Environment, explorer: Explorer, state: loop.RunState, index: int) -> dict[str, Judged]:
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
    belief = get_method(config.method).belief(loop.sizes_of(env), config.explorer)
    judge = make_judge(belief, env)
    model_key, data_key, new_key, elsewhere_key = jax.random.split(jax.random.key(config.seed + index), 4)
    models = jax.jit(belief.sample, static_argnums=2)(model_key, own.belief, config.explorer.imagination.num_models)

    actor = explorer.actor(own)
    act = jax.jit(lambda key, obs: explorer.act(key, actor, obs))
    size = int(own.data.size)
    rows = jax.random.permutation(data_key, size)[:MOST_DATA]
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


def record(judged: dict[str, Judged], env: Environment) -> dict[str, Any]:
    """What is written to `posterior.json` of one seed."""
    figures = {name: calibration(one) for name, one in judged.items()}
    found: dict[str, Any] = {
        "sets": {name: dataclasses.asdict(one) for name, one in figures.items() if one is not None},
        "unseen_told_from_data": told_apart(judged[DATA].variance, judged[UNSEEN].variance)
        if UNSEEN in judged
        else None,
    }
    if UNSEEN in judged and env.coverage.num_cells <= plot.FEW_CELLS:
        found["cells"] = []
        for cell in range(env.coverage.num_cells):
            inside = {name: judged[name][judged[name].cell == cell] for name in (SEEN, UNSEEN)}
            name = UNSEEN if len(inside[UNSEEN].cell) else SEEN
            values = {
                quantity: float(np.median(getattr(inside[name], quantity))) if len(inside[name].cell) else None
                for quantity in ("variance", "error")
            }
            found["cells"].append({"cell": cell, "seen": name == SEEN, **values})
    return found


def write(run: Path, until: int | None = None) -> str:
    """Ask the belief of the run in `run`, as it stood at its last checkpoint or the last one up to the step `until`.

    Returns:
        A table; `posterior.json` and `posterior.png` are written to `run`.

    Raises:
        RunError: there is no run, no checkpoint, or no writing.
        ValueError: the method has no belief.
    """
    config = loop.read_config(run)
    own_env = loop.make_environment(config)
    explorer = loop.make_run_explorer(config, own_env)
    state, step = loop.last_state(run, config, own_env, explorer, until)
    env = loop.on_host(config, own_env)
    seeds, lines = [], []
    first: dict[str, Judged] = {}
    for index in range(config.num_seeds):
        judged = ask(config, env, explorer, state, index)
        first = first or judged
        found = record(judged, env)
        seeds.append({"seed": config.seed + index, **found})
        for name, one in found["sets"].items():
            ratio = one["error_per_predictive" if np.any(judged[name].stated) else "error_per_variance"]
            lines.append(
                (
                    str(config.seed + index),
                    name,
                    f"{one['num']:,}",
                    number(one["error"]),
                    number(one["variance"]),
                    number(ratio),
                    number(one["rank"]),
                )
            )
    unit = reward_unit(get_method("implicit"), config.explorer)
    title = f"{config.method} on {config.env} after {step:,} steps"
    text = {"method": config.method, "env": config.env, "step": step, "unit": unit, "seeds": seeds}
    try:
        draft = run / f"{FILE}.tmp"
        draft.write_text(json.dumps(text, indent=2) + "\n")
        draft.replace(run / FILE)
    except OSError as error:
        raise disk_error("write what the belief knows", run / FILE, error) from error
    groups = [
        plot.Reliability(name, one.variance, one.error) for name, one in first.items() if len(one.error) >= FEWEST
    ]
    plot.plot_posterior(
        run / PICTURE, groups, seeds[0].get("cells"), unit=unit, title=f"{title}, seed {config.seed}", fewest=FEWEST
    )
    head = ("seed", "transitions", "count", "squared error", "variance", "error / variance", "rank correlation")
    told = [one["unseen_told_from_data"] for one in seeds]
    after = [
        f"seed {one['seed']}: variance tells cells not seen from its data {value:.0%} of the time"
        for one, value in zip(seeds, told, strict=True)
        if value is not None
    ]
    files = f"written to {run / FILE}, {run / PICTURE}"
    return "\n".join([title, f"unit: {unit}", "", table(head, lines), "", *after, files])


def main(argv: Sequence[str] | None = None) -> int:
    """Ask each run; the exit status is 0, 1 with a message, or 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m experiments.posterior", description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="directories of runs with a checkpoint")
    parser.add_argument("--until", type=int, help="ask at the latest checkpoint up to this step (default: the last)")
    arguments = parser.parse_args(argv)
    from experiments.run import use_compilation_cache

    use_compilation_cache()
    try:
        for run in arguments.runs:
            print(write(run, arguments.until) + "\n", flush=True)
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
