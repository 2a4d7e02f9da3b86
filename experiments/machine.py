"""What this process may use of the machine."""

import contextlib
import os
import platform
from pathlib import Path

import jax

CPUINFO = Path("/proc/cpuinfo")
MEMINFO = Path("/proc/meminfo")
GROUP = Path("/sys/fs/cgroup")
"""What Linux limits a container to, seen from inside of it."""


def cores() -> int:
    """How many cores this process may run on: what it is bound to, and no more than its container is given."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, _, period = _read(GROUP / "cpu.max").partition(" ")
    if quota.isdecimal() and period.strip().isdecimal():
        return max(1, min(bound, round(int(quota) / int(period))))
    return bound


def describe() -> str:
    """What computes here, in words: the processor and, if it is another one, the device; cores, system."""
    names = _lines(CPUINFO, "model name")
    processor = names[0].partition(":")[2].strip() if names else platform.processor() or platform.machine()
    count = cores()
    parts = [processor, f"{count} core{'s' if count > 1 else ''}", f"{platform.system()} {platform.machine()}"]
    devices = jax.devices()
    if devices[0].platform != "cpu":
        many = f"{len(devices)} x " if len(devices) > 1 else ""
        parts.insert(0, f"{many}{devices[0].device_kind}")
    return ", ".join(parts)


def free_memory() -> int:
    """Bytes that can still be had, of the machine and of the container; where the system does not say, three quarters
    of what the machine has.
    """
    found = [_of_machine()]
    most = _read(GROUP / "memory.max").strip()
    used = _read(GROUP / "memory.current").strip()
    if most.isdecimal() and used.isdecimal():
        # Files that were read and not changed are counted as used, and given up when somebody needs their place.
        kept = next((line.split()[1] for line in _lines(GROUP / "memory.stat", "inactive_file ")), "0")
        found.append(int(most) - int(used) + int(kept))
    return max(0, min(found))


def _of_machine() -> int:
    for line in _lines(MEMINFO, "MemAvailable:"):
        return int(line.split()[1]) * 1024
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 3 // 4
    return 2**63


def _lines(path: Path, start: str) -> list[str]:
    return [line for line in _read(path).splitlines() if line.startswith(start)]


def _read(path: Path) -> str:
    with contextlib.suppress(OSError, UnicodeDecodeError):
        return path.read_text()
    return ""
