"""Twenty kills, of workers and of the planner, at random moments: the same report in the end."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.analysis.page import Panel
from experiments.studies import figures_of_paper, plan, report
from experiments.studies.plan import State
from tests.experiments.studies.by_hand import NO_RATES, SMALL
from tests.experiments.tiny import ROOT, rows

KILLS = int(os.environ.get("KILLS", "20"))
WORDS = ("small", "--preset=smoke", "--import=tests.experiments.studies.small_paper")

# Forks planners that have everything imported, and kills them or one of their workers, which are processes.
LAUNCHER = """
import json, os, pathlib, random, signal, sys, time
from experiments import paper

out, kills, words = pathlib.Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
draw = random.Random(0)

def planner():
    pid = os.fork()
    if pid == 0:
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1), os.dup2(silence, 2)
        os._exit(paper.main([*words, f"--out={out}"]))
    return pid

def workers():
    found = []
    for path in out.glob("runs/*/.lock"):
        try:
            found.append(int(path.read_text().split()[1]))
        except (OSError, IndexError, ValueError):
            pass
    return found

pid, ends, killed = planner(), [], {"planner": 0, "worker": 0}
while sum(killed.values()) < kills:
    # A worker takes its time to start, and there must be one to be killed.
    victim, done = "worker" if draw.random() < 0.6 else "planner", 0
    while not done and victim == "worker" and not workers():
        time.sleep(0.1)
        done, status = os.waitpid(pid, os.WNOHANG)
    time.sleep(draw.uniform(0.1, 1.5 if victim == "worker" else 5.0))
    if not done:
        done, status = os.waitpid(pid, os.WNOHANG)
    if done:
        ends.append(os.waitstatus_to_exitcode(status))
        break
    running = workers()
    if running and victim == "worker":
        try:
            os.kill(draw.choice(running), signal.SIGKILL)
            killed["worker"] += 1
        except ProcessLookupError:
            pass
    elif victim == "planner":
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        killed["planner"] += 1
        pid = planner()
else:
    _, status = os.waitpid(pid, 0)
    ends.append(os.waitstatus_to_exitcode(status))
print(json.dumps(killed), ends)
sys.exit(ends[-1])
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forked processes")
def test_twenty_kills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(figures_of_paper, "figures", lambda: {"small": SMALL})
    out, whole = tmp_path / "out", tmp_path / "whole"
    killing = [sys.executable, "-c", LAUNCHER, str(out), str(KILLS), *WORDS]
    done = subprocess.run(killing, cwd=ROOT, capture_output=True, text=True, timeout=3_000)
    assert done.returncode == 0, done.stdout + done.stderr
    print(done.stdout)
    killed = json.loads(done.stdout[done.stdout.index("{") : done.stdout.index("}") + 1])
    assert sum(killed.values()) == KILLS, f"the plan was finished after {killed}"
    assert KILLS < 20 or min(killed.values()) >= 5, killed
    command = [sys.executable, "-m", "experiments.paper", *WORDS, f"--out={whole}"]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, timeout=3_000).returncode == 0
    assert told(out) == told(whole)
    for job in plan.make([SMALL], "smoke", whole).jobs.values():
        assert rows(out / plan.RUNS / job.name) == rows(whole / plan.RUNS / job.name)
    assert len(list((out / plan.RUNS).iterdir())) == len(list((whole / plan.RUNS).iterdir()))
    assert (out / "report.md").is_file()


def told(out: Path) -> list:
    """What a report says, times aside."""
    made = plan.make([SMALL], "smoke", out)
    standings = plan.look_all(made)
    assert {one.state for one in standings.values()} == {State.FINISHED}
    found = report.make(made, standings, {}, NO_RATES)
    said: list = [found.title, found.notes]
    for section in found.sections:
        said += [section.verdict, section.explanation, section.reasons, section.tables]
        for panel in section.panels:
            assert isinstance(panel, Panel)
            said += [(one.label, one.seeds, one.steps.tolist(), one.values.tolist()) for one in panel.series]
    return said
