"""Seeds spread over devices."""

import json
import os
import re
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.training.placement import Placement, place, share
from tests import devices


@pytest.mark.parametrize(
    ("num_seeds", "num_devices", "expected"), [(1, 8, 1), (2, 8, 2), (8, 8, 8), (12, 8, 6), (7, 4, 1), (4, 1, 1)]
)
def test_all_devices_get_the_same_number_of_seeds(num_seeds, num_devices, expected):
    assert share(num_seeds, num_devices) == expected


def test_on_one_device_a_program_is_what_it_is_without_a_placement():
    def function(x):
        return 2.0 * x

    one = place(4, jax.devices()[:1])
    assert one == Placement() == place(1)
    assert one.spread(function) is function
    tree = {"x": jnp.ones(4)}
    assert one.gather(tree) is tree


def test_each_device_computes_its_own_seeds():
    two = place(4)
    seen = []

    def function(x, step):
        seen.append((x.shape, step.shape))
        return x + step

    x = np.arange(8.0, dtype=np.float32).reshape(4, 2)
    found = jax.jit(two.spread(function, shared=(1,)))(x, 3)
    assert seen == [((2, 2), ())]
    assert found.sharding == two.sharding
    assert [shard.device for shard in found.addressable_shards] == jax.devices()[:2]
    np.testing.assert_array_equal(found, x + 3)
    assert two.gather(found).sharding.device_set == {jax.devices()[0]}


def check(found, count):
    assert found["parts"] == [count, count]
    assert found["collectives"] == []
    assert found["collectives of a program that XLA splits"] == ["all-reduce"]  # it finds them where they are
    assert (found["lies there"], found["each"]) == (True, [1])
    assert found["in place"]
    # rounding: a product of a batch of matrices rounds otherwise than that of one
    assert (found["from those beside"] or 0.0) < 1e-4
    assert found["from the last alone"] < 1e-4
    assert found["from another seed"] > 0.1


@pytest.mark.slow
def test_eight_seeds_on_eight_devices_are_those_on_one_and_wait_for_none_another():
    module, words = "tests.experiments.on_many_devices", ("implicit belief", 8)
    check(devices.result(devices.start(module, *words, num_devices=8)), 8)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["implicit", "max_reactive", "rnd"])
def test_whole_methods_on_eight_devices(method):
    check(devices.result(devices.start("tests.experiments.on_many_devices", method, 8, num_devices=8)), 8)


@pytest.mark.slow
def test_two_processes_share_the_seeds_of_one_program(tmp_path):
    # the example of the documentation, in two processes of a device each, and in one of two
    page = (devices.ROOT / "experiments/training/README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "seeds.py").write_text(code)

    def start(port: int, count: int) -> list[subprocess.Popen[str]]:
        flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={2 // count}"
        own = {"PYTHONPATH": str(devices.ROOT), "XLA_FLAGS": flags, "JAX_CPU_COLLECTIVES_IMPLEMENTATION": "gloo"}
        command = [sys.executable, str(tmp_path / "seeds.py"), f"localhost:{port}", str(count)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return [subprocess.Popen([*command, str(i)], env={**os.environ, **own}, **pipes) for i in range(count)]

    processes = [*start(free_port(), 2), *start(free_port(), 1)]
    told = []
    for process in processes:
        stdout, stderr = process.communicate(timeout=500)
        assert process.returncode == 0, stderr
        told.append([line.split(maxsplit=2) for line in stdout.splitlines() if line[0].isdecimal()])
    first, second, both = ({(int(step), int(seed)): json.loads(values) for step, seed, values in one} for one in told)
    assert {seed for _, seed in first} == {0}
    assert {seed for _, seed in second} == {2}
    assert len(both) == len(first) + len(second) == 2 * 3  # after 50, 75 and 100 steps
    for where, values in {**first, **second}.items():
        assert len(values) == 2
        np.testing.assert_allclose(values, both[where], rtol=1e-3)


def free_port() -> int:
    with socket.socket() as own:
        own.bind(("localhost", 0))
        return own.getsockname()[1]
