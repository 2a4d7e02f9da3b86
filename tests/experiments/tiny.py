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
from jaxplore.types import Array, Key, Transition

# Rounds of 25, 6, 19, 25 and 6 steps; checkpoints after the first, third, fourth and last.
STEPS = (25, 31, 50, 75, 81)
TINY = (
    *("--preset=smoke", "--steps=81", "--warm-up-steps=31", "--checkpoint-every=20"),
    *("--dynamics.hidden", "8", "8", "--generator.hidden", "8", "--generator.noise-size=4", "--svgd.num-particles=4"),
    *("--fit.steps=2", "--fit.batch-size=8", "--imagination.num-models=4", "--imagination.num-actors=4"),
    *("--imagination.horizon=3", "--imagination.updates-per-rollout=2", "--imagination.restart-every=3"),
    *("--sac.hidden", "8", "--sac.batch-size=8"),
)
ROOT = Path(__file__).parent.parent.parent
TIMES = ("wall_time", "steps_per_second")
CELLS = ((-1.0, -1.0, 1.0, 1.0), (1.0, -1.0, 3.0, 1.0), (-1.0, 1.0, 1.0, 3.0))


def make_point(backend: str = "auto", obs_noise: float = 0.0) -> Environment:
    """A point on a floor, pushed by its two actions; an episode is 20 steps."""
    spec = EnvSpec("point", ("x [m]", "y [m]", "x velocity", "y velocity"), ("x push", "y push"), 20, 0.1)

    def reset(key: Key) -> EnvState:
        start_key, key = jax.random.split(key)
        obs = 0.1 * jax.random.normal(start_key, (4,))
        return EnvState(obs, obs, jnp.int32(0), key)

    def step(state: EnvState, action: Array) -> tuple[EnvState, Transition]:
        velocity = 0.9 * state.obs[2:] + 0.3 * action
        obs = jnp.concatenate([state.obs[:2] + 0.3 * velocity, velocity])
        num_steps = state.num_steps + 1
        zero = jnp.float32(0)
        transition = Transition(state.obs, action, zero, obs, jnp.bool_(False), num_steps >= spec.episode_steps)
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
