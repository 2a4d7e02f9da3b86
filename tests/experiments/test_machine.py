import os
from pathlib import Path
from typing import NamedTuple

import pytest

from experiments import machine


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the system says, as files."""
    monkeypatch.setattr(machine, "GROUP", tmp_path)
    monkeypatch.setattr(machine, "MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    return tmp_path


@pytest.mark.parametrize(("text", "cores"), [("max 100000\n", 16), ("250000 100000\n", 2), ("50000 100000\n", 1)])
def test_a_container_has_the_cores_that_it_is_given(system: Path, text: str, cores: int):
    assert machine.cores() == 16
    (system / "cpu.max").write_text(text)
    assert machine.cores() == cores


def test_memory_is_what_the_machine_and_the_container_have_left(system: Path):
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert machine.free_memory() == whole * 3 // 4
    (system / "meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    4000 kB\n")
    assert machine.free_memory() == 4000 * 1024
    (system / "memory.max").write_text("max\n")
    (system / "memory.current").write_text("1500000\n")
    assert machine.free_memory() == 4000 * 1024
    (system / "memory.max").write_text("2000000\n")
    (system / "memory.stat").write_text("anon 1000000\ninactive_file 300000\n")
    assert machine.free_memory() == 800_000


def test_what_computes_here_in_words(system: Path, monkeypatch: pytest.MonkeyPatch):
    (system / "cpuinfo").write_text("processor\t: 0\nmodel name\t: AMD EPYC 7763\nmodel name\t: another\n")
    monkeypatch.setattr(machine, "CPUINFO", system / "cpuinfo")
    monkeypatch.setattr(machine.platform, "system", lambda: "Linux")
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    assert machine.describe() == "AMD EPYC 7763, 16 cores, Linux x86_64"

    class Device(NamedTuple):
        platform: str
        device_kind: str

    monkeypatch.setattr(machine.jax, "devices", lambda: [Device("gpu", "NVIDIA H200")] * 2)
    assert machine.describe() == "2 x NVIDIA H200, AMD EPYC 7763, 16 cores, Linux x86_64"
