"""The parts of `python -m benchmarks.gpu` that compute, each in a process of its own: `python -m benchmarks.gpu_stages
NAME FILE`. What is measured is appended to FILE line by line, so what comes before a crash is kept.
"""

import argparse
import dataclasses
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

import envs
from benchmarks import kernels
from benchmarks.environments import device_steps, throughput
from benchmarks.result import Result
from benchmarks.timing import matmul_rate
from experiments.runs.config import RunConfig
from experiments.runs.directory import RunDirectory
from experiments.runs.presets import preset_config
from experiments.runs.spec import RunSpec
from experiments.runtime import use_compilation_cache, versions
from experiments.training import build, loop

SIZES, SMALL_SIZES = (1, 4096, 256, 16, 1024, 64), (1, 16)
"""Ants side by side; the ends first, should the time not suffice for all."""
VARIABLES = ("XLA_", "JAX_", "CUDA_VISIBLE", "NVIDIA_TF32", "PJRT_", "NPROC", "MJX_", "NCCL_", "TF_XLA_")
"""How the names of environment variables begin that may change what is measured."""
FULL = "highest"
"""Matrix products in float32. JAX's own choice on recent NVIDIA GPUs is TF32, with 10 bits of mantissa."""


def hardware(*, small: bool) -> Iterator[dict[str, Any]]:
    """What computes."""
    device = jax.devices()[0]
    stats = device.memory_stats() or {}
    yield {
        "platform": device.platform,
        "device": device.device_kind,
        "num_devices": len(jax.devices()),
        "memory_bytes": stats.get("bytes_limit"),
        "runtime": getattr(device.client, "platform_version", None),
        "host": platform.platform(),
        "host_cores": os.cpu_count(),
        "variables": {name: os.environ[name] for name in sorted(os.environ) if _matters(name)},
        "date": time.strftime("%Y-%m-%d"),
        "versions": {**versions(), **_plugins()},
    }
    yield {"matmul_precision": "default", "flops_per_second": matmul_rate()}
    with jax.default_matmul_precision(FULL):
        yield {"matmul_precision": FULL, "flops_per_second": matmul_rate()}


def measure_kernels(*, small: bool) -> Iterator[dict[str, Any]]:
    """All kernels at both shapes; then those of the paper's shape again with all of float32's digits."""
    if small:
        config, rate = preset_config("smoke").explorer, matmul_rate()
        for result in (kernels.svgd_step(config, rate, 2), kernels.sac_update(config, rate, 2)):
            yield _line(result)
        return
    yield from map(_line, kernels.kernels(matmul_rate(), quick=False))
    config = preset_config("paper").explorer
    with jax.default_matmul_precision(FULL):
        rate = matmul_rate()
        for result in (
            kernels.svgd_step(config, rate, 3),
            kernels.imagined_step(config, rate),
            kernels.sac_update(config, rate, 3),
        ):
            yield _line(dataclasses.replace(result, kernel=f"{result.kernel}, full float32"))


def measure_environments(*, small: bool) -> Iterator[dict[str, Any]]:
    """Steps of the Ant maze on MJX under random actions (small: of the cheetah, which compiles sooner)."""
    name = "half_cheetah" if small else "ant_maze"
    for num_envs in SMALL_SIZES if small else SIZES:
        steps = 20 if num_envs == 1 else 10
        call = device_steps(envs.make(name, backend="mjx"), num_envs, steps)
        yield _line(throughput(f"{name}, MJX", num_envs, call, steps))


def carry_out_run(config: RunConfig, path: str) -> None:
    """A run without the command line, for where what reads its flags is not installed. Continues what is there."""
    env = build.make_env(config)
    config = dataclasses.replace(config, backend=env.backend)
    agent, spec, directory = build.make_agent(config, env), RunSpec(config), RunDirectory(path)
    began = (Path(path) / "config.json").exists()
    if not began:
        directory.begin(spec, build.make_scene(config, env, agent))
    loop.run(spec, directory, env, agent, resume=began)


STAGES: dict[str, Callable[..., Iterator[dict[str, Any]]]] = {
    "hardware": hardware,
    "kernels": measure_kernels,
    "environments": measure_environments,
}


def _line(result: Result) -> dict[str, Any]:
    return result.to_dict()


def _matters(variable: str) -> bool:
    return variable.startswith(VARIABLES) and not variable.endswith("_DIR")


def _plugins() -> dict[str, str]:
    """Versions of the packages that bring CUDA to JAX."""
    names = {name for one in metadata.distributions() if (name := one.metadata["Name"])}
    wanted = sorted(name for name in names if name.startswith(("jax-cuda", "nvidia-cudnn", "nvidia-cublas")))
    return {name: metadata.version(name) for name in wanted}


def main() -> int:
    """Measure one stage, or carry out the run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu_stages", description=__doc__)
    parser.add_argument("stage", choices=[*STAGES, "run"])
    parser.add_argument("path", help="file of results; the run's directory")
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--config", help="JSON of what the run departs in from its preset")
    arguments = parser.parse_args()
    use_compilation_cache()
    if arguments.stage == "run":
        own = json.loads(arguments.config)
        carry_out_run(dataclasses.replace(preset_config(own.pop("preset"), own.pop("env")), **own), arguments.path)
        return 0
    for record in STAGES[arguments.stage](small=arguments.small):
        with open(arguments.path, "a") as file:
            file.write(json.dumps(record) + "\n")
        print(json.dumps(record)[:200], flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
