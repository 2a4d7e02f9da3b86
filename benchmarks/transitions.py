"""Stored transitions to judge beliefs by: a run's data, the steps that came next, and uniform actions in every cell.

`python -m benchmarks.transitions RUN NAME` takes them out of a run's latest checkpoint. The half cheetah cannot be put
into a cell, as its first entry is the velocity over a step that came before: its starts elsewhere have velocities and
pitch rates from all over the grid, and its first steps are left out.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs import half_cheetah
from envs.base import Environment
from envs.engines import host
from envs.stepper import Act
from experiments import process
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.files import replacing
from experiments.training import ask, build, loop
from jaxplore.types import Key, Transition

DATA = Path(__file__).parent / "data"
NUM_NEXT = 600
"""Steps of the run that are kept apart as those that came next."""
FIELDS = ("obs", "action", "next_obs")


class Stored(NamedTuple):
    """Three kinds of transitions of one environment; their rewards and ends are not kept."""

    data: Transition
    """What a belief is fitted to, in the order in which it came."""
    next_steps: Transition
    """What the same agent met next."""
    elsewhere: Transition
    """Uniform actions from starts in every cell."""


def names() -> list[str]:
    """What is stored."""
    return sorted(path.stem for path in DATA.glob("*.npz"))


def load(name: str) -> Stored:
    """The transitions stored under a name."""
    with np.load(DATA / f"{name}.npz") as arrays:
        return Stored(*(_transition(arrays, kind) for kind in Stored._fields))


def _transition(arrays: dict[str, np.ndarray], kind: str) -> Transition:
    obs, action, next_obs = (jnp.asarray(arrays[f"{kind}_{field}"]) for field in FIELDS)
    flags = jnp.zeros(len(obs), bool)
    return Transition(obs, action, jnp.zeros(len(obs)), next_obs, flags, flags)


def collect(run: Path) -> Stored:
    """The three kinds from a run's latest checkpoint, of its first seed.

    Raises:
        RunError: there is none, it holds too little, or its environment cannot be put where one likes.
    """
    directory = RunDirectory(run)
    config = directory.config()
    env = build.make_env(config)
    agent = build.make_agent(config, env)
    state, _ = loop.last_state(directory, env, agent)
    data = jax.device_get(jax.tree.map(lambda leaf: leaf[0], state.explorer.data))
    size = int(data.size)
    if size <= 2 * NUM_NEXT:
        raise RunError(f"{run} holds {size} transitions. Allowed: more than {2 * NUM_NEXT}.")
    walk = walk_from_any_speed if config.env == half_cheetah.SPEC.name else ask.walk_elsewhere
    elsewhere = walk(env, jax.random.key(config.seed), jax.jit(agent.act_uniformly))
    if elsewhere is None:
        raise RunError(f"{config.env} cannot be put where one likes, so nothing is known of elsewhere.")
    first, then = slice(0, size - NUM_NEXT), slice(size - NUM_NEXT, size)
    known, came = (jax.tree.map(lambda leaf, part=part: leaf[part], data.rows) for part in (first, then))
    return Stored(known, came, elsewhere)


def walk_from_any_speed(env: Environment, key: Key, act: Act) -> Transition:
    """Uniform actions of a half cheetah on C MuJoCo, from `ask.STARTS` starts that move as fast as any cell of its
    coverage says.
    """
    physics = host.make_physics(half_cheetah.make_model(), half_cheetah.FRAME_SKIP)
    fastest, found = jnp.array(half_cheetah.FASTEST), []
    for start_key in jax.random.split(key, ask.STARTS):
        state = env.reset(start_key)
        qpos, start_qvel = jax.device_get(half_cheetah.start(start_key))
        qvel: Any = np.array(start_qvel)
        qvel[[0, 2]] = jax.random.uniform(jax.random.fold_in(start_key, 0), (2,), minval=-fastest, maxval=fastest)
        state = dataclasses.replace(state, physics=physics.init(qpos, qvel))
        for t in range(1 + ask.STEPS_EACH):
            state, transition = env.step(state, act(jax.random.fold_in(start_key, t + 1), jnp.asarray(state.obs)))
            found += [transition] if t else []
    return jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(found))


def save(stored: Stored, name: str) -> Path:
    """Store transitions under a name, and give the file."""
    arrays: dict[str, Any] = {
        f"{kind}_{field}": np.asarray(getattr(rows, field), np.float32)
        for kind, rows in stored._asdict().items()
        for field in FIELDS
    }
    DATA.mkdir(exist_ok=True)
    with replacing(DATA / f"{name}.npz") as draft, draft.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return DATA / f"{name}.npz"


def main() -> int:
    """Take transitions out of a run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.transitions", description=__doc__)
    parser.add_argument("run", type=Path, help="directory of a run with a checkpoint")
    parser.add_argument("name", help="to store them under")
    arguments = parser.parse_args()
    try:
        stored = collect(arguments.run)
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    counts = ", ".join(f"{len(rows.obs):,} {kind}" for kind, rows in stored._asdict().items())
    print(f"{counts}: {save(stored, arguments.name)}")
    return 0


if __name__ == "__main__":
    process.carry_out(main)
