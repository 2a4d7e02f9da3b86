"""`python -m benchmarks.gpu`: all there is to measure on a GPU, in one call of less than 9 minutes.

The tests marked `gpu`; every kernel at both shapes beside its floor; MJX with 1 to 4,096 ants; and the paper's run of
the Ant maze for as many rounds as fit, from which the whole of it is extrapolated. Call it again to continue that run.

Each part is a process of its own with a limit of its own, and the JSON is written after each. This process computes
nothing: JAX would take most of the GPU's memory for it.
"""

import argparse
import dataclasses
import importlib.util
import json
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from benchmarks import budget
from benchmarks.result import Result, as_time, table
from benchmarks.whole_run import extrapolate
from experiments.analysis.tables import duration, text_table
from experiments.runs.config import RunConfig
from experiments.runs.errors import RunError
from experiments.runs.metrics import read_metrics
from experiments.runs.presets import preset_config

ROOT = Path(__file__).parent.parent
FORMAT = 1
"""Of the JSON."""
BUDGET = 530.0
"""Seconds of a call."""
SHARES = {"hardware": 80.0, "tests": 90.0, "kernels": 130.0, "environments": 120.0, "run": 160.0}
"""Of the time, for each part in order; what one does not use goes to those after it. The first needs little of its own,
but reads all packages from a cold disk."""
PRESETS = {False: "paper", True: "smoke"}
"""Of the run; the second where it is only looked at."""
CHECKPOINT_EVERY = 100
"""Steps: what a call that is cut off loses of the run."""
COMMAND_LINE = ("tyro", "matplotlib", "scipy")
"""Packages without which `experiments.run` does not start, or does not end well."""
COUNTS = re.compile(r"(\d+) (passed|failed|skipped|errors?|xfailed|deselected)")
ENV = "ant_maze"


def run_config(small: bool) -> RunConfig:
    """The run: on the host's MuJoCo, which steps a single ant sooner than a GPU does."""
    config = preset_config(PRESETS[small], ENV)
    return dataclasses.replace(config, backend="mujoco", checkpoint_every=CHECKPOINT_EVERY)


def commands(small: bool, scratch: Path, run: Path) -> dict[str, list[str] | str]:
    """What each part calls, or why it cannot."""
    reduced = ["--small"] if small else []
    stage = [sys.executable, "-m", "benchmarks.gpu_stages"]
    found: dict[str, list[str] | str] = {
        name: [*stage, name, str(scratch / f"{name}.jsonl"), *reduced]
        for name in ("hardware", "kernels", "environments")
    }
    found["tests"] = test_command() if _installed("pytest") else "pytest is not installed"
    found["run"] = run_command(small, run)
    return found


def test_command() -> list[str]:
    """The tests marked `gpu`, with none of the options that the whole suite has: not all of it may be installed. Those
    of the command line only where that is.
    """
    files = [path for path in sorted((ROOT / "tests").rglob("test_*.py")) if "mark.gpu" in path.read_text()]
    if not _installed(*COMMAND_LINE):
        files = [path for path in files if "experiments" not in path.parts]
    options = ["-o", "addopts=", "-o", "filterwarnings=default", "--import-mode=importlib", "-q", "-ra", "-m", "gpu"]
    return [sys.executable, "-m", "pytest", *options, "-p", "no:cacheprovider", *map(str, files)]


def run_command(small: bool, run: Path) -> list[str]:
    """The run as a user starts or continues it; without its command line where packages of that are missing."""
    config = run_config(small)
    if _installed(*COMMAND_LINE):
        words = ["--resume"]
        if not (run / "config.json").exists():
            words = [f"--env={ENV}", f"--preset={config.preset}", f"--backend={config.backend}"]
            words.append(f"--checkpoint-every={CHECKPOINT_EVERY}")
        return [sys.executable, "-m", "experiments.run", f"--out={run}", *words]
    own = {"preset": config.preset, "env": ENV, "backend": config.backend, "checkpoint_every": CHECKPOINT_EVERY}
    return [sys.executable, "-m", "benchmarks.gpu_stages", "run", str(run), f"--config={json.dumps(own)}"]


def _installed(*names: str) -> bool:
    return all(importlib.util.find_spec(name) is not None for name in names)


