"""Environment steps under random actions: every environment of `envs.FACTORIES`, on every backend that it offers."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import jax
import numpy as np

import envs
from benchmarks.result import Result, make_result
from benchmarks.timing import measure
from envs.adapters.to_gymnasium import gymnasium_id
from envs.base import Environment

HOST_STEPS = 300
MODES = ("sync", "async")
"""Of Gymnasium's vector environments: in one process, or in a process each."""
NUM_PROCESSES = 4
MJX_SIZES, FEW_MJX_SIZES, JAX_SIZES = (1, 16, 256), (16,), (1, 1024)
"""Environments side by side on a device; few in a quick run."""
SLOW = ("hand_block",)
"""Environments whose MJX programs take minutes to compile on a CPU: few sizes, and none in a quick run."""


def environments(*, quick: bool) -> Iterator[Result]:
    """Throughput of every environment of ours."""
    for name in envs.FACTORIES:
        for backend in sorted(envs.backends(name), reverse=True):  # the host before MJX
            yield from BACKENDS[backend](name, quick)


def on_host(name: str, quick: bool) -> Iterator[Result]:
    """One environment after the other, and through Gymnasium's vector environments."""
    call = host_steps(envs.make(name, backend="mujoco"), HOST_STEPS)
    yield throughput(f"{name}, C MuJoCo", 1, call, HOST_STEPS)
    for mode in MODES:
        yield vector_steps(name, NUM_PROCESSES, HOST_STEPS, mode)


def on_mjx(name: str, quick: bool) -> Iterator[Result]:
    """Under `vmap`, with MJX."""
    sizes = (FEW_MJX_SIZES, ()) if quick else (MJX_SIZES, FEW_MJX_SIZES)
    for num_envs in sizes[name in SLOW]:
        steps = 50 if num_envs == 1 else 10
        call = device_steps(envs.make(name, backend="mjx"), num_envs, steps)
        yield throughput(f"{name}, MJX", num_envs, call, steps)


def on_jax(name: str, quick: bool) -> Iterator[Result]:
    """Under `vmap`, in pure JAX."""
    for num_envs in JAX_SIZES:
        call = device_steps(envs.make(name, backend="jax"), num_envs, 1000)
        yield throughput(f"{name}, JAX", num_envs, call, 1000)


BACKENDS: dict[str, Callable[[str, bool], Iterator[Result]]] = {"mujoco": on_host, "mjx": on_mjx, "jax": on_jax}
"""Name of a backend, and what is measured of an environment on it: `(name, quick) -> results`."""


def throughput(kernel: str, num_envs: int, call: Callable[[], Any], steps: int) -> Result:
    """Time `call`, which takes `steps` steps of `num_envs` environments."""
    timing = measure(call, repeats=3, inner=steps * num_envs)
    return dataclasses.replace(make_result(kernel, f"{num_envs} in parallel", timing), per_second=1.0 / timing.best)


def host_steps(env: Environment, steps: int) -> Callable[[], Any]:
    """Steps of one environment on the host."""
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, env.spec.action_size)).astype(np.float32)

    def call() -> np.ndarray:
        state = env.reset(jax.random.key(0))
        for action in actions:
            state, _ = env.step(state, action)
        return np.asarray(state.obs)

    return call


def device_steps(env: Environment, num_envs: int, steps: int) -> Callable[[], Any]:
    """Steps of many environments on the device, in one program."""
    shape = (num_envs, env.spec.action_size)

    @jax.jit
    def call_all(keys: jax.Array) -> jax.Array:
        def step(states: Any, key: jax.Array) -> tuple[Any, None]:
            return jax.vmap(env.step)(states, jax.random.uniform(key, shape, minval=-1.0, maxval=1.0))[0], None

        states = jax.vmap(env.reset)(keys)
        return jax.lax.scan(step, states, jax.random.split(jax.random.key(1), steps))[0].obs

    keys = jax.random.split(jax.random.key(0), num_envs)
    return lambda: call_all(keys)


def vector_steps(name: str, num_envs: int, steps: int, mode: str) -> Result:
    """C MuJoCo through Gymnasium's vector environments, in one of `MODES`."""
    # Processes start afresh, as a fork of one that runs JAX can hang; "envs:" is what they import.
    options = {"context": "spawn"} if mode == "async" else {}
    id_ = f"envs:{gymnasium_id(name)}"
    vector = gymnasium.make_vec(id_, num_envs, vectorization_mode=mode, vector_kwargs=options, backend="mujoco")
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, *(vector.action_space.shape or ()))).astype(np.float32)

    def call() -> np.ndarray:
        obs, _ = vector.reset(seed=0)
        for action in actions:
            obs = vector.step(action)[0]
        return obs

    try:
        return throughput(f"{name}, C MuJoCo, Gymnasium {mode}", num_envs, call, steps)
    finally:
        vector.close()
