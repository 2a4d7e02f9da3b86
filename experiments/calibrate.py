"""`python -m experiments.calibrate RUN ...`: what the belief of a finished run knows, and whether it knows that.

A belief is asked about three kinds of real transitions: the data it was fitted to, what its own agent meets in episodes
that it was not fitted to, and uniform actions elsewhere, in every part of the environment, been to or not. For each,
the models' disagreement (equation 1 of Ratzlaff et al. 2020) is held against the squared error of their mean.
"""

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.base import Environment, EnvState
from envs.errors import EnvironmentFault
from experiments import process, runtime
from experiments.analysis import figures
from experiments.analysis.calibration import FEWEST, Judged, record
from experiments.analysis.load import scene_of
from experiments.analysis.tables import number, text_table
from experiments.progress import Progress
from experiments.runs import modules
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.seeds import expand
from experiments.training import build, loop
from experiments.training.ask import NEW_STEPS, STARTS, STEPS_EACH, ask
from jaxplore.types import Key, Transition


def write(run: Path, until: int | None = None) -> str:
    """Ask the belief of a run as it stood at its last checkpoint, or at the last one up to the step `until`.

    Returns:
        A table; what was found and a picture are written to the run's directory.

    Raises:
        RunError: there is no run, no checkpoint, or no writing.
        ValueError: the method has no belief.
    """
    directory = RunDirectory(run)
    config = directory.config()
    own_env = build.make_env(config)
    explorer = build.make_agent(config, own_env)
    state, step = loop.last_state(directory, own_env, explorer, until)
    env, unit = build.on_host(config, own_env), scene_of(directory).variance_unit
    judged, each = [], num_steps(env)
    progress = Progress("asking", config.num_seeds * each)
    try:
        for index in range(config.num_seeds):
            judged.append(ask(config, watched(env, progress, index * each), explorer, state, index))
            progress.reach((index + 1) * each)
    finally:
        progress.close()
    seeds = [{"seed": config.seed + index, **record(own, env.coverage.num_cells)} for index, own in enumerate(judged)]
    title = f"{config.method} on {config.env} after {step:,} steps"
    found = {"method": config.method, "env": config.env, "step": step, "unit": unit, "seeds": seeds}
    file, picture = directory.write_calibration(found), directory.picture("calibration")
    groups = [
        figures.Reliability(name, one.variance, one.error)
        for name, one in judged[0].items()
        if len(one.error) >= FEWEST
    ]
    figures.plot_calibration(
        picture, groups, seeds[0].get("cells"), unit=unit, title=f"{title}, seed {config.seed}", fewest=FEWEST
    )
    shares = {one["seed"]: one["unseen_told_from_data"] for one in seeds}
    told_apart = [
        f"seed {seed}: variance is higher in unseen cells than on its data {share:.0%} of the time"
        for seed, share in shares.items()
        if share is not None
    ]
    return "\n".join(
        [title, f"unit: {unit}", "", _table(seeds, judged), "", *told_apart, f"written to {file}, {picture}"]
    )


def num_steps(env: Environment) -> int:
    """How many steps `ask` takes in `env` for one seed, at most."""
    cells = min(env.coverage.num_cells, STARTS)
    return NEW_STEPS + (STARTS // cells * cells * STEPS_EACH if env.reset_in else 0)


def watched(env: Environment, progress: Progress, before: int) -> Environment:
    """The same environment, whose steps `progress` is told of, after `before` earlier ones; of a compiled one it is the
    starts, as its steps are inside of a program.
    """
    done = before

    def tell(more: int) -> None:
        nonlocal done
        done += more
        progress.reach(done)

    def step(state: EnvState, action: Any) -> tuple[EnvState, Transition]:
        tell(1)
        return env.step(state, action)

    def step_all(states: tuple[EnvState, ...], actions: np.ndarray) -> tuple[tuple[EnvState, ...], Transition]:
        assert env.step_all is not None
        tell(len(states))
        return env.step_all(states, actions)

    def reset_in(key: Key, cell: int) -> EnvState:
        assert env.reset_in is not None
        tell(STEPS_EACH if env.compiled else 0)
        return env.reset_in(key, cell)

    changes: dict[str, Any] = {"reset_in": env.reset_in and reset_in}
    if not env.compiled:
        changes |= {"step": step, "step_all": env.step_all and step_all}
    return dataclasses.replace(env, **changes)


def _table(seeds: Sequence[Mapping[str, Any]], judged: Sequence[dict[str, Judged]]) -> str:
    head = ("seed", "transitions", "count", "squared error", "variance", "error / variance", "rank correlation")
    lines = []
    for found, own in zip(seeds, judged, strict=True):
        for name, one in found["sets"].items():
            ratio = one["error_per_predictive" if np.any(own[name].stated) else "error_per_variance"]
            numbers = (one["error"], one["variance"], ratio, one["rank"])
            lines.append((str(found["seed"]), name, f"{one['num']:,}", *map(number, numbers)))
    return text_table(head, lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Ask each run; the exit status is 0, 1 with a message, or 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m experiments.calibrate", description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="directories of runs with a checkpoint")
    parser.add_argument("--until", type=int, help="ask at the latest checkpoint up to this step (default: the last)")
    modules.add_flag(parser)
    process.add_flag(parser)
    arguments = parser.parse_args(argv)
    runtime.use_compilation_cache()
    try:
        modules.load(arguments.imports)
        for run in (run for path in arguments.runs for run in expand(path)):
            print(write(run, arguments.until) + "\n", flush=True)
    except (RunError, ValueError, EnvironmentFault) as error:
        print(f"error: {error}", file=sys.stderr)
        process.show_cause(error, debug=arguments.debug)
        return 1
    return 0


if __name__ == "__main__":
    process.carry_out(main)