def records(path: Path) -> list[dict[str, Any]]:
    """What a part has measured; a last line that was cut off is left out."""
    found = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return found


def read_stage(name: str, ended: budget.Ended, scratch: Path, config: RunConfig, run: Path) -> dict[str, Any]:
    """What the JSON says of a part."""
    found: dict[str, Any] = {"status": ended.status, "seconds": ended.seconds}
    if name == "tests":
        found["results"] = {what: int(count) for count, what in COUNTS.findall(ended.tail.rpartition("\n")[2])}
    elif name == "run":
        found |= {"directory": str(run), "results": read_run(run, config)}
    else:
        found["results"] = records(scratch / f"{name}.jsonl")
    if ended.status != "done":
        found |= {"exit_status": ended.code, "printed": ended.tail}
    return found


def read_run(run: Path, config: RunConfig) -> list[dict[str, Any]]:
    """Of each round of a run when it ended, how long all took so far, and how much of the maze had been seen."""
    try:
        rows = read_metrics(run / "metrics.jsonl")
    except RunError:
        return []
    kept = ("step", "seed", "wall_time", "steps_per_second", "coverage")
    return [{name: row[name] for name in kept if name in row} for row in rows if row.get("seed") == config.seed]


def seconds_per_fit_step(kernels: Sequence[Mapping[str, Any]], config: RunConfig) -> float | None:
    """Of the belief's gradient step at the run's shape, where it has been measured."""
    hidden = "-".join(map(str, config.explorer.dynamics.hidden))
    shape = f"{config.explorer.svgd.num_particles} x {hidden}, batch {config.explorer.fit.batch_size}"
    own = (one["seconds"] for one in kernels if one["kernel"] == "SVGD step" and one["shape"].startswith(shape))
    return next(own, None)


def describe(report: Mapping[str, Any]) -> str:
    """The report as text, for a terminal."""
    machine, stages = report["machine"], report["stages"]
    rates = [f"{one['flops_per_second'] / 1e12:,.3g} TFLOP/s ({one['matmul_precision']})" for one in machine["rates"]]
    lines = [f"{machine['device']} x {machine['num_devices']}, float32 matrix product: {', '.join(rates)}", ""]
    told = [(name, one["status"], f"{one.get('seconds', 0.0):.0f} s", summary(one)) for name, one in stages.items()]
    lines += [text_table(("part", "ended", "time", "what came of it"), told), ""]
    rows = [row for name in ("kernels", "environments") for row in stages.get(name, {}).get("results", [])]
    if rows:
        fields = Result.__dataclass_fields__
        lines += [table([Result(**{name: row[name] for name in fields}) for row in rows]), ""]
    whole = report.get("whole_run")
    if whole is None:
        return "\n".join([*lines, "No round of the run has been measured: call again to continue it."])
    what = f"EXTRAPOLATED from {whole['rounds_measured']} rounds" if whole["extrapolated"] else "measured"
    text = f"The whole run of {whole['rounds']} rounds: {duration(whole['seconds'])} ({what}"
    if whole["extrapolated"]:
        text += (
            f", the last at step {whole['last_step_measured']:,}: {as_time(whole['seconds_beside_the_fit'])} a round "
            f"beside the fit, {as_time(whole['seconds_per_fit_step'])} a gradient step, "
            f"{whole['seconds_per_fit_step_from']}; compiling left out"
        )
    return "\n".join([*lines, f"{text})"])


def summary(stage: Mapping[str, Any]) -> str:
    """A part's results in a few words."""
    results = stage.get("results")
    if isinstance(results, Mapping):
        return ", ".join(f"{count} {what}" for what, count in results.items()) or "nothing"
    return f"{len(results)} lines" if results is not None else stage.get("message", "")


