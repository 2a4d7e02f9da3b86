"""Python code in a process of its own, with as many virtual CPU devices as it wants."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


def start(module: str, *words: object, num_devices: int) -> subprocess.Popen[str]:
    """Start `module`, whose `main(*words)` returns what JSON can hold."""
    code = f"""
import json, sys, jax
jax.config.update("jax_num_cpu_devices", {num_devices})
jax.config.update("jax_numpy_rank_promotion", "raise")
import {module} as module
print("RESULT" + json.dumps(module.main(*sys.argv[1:])))
"""
    command = [sys.executable, "-c", code, *map(str, words)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, **pipes)


def result(process: subprocess.Popen[str], seconds: float = 300.0) -> Any:
    """What its `main` returned. One that takes longer is ended."""
    try:
        stdout, stderr = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        stdout, stderr = process.communicate()
        raise AssertionError(f"took longer than {seconds} s:\n{stderr}") from None
    assert process.returncode == 0, stderr
    (line,) = [line for line in stdout.splitlines() if line.startswith("RESULT")]
    return json.loads(line.removeprefix("RESULT"))
