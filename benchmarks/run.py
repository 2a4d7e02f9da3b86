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

import jax

from benchmarks.environments import environments
from benchmarks.kernels import kernels
from benchmarks.methods import methods
from benchmarks.result import Result, as_time, table
from benchmarks.timing import matmul_rate
from experiments.runtime import use_compilation_cache, versions

RESULTS = Path(__file__).parent / "results"
PARTS = ("environments", "kernels", "methods")


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
    parser.add_argument("--only", choices=PARTS, help="one part of the table")
    parser.add_argument("--out", type=Path, help="JSON file to write; default: benchmarks/results/DEVICE.json")
    arguments = parser.parse_args()
    if arguments.out is not None and not arguments.out.resolve().parent.is_dir():
        parser.error(f"--out={arguments.out}. Allowed: a file in a directory that is there.")
    if arguments.out is not None and (arguments.out.is_dir() or not os.access(arguments.out.resolve().parent, os.W_OK)):
        parser.error(f"--out={arguments.out} cannot be written. Allowed: a file that can be.")
    use_compilation_cache()
    device = jax.devices()[0].device_kind
    rate = matmul_rate()
    print(f"{device}: {rate / 1e9:,.0f} GFLOP/s in a float32 matrix product\n")
    results = []
    for result in run_all(rate, quick=arguments.quick, only=arguments.only):
        results.append(result)
        print(f"  {result.kernel}, {result.shape}: {as_time(result.seconds)}", file=sys.stderr, flush=True)
    print(table(results))
    out = arguments.out or RESULTS / f"{device.replace(' ', '-').lower()}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    machine = {
        "device": device,
        "processor": _processor(),
        "platform": platform.platform(),
        "date": time.strftime("%Y-%m-%d"),
        "matmul_flops_per_second": rate,
        "versions": versions(),
    }
    rows = [result.to_dict() for result in results]
    out.write_text(json.dumps({"machine": machine, "results": rows}, indent=2) + "\n")
    print(f"\nwritten to {out}")
    return 0


def _processor() -> str:
    """The processor's own name, as Linux tells it, or Python's."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    sys.exit(main())
