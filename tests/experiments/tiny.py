"""Runs so small that what takes time is to compile them, and an environment in pure JAX to go with them."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from envs.base import Environment, EnvSpec, EnvState, FloorPlan
from envs.coverage import make_box_coverage
from jaxplore.config import ExplorationConfig
from jaxplore.methods import METHODS
from jaxplore.types import Array, Key, Transition

# Rounds of 25, 6, 19, 25 and 6 steps; checkpoints after the first, third, fourth and last.
STEPS = (25, 31, 50, 75, 81)
RUN = ("--preset=smoke", "--steps=81", "--warm-up-steps=31", "--checkpoint-every=20")
GROUPS = {
    "dynamics": ("--dynamics.hidden", "8", "8"),
    "generator": ("--generator.hidden", "8", "--generator.noise-size=4"),
    "svgd": ("--svgd.num-particles=4",),
    "ensemble": ("--ensemble.num-members=4",),
    "fit": ("--fit.steps=2", "--fit.batch-size=8"),
    "imagination": (
        *("--imagination.num-actors=4", "--imagination.horizon=3", "--imagination.updates-per-rollout=2"),
        "--imagination.restart-every=3",
    ),
    "reactive": ("--reactive.updates=2", "--reactive.restart-every=3"),
    "sac": ("--sac.hidden", "8", "--sac.batch-size=8"),
    "gradient": ("--gradient.updates=2", "--gradient.batch-size=8", "--gradient.hidden", "8"),
    "rnd": ("--rnd.hidden", "8", "--rnd.features=4"),
    "ppo": ("--ppo.hidden", "8", "--ppo.rollout-steps=25", "--ppo.minibatch-size=5"),
    "ddqn": ("--ddqn.hidden", "8", "--ddqn.batch-size=8"),
    "ddpg": ("--ddpg.hidden", "8", "--ddpg.batch-size=8"),
    "task_sac": ("--task-sac.hidden", "8", "--task-sac.batch-size=8"),
}
"""Flags by the field of `ExplorationConfig` that they are of."""


def tiny_flags(method: str) -> tuple[str, ...]:
    """A tiny run of a method: the flags of the groups that it reads, as others are refused."""
    read = METHODS[method].reads(ExplorationConfig())
    return (*RUN, *(word for group, words in GROUPS.items() if group in read for word in words))


TINY = tiny_flags("implicit")
ROOT = Path(__file__).parent.parent.parent
TIMES = ("wall_time", "steps_per_second")
CELLS = ((-1.0, -1.0, 1.0, 1.0), (1.0, -1.0, 3.0, 1.0), (-1.0, 1.0, 1.0, 3.0))


def make_point(
    backend: str = "auto", obs_noise: float = 0.0, *, has_reward: bool = False, discrete: bool = False
) -> Environment:
    """A point on a floor, pushed by its two actions; an episode is 20 steps. Its task, if any: to be at x = 1."""
    names = ("x [m]", "y [m]", "x velocity", "y velocity")
    spec = EnvSpec("point", names, ("x push", "y push"), 20, 0.1, discrete=discrete, has_reward=has_reward)

    def reset(key: Key) -> EnvState:
        start_key, key = jax.random.split(key)
        obs = 0.1 * jax.random.normal(start_key, (4,))
        return EnvState(obs, obs, jnp.int32(0), key)

    def step(state: EnvState, action: Array) -> tuple[EnvState, Transition]:
        velocity = 0.9 * state.obs[2:] + 0.3 * action
        obs = jnp.concatenate([state.obs[:2] + 0.3 * velocity, velocity])
        num_steps = state.num_steps + 1
        reward = -jnp.abs(obs[0] - 1.0) if has_reward else jnp.float32(0)
        transition = Transition(state.obs, action, reward, obs, jnp.bool_(False), num_steps >= spec.episode_steps)
        return EnvState(obs, obs, num_steps, state.key), transition

    coverage = make_box_coverage((0, 1), CELLS, "squares")
    return Environment(spec, reset, step, coverage, "jax", True, FloorPlan((0, 1), (), CELLS))


def rows(out: Path) -> list[dict[str, Any]]:
    """A run's metrics without the times."""
    lines = (out / "metrics.jsonl").read_text().splitlines()
    return [{name: value for name, value in json.loads(line).items() if name not in TIMES} for line in lines]


def leaves(out: Path, step: int = STEPS[-1]) -> dict[str, Any]:
    """Everything in a checkpoint by its path, arrays as dtype, shape and bytes."""
    path = out / "checkpoints" / str(step)
    records = json.loads((path / "manifest.json").read_bytes().partition(b"\n")[2])["leaves"]
    with ocp.Checkpointer(ocp.StandardCheckpointHandler()) as checkpointer:
        arrays = checkpointer.restore(path.absolute() / "state")
    for name, array in arrays.items():
        array = np.asarray(array)
        records[name] = (records[name], array.dtype, array.shape, array.tobytes())
    return records


def assert_same_run(out: Path, other: Path, step: int = STEPS[-1]) -> None:
    """Two runs have the same metrics, times aside, and the same last state, to the bit."""
    assert rows(out) == rows(other)
    state, twin = leaves(out, step), leaves(other, step)
    assert state.keys() == twin.keys()
    assert [name for name in state if state[name] != twin[name]] == []
    with np.load(out / "walk.npz") as walk, np.load(other / "walk.npz") as expected:
        for name in ("positions", "episode_steps"):
            np.testing.assert_array_equal(walk[name], expected[name])
