"""Environment steps under random actions, beside Gymnasium's own environments in its vector environments.

The half cheetah in C MuJoCo: four of ours, one after the other, beside four of Gymnasium's in one process and in one
process each. The acrobot, ours in pure JAX with a continuous torque, beside Gymnasium's `Acrobot-v1` in one process:
once with ours in one program, and once with each step asked for from Python, as theirs is.
"""

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import jax
import numpy as np

import envs
from benchmarks.environments import device_steps
from benchmarks.peers.common import Line
from benchmarks.timing import measure_pairs
from envs.base import Environment

HOST_STEPS, DEVICE_STEPS = 100, 100
"""Of each environment in one call."""
NUM_HOST, NUM_DEVICE = 4, 64
"""Environments side by side."""


def lines() -> Iterator[Line]:
    """A step of one environment, of several side by side."""
    cheetah = envs.make("half_cheetah_task", backend="mujoco")
    for mode in ("sync", "async"):
        ours = ours_on_host(cheetah, NUM_HOST, HOST_STEPS)
        yield line("half cheetah, C MuJoCo", ours, "HalfCheetah-v5", NUM_HOST, HOST_STEPS, mode)
    acrobot = envs.make("acrobot", backend="jax")
    ours = device_steps(acrobot, NUM_DEVICE, DEVICE_STEPS)
    yield line("acrobot, JAX in one program", ours, "Acrobot-v1", NUM_DEVICE, DEVICE_STEPS, "sync")
    ours = ours_from_python(acrobot, NUM_DEVICE, DEVICE_STEPS)
    yield line("acrobot, JAX step by step", ours, "Acrobot-v1", NUM_DEVICE, DEVICE_STEPS, "sync")


def line(what: str, ours: Callable[[], Any], theirs: str, num: int, steps: int, mode: str) -> Line:
    """Time ours beside Gymnasium's `theirs`."""
    vector = gymnasium.make_vec(
        theirs, num, vectorization_mode=mode, vector_kwargs={"context": "spawn"} if mode == "async" else {}
    )
    try:
        pairs = measure_pairs(ours, gymnasium_steps(vector, steps), pairs=9, inner=num * steps)
    finally:
        vector.close()
    return Line(f"environment step, {what}", f"{num} in parallel", f"Gymnasium {mode}", pairs)


def ours_on_host(env: Environment, num: int, steps: int) -> Callable[[], Any]:
    """Steps of `num` environments on the host, one after the other."""
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, num, env.spec.action_size)).astype(np.float32)
    keys = jax.random.split(jax.random.key(0), num)

    def call() -> Any:
        states = [env.reset(key) for key in keys]
        for step in actions:
            states = [env.step(state, action)[0] for state, action in zip(states, step, strict=True)]
        return [np.asarray(state.obs) for state in states]

    return call


def ours_from_python(env: Environment, num: int, steps: int) -> Callable[[], Any]:
    """Steps of `num` environments on the device, observations given to Python after each."""
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, num, env.spec.action_size)).astype(np.float32)
    keys = jax.random.split(jax.random.key(0), num)
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))

    def call() -> Any:
        states, obs = reset(keys), None
        for action in actions:
            states = step(states, action)[0]
            obs = np.asarray(states.obs)
        return obs

    return call


def gymnasium_steps(vector: Any, steps: int) -> Callable[[], Any]:
    """As many steps of Gymnasium's."""
    vector.action_space.seed(0)
    actions = [vector.action_space.sample() for _ in range(steps)]

    def call() -> Any:
        obs, _ = vector.reset(seed=0)
        for action in actions:
            obs = vector.step(action)[0]
        return obs

    return call
