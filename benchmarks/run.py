"""`python -m benchmarks.run`: one table of what a step of each kernel costs, beside what it must cost.

Every figure is measured in this one process, and so is the matrix-product rate that the floors divide by.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from benchmarks import peers
from benchmarks.environments import environments
from benchmarks.kernels import kernels
from benchmarks.methods import methods
from benchmarks.peers import common
from benchmarks.result import Result, as_time, table
from benchmarks.timing import matmul_rate
from experiments.runtime import use_compilation_cache, versions

RESULTS = Path(__file__).parent / "results"
PARTS = ("environments", "kernels", "methods")
PEERS = "peers"
"""A table of its own, which is only printed where it is asked for."""


def run_all(rate: float, *, quick: bool, only: str | None = None) -> Iterator[Result]:
    """Every line of the table, in order, or one part of it."""
    if only in (None, "environments"):
        yield from environments(quick=quick)
    if only in (None, "kernels"):
        yield from kernels(rate, quick=quick)
    if only in (None, "methods"):
        yield from methods()


def main() -> int:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="leave out many or slow MJX environments and the paper's round"
    )
    help_only = f"one part of the table, or the table of peers, which needs {peers.EXTRA}"
    parser.add_argument("--only", choices=(*PARTS, PEERS), help=help_only)
    parser.add_argument("--out", type=Path, help="JSON file to write; default: benchmarks/results/DEVICE.json")
    arguments = parser.parse_args()
    if arguments.out is not None and not arguments.out.resolve().parent.is_dir():
        parser.error(f"--out={arguments.out}. Allowed: a file in a directory that is there.")
    if arguments.out is not None and (arguments.out.is_dir() or not os.access(arguments.out.resolve().parent, os.W_OK)):
        parser.error(f"--out={arguments.out} cannot be written. Allowed: a file that can be.")
    there = peers.present()
    if arguments.only == PEERS:
        if message := peers.missing_message(there):
            print(message, file=sys.stderr)
        if not peers.any_of_extra(there):
            return 2
    use_compilation_cache()
    measure = _measure_peers if arguments.only == PEERS else _measure_table
    suffix = f"-{PEERS}" if arguments.only == PEERS else ""
    device = jax.devices()[0].device_kind
    out = arguments.out or RESULTS / f"{device.replace(' ', '-').lower()}{suffix}.json"
    found = measure(device, arguments)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(found, indent=2) + "\n")
    print(f"\nwritten to {out}")
    return 0


def _measure_table(device: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure and print the table of ours; what the JSON holds."""
    rate = _rate(device)
    results = []
    for result in run_all(rate, quick=arguments.quick, only=arguments.only):
        results.append(result)
        print(f"  {result.kernel}, {result.shape}: {as_time(result.seconds)}", file=sys.stderr, flush=True)
    print(table(results))
    if arguments.only is None:
        print(f"peers: left out; --only={PEERS} compares with them", file=sys.stderr)
    return {"machine": _machine(device, rate), "results": [result.to_dict() for result in results]}


def _measure_peers(device: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure and print the table of peers; what the JSON holds."""
    there, load = peers.present(), os.getloadavg()
    cores, rate = peers.stay_on_one_core(), _rate(device)
    lines = []
    for line in peers.peers(there):
        lines.append(line)
        said = f"{as_time(line.pairs.ours)}, {line.who} takes {line.pairs.ratio:.2f} times as long"
        print(f"  {line.kernel}, {line.shape}: {said}", file=sys.stderr, flush=True)
    print(common.table(lines))
    machine = _machine(device, rate)
    machine["versions"] |= peers.peer_versions(there)
    machine |= {"processors_used": cores, "load_before": load[0], "load_after": os.getloadavg()[0]}
    return {"machine": machine, "results": [line.to_dict() for line in lines]}


def _rate(device: str) -> float:
    """FLOP/s of a matrix product, which is printed, too."""
    rate = matmul_rate()
    print(f"{device}: {rate / 1e9:,.0f} GFLOP/s in a float32 matrix product\n")
    return rate


def _machine(device: str, rate: float) -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "device": device,
        "processor": _processor(),
        "platform": platform.platform(),
        "date": time.strftime("%Y-%m-%d"),
        "matmul_flops_per_second": rate,
        "versions": versions(),
    }


def _processor() -> str:
    """The processor's own name, as Linux tells it, or Python's."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    sys.exit(main())