def carry_out(report: dict[str, Any], left: Callable[[], float], scratch: Path, run: Path, save: Any) -> None:
    """All parts after the first, the report saved after each.

    Args:
        report: of the first; the others are added.
        left: seconds until the call must end.
        scratch: folder for what they print and measure.
        run: directory of the run.
        save: called with the report.
    """
    small = report["reduced"]
    config, todo = run_config(small), commands(small, scratch, run)
    names = [name for name in SHARES if name != "hardware"]
    for i, name in enumerate(names):
        command = todo[name]
        if isinstance(command, str):
            report["stages"][name] = {"status": "skipped", "message": command}
            continue
        seconds = budget.limit(left(), [SHARES[one] for one in names[i:]])
        print(f"{name}: {seconds:.0f} s at most", file=sys.stderr, flush=True)
        ended = budget.carry_out(command, seconds, scratch / f"{name}.log", ROOT)
        report["stages"][name] = {"limit_seconds": round(seconds, 1), **read_stage(name, ended, scratch, config, run)}
        if name == "run":
            step = seconds_per_fit_step(report["stages"].get("kernels", {}).get("results", []), config)
            report["whole_run"] = extrapolate(config, report["stages"]["run"]["results"], step)
        save(report)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, write the JSON, print the tables. The exit status is 0, 1 where a part failed, or 2 without a GPU."""
    began = time.monotonic()
    jax.config.update("jax_platforms", "cpu")  # of this process alone
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--budget", type=float, default=BUDGET, help=f"seconds for everything (default {BUDGET:.0f})")
    parser.add_argument("--allow-cpu", action="store_true", help="without a GPU look at a small version of it")
    parser.add_argument("--out", type=Path, help="JSON to write (default benchmarks/results/gpu-DEVICE.json)")
    parser.add_argument("--run", type=Path, help="directory of the run (default runs/gpu-DEVICE-PRESET)")
    arguments = parser.parse_args(argv)
    if arguments.budget < 2 * len(SHARES) * budget.GRACE:
        parser.error(f"--budget={arguments.budget:g}. Allowed: {2 * len(SHARES) * budget.GRACE:.0f} seconds or more.")

    def left() -> float:
        return arguments.budget - (time.monotonic() - began)

    with tempfile.TemporaryDirectory(prefix="jaxplore-gpu-") as folder:
        scratch = Path(folder)
        command = commands(arguments.allow_cpu, scratch, Path())["hardware"]
        seconds = budget.limit(left(), list(SHARES.values()))
        ended = budget.carry_out(list(command), seconds, scratch / "hardware.log", ROOT)
        machine, *rates = records(scratch / "hardware.jsonl") or [{}]
        if machine.get("platform") not in ("gpu", "cuda", "rocm") and not (arguments.allow_cpu and machine):
            why = f"JAX computes on {machine['device']!r}" if machine else f"JAX does not start: {ended.tail[-300:]}"
            print(f"error: no GPU: {why}. --allow-cpu looks at a small version of this.", file=sys.stderr)
            return 2
        small = machine["platform"] == "cpu"
        name = re.sub(r"[^\w.-]+", "-", machine["device"]).lower()
        out = arguments.out or (ROOT / "runs" if small else ROOT / "benchmarks" / "results") / f"gpu-{name}.json"
        run = arguments.run or ROOT / "runs" / f"gpu-{name}-{PRESETS[small]}"
        out.parent.mkdir(parents=True, exist_ok=True)

        def save(report: Mapping[str, Any]) -> None:
            whole = {**report, "seconds": round(time.monotonic() - began, 1)}
            draft = out.with_name(f"{out.name}.tmp")
            draft.write_text(json.dumps(whole, indent=2) + "\n")
            draft.replace(out)

        report: dict[str, Any] = {
            **{"format": FORMAT, "reduced": small, "budget_seconds": arguments.budget},
            "machine": {**machine, "driver": driver(scratch), "rates": rates},
            "stages": {"hardware": {"status": ended.status, "seconds": ended.seconds}},
            "whole_run": None,
        }
        save(report)
        carry_out(report, left, scratch, run.absolute(), save)
    print(f"{describe(report)}\n\nwritten to {out}")
    return int(any(one["status"] == "failed" for one in report["stages"].values()))


def driver(scratch: Path) -> str | None:
    """The GPUs with driver and memory as NVIDIA's own tool tells them; None without it."""
    log, fields = scratch / "driver.log", "name,driver_version,memory.total"
    ended = budget.carry_out(["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader"], 15.0, log)
    return ended.tail if ended.status == "done" else None


if __name__ == "__main__":
    sys.exit(main())
