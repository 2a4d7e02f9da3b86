"""A hundred kills at random moments, also of two processes at one directory: no row is lost and none is doubled."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.runs import lock
from tests.experiments.tiny import ROOT, assert_same_run, rows

KILLS = 100
STEPS = 4_000

# Forks children that have everything imported and nothing computed, so that most of their lives are in the run.
LAUNCHER = """
import os, random, signal, sys, time
import envs
from experiments import run
from experiments.analysis import report
from tests.experiments.tiny import make_point

envs.FACTORIES["point"] = make_point
out, kills, words = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
draw = random.Random(0)

def child():
    pid = os.fork()
    if pid == 0:
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1), os.dup2(silence, 2)
        os._exit(run.main([f"--out={out}", *(["--resume"] if os.path.exists(out) else []), *words]))
    return pid

ends = {}
for number in range(kills):
    # every third time two at once: one of them is told that the other has the directory
    pids = [child() for _ in range(2 if number % 3 == 0 else 1)]
    time.sleep(draw.uniform(0.3, 2.5))
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
        end = os.waitstatus_to_exitcode(status)
        ends[end] = ends.get(end, 0) + 1
print(ends)
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forked processes")
def test_a_hundred_kills(tell, point: str, tmp_path: Path):
    words = ["--env=point", "--method=random", "--preset=smoke", f"--steps={STEPS}", "--checkpoint-every=50"]
    out = tmp_path / "run"
    command = [sys.executable, "-c", LAUNCHER, str(out), str(KILLS), *words]
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": "2", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    assert (out / lock.NAME).exists() or rows(out)[-1]["step"] == STEPS
    assert tell(out, "--resume").status == 0
    assert tell(tmp_path / "whole", *words).status == 0
    assert_same_run(tmp_path / "whole", out, STEPS)
    assert list(out.rglob("*.tmp*")) == []
