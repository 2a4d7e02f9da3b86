"""What a figure would take at the paper's scale: measured where runs of that preset are known, and otherwise
extrapolated from the FLOPs of what learns.
"""

import functools
import importlib
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.analysis.tables import duration
from experiments.runs.config import RunConfig
from experiments.runs.schedule import rounds
from experiments.runs.spec import RunSpec
from experiments.studies.estimates import Rates
from experiments.studies.figures_of_paper import Cell, Figure, config_of
from experiments.studies.plan import environment
from experiments.training.build import sizes_of
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.methods import METHODS

ROUND_FLOPS, ROUND_SECONDS = 44_482_913_280_000, 624.03
"""A round of the paper's preset in the Ant maze, and what it took on one core of an AMD EPYC: the last line of the
first table in `benchmarks/README.md`."""
RATE = ROUND_FLOPS / ROUND_SECONDS
"""FLOP/s that are counted on."""
UNCOUNTED = {"mcts": "tree search", "ppo": "PPO", "ddpg": "DDPG", "information": "what its actions tell"}
"""Groups of settings whose FLOPs nobody has put down, and what they are of."""


def describe(figure: Figure, rates: Rates) -> str:
    """How long the figure's runs would take with the paper's preset, in words, and how that is known.

    Args:
        figure: of the paper.
        rates: what steps took in runs of before.
    """
    measured, flops, uncounted = 0.0, 0.0, set[str]()
    cells = [cell for part in figure.parts for cell in _family(part.cells)]
    if not cells:
        return "not told: its fits are no runs"
    for config in dict.fromkeys(config_of(cell, "paper") for cell in cells):
        kind = (config.env, config.method, "paper")
        rate = rates.kinds.get(kind) if config.warm_up == "policy" else rates.of(RunSpec(config))
        if rate is not None:
            measured += rate * config.steps * config.num_seeds
            continue
        try:
            flops += run_flops(config) * config.num_seeds
        except ImportError:
            return "not told: benchmarks/ is not installed"
        read = METHODS[config.method].reads(config.explorer, sizes_of(environment(config)))
        uncounted |= {what for group, what in UNCOUNTED.items() if group in read}
    parts = [f"{_long(measured)} by runs of before"] if measured else []
    if flops:
        without = f" (without {', '.join(sorted(uncounted))})" if uncounted else ""
        parts.append(
            f"extrapolated, not measured: {_long(flops / RATE)} of one core, for {flops:.1e} FLOPs of learning"
            f"{without} at {RATE / 1e9:.0f} GFLOP/s, the pace of a round of that preset (benchmarks/README.md)"
        )
    return "; and ".join(parts) or "nothing learns"


def _long(seconds: float) -> str:
    return f"{seconds / 3600:,.0f} h" if seconds >= 360_000 else duration(seconds)


def _family(cells: Sequence[Cell]) -> list[Cell]:
    return [one for cell in cells for one in (cell.parent, cell) if one is not None]


@functools.cache
def run_flops(config: RunConfig) -> float:
    """FLOPs of the matrix products of one seed's learning, all rounds together.

    Raises:
        ImportError: there are no benchmarks here, which know what a kernel's are.
    """
    explorer = config.explorer
    sizes = sizes_of(environment(config))
    read = METHODS[config.method].reads(explorer, sizes)
    ends = np.array([end for _, end in rounds(config, 0) if end >= explorer.warm_up_steps])
    fixed = _behaviour_flops(explorer, sizes, read)
    if "fit" not in read:
        return float(fixed * len(ends))
    steps = np.broadcast_to(np.asarray(explorer.fit.num_steps(jnp.asarray(ends))), ends.shape)
    return float(fixed * len(ends) + _fit_flops(explorer, sizes, read) * steps.sum(dtype=float))


def _counts() -> Any:
    return importlib.import_module("benchmarks.flops")


def _target(explorer: ExplorationConfig, sizes: Sizes) -> tuple[int, ...]:
    """Widths of a dynamics network."""
    return (sizes.obs + sizes.action, *explorer.dynamics.hidden, sizes.obs)


def _fit_flops(explorer: ExplorationConfig, sizes: Sizes, read: frozenset[str]) -> int:
    """Of one gradient step of the belief."""
    flops, batch, target = _counts(), explorer.fit.batch_size, _target(explorer, sizes)
    if "svgd" not in read:
        return flops.ensemble_step(target, explorer.ensemble.num_members, batch)
    svgd, generator = explorer.svgd, explorer.generator
    further = {"perturbed": batch, "independent": batch, "uniform": svgd.num_repulsion_points}
    rows, count = batch + further.get(svgd.repulsion_points, 0), generator.num_generators
    widths = (generator.noise_size, *generator.hidden)
    return count * flops.svgd_step(target, widths, svgd.num_particles // count, rows)


def _behaviour_flops(explorer: ExplorationConfig, sizes: Sizes, read: frozenset[str]) -> int:
    """Of what a round does beside fitting."""
    flops, target, total = _counts(), _target(explorer, sizes), 0
    models = explorer.svgd.num_particles if "svgd" in read else explorer.ensemble.num_members
    updates = explorer.reactive.updates if "reactive" in read else 0
    updates += explorer.model_free.updates_per_round if "model_free" in read else 0
    if "imagination" in read:
        one = explorer.imagination
        updates += one.real_updates + (one.num_rollouts - one.num_random_rollouts) * one.updates_per_rollout
        if one.real_fraction < 1.0:
            policy = (sizes.obs, *explorer.sac.hidden, 2 * sizes.action)
            steps = one.num_rollouts * one.horizon
            total += steps * flops.imagined_step(target, policy, models, one.num_actors)
    for name in ("sac", "task_sac"):
        if name in read:
            sac = getattr(explorer, name)
            total += updates * flops.sac_update(sizes.obs, sizes.action, sac.hidden, sac.batch_size)
    if "ddqn" in read:
        q, batch = (sizes.obs, *explorer.ddqn.hidden, sizes.action), explorer.ddqn.batch_size
        total += updates * (flops.train(q, batch) + 2 * flops.forward(q, batch))  # Now and later, by both copies.
    if "gradient" in read:
        one = explorer.gradient
        policy = (sizes.obs, *one.hidden, 2 * sizes.action)
        through = one.horizon * models * 2 * flops.forward(target, one.batch_size)  # Forward, and back to the action.
        total += one.updates * (flops.train(policy, one.batch_size) + through)
    return total
