"""Workers that are killed: the run resumes elsewhere, and comes out as one that nobody touched."""

import os
import shutil
import signal
import sys
import time
import types
from pathlib import Path

import pytest

from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.status import Status
from experiments.studies import conduct, execute, executors, plan
from experiments.studies.figures_of_paper import Cell
from jaxplore.validate import FieldError
from tests.experiments.studies import by_hand
from tests.experiments.tiny import rows

MEMORY = 2**30
STEPS = dict.fromkeys(("smoke", "laptop", "paper"), 1_000)
SETTINGS = {"checkpoint_every": 25, "explorer": {"warm_up_steps": 50}}
CELL = Cell("random", "acrobot", "random", 1, STEPS, SETTINGS)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(execute, "POLL", 0.05)


def holder(run: Path) -> int | None:
    """The process that owns a run's directory."""
    try:
        return int((run / ".lock").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return None


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def carry_out(tmp_path: Path, executor: conduct.Executor, kill) -> dict[str, int]:
    """Carry out one run, during which `kill(pid of the run)` is called once it has taken 100 steps."""
    made = plan.make([by_hand.figure("a", (CELL,))], "smoke", tmp_path)
    (job,) = made.jobs.values()
    standings = plan.look_all(made)
    plan.write_settings(made, standings)
    killed, started = [], []

    def start(one):
        started.append(time.monotonic())
        return executor.start(one)

    def tell(now, working, failed, waiting):
        pid = holder(job.path)
        if not killed and pid is not None and now[job.key].step >= 100:
            killed.append(now[job.key].step)
            kill(pid)

    outcome = conduct.carry_out(made, standings, executor._replace(start=start), tell)
    assert not outcome.failed
    assert killed and len(started) == 2
    assert RunDirectory(job.path).status() is Status.FINISHED
    # Nothing is lost, and no round comes twice.
    found = [row["step"] for row in rows(job.path) if row["seed"] == 0]
    assert found == sorted(set(found)) and found[-1] == 1_000 and len(found) == 1_000 // 25
    return {"killed at": killed[0]}


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)


@pytest.mark.slow
def test_a_local_process(tmp_path: Path):
    carry_out(tmp_path, executors.local(1, {}), kill)


def test_one_that_cannot_start_says_why(tmp_path: Path):
    made = plan.make([by_hand.figure("a", (CELL,))], "smoke", tmp_path)
    (job,) = made.jobs.values()
    plan.write_settings(made, plan.look_all(made))
    plan.settings_of(job).write_text("{")
    outcome = conduct.carry_out(made, plan.look_all(made), executors.local(1, {}), lambda *_: None)
    assert "is not JSON" in outcome.failed[job.key]


def test_as_many_at_a_time_as_cores_and_memory_allow(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(executors.machine, "cores", lambda: 8)
    monkeypatch.setattr(executors.machine, "free_memory", lambda: 7 * 2**30)
    made = {
        on_cpu: executors.make("local", tmp_path, 2 * 2**30, variables={}, on_cpu=on_cpu) for on_cpu in (True, False)
    }
    assert made[True].at_a_time == 3 and made[False].at_a_time == 1
    assert executors.make("local", tmp_path, 2**40, variables={}, on_cpu=True).at_a_time == 1
    with pytest.raises(FieldError, match="Did you mean 'ray'"):
        executors.make("rai", tmp_path, 1, variables={}, on_cpu=True)


def test_a_worker_waits_for_a_run_that_another_one_owns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = plan.make([by_hand.figure("a", (CELL,))], "smoke", tmp_path)
    (job,) = made.jobs.values()
    free = iter([False, False, True])
    asked = []
    monkeypatch.setattr(plan, "is_free", lambda one: asked.append(one) or next(free))
    monkeypatch.setattr(plan, "command", lambda one: ["-c", "print('error: as told'); raise SystemExit(1)"])
    plan.log_of(job).parent.mkdir(parents=True)
    assert executors.work(executors.Work(job, {})) == execute.End(1, "as told")
    assert len(asked) == 3


@pytest.mark.slow
def test_a_submitit_job(tmp_path: Path):
    pytest.importorskip("submitit")
    # The local cluster's watcher starts again what ends by SIGTERM; SIGKILL is what it cannot see.
    executor = executors.slurm(tmp_path / "workers", MEMORY, {}, cluster="local")
    carry_out(tmp_path / "out", executor, lambda pid: (kill(parent_of(pid)), None)[1])


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("sbatch") is None, reason="there is no Slurm")
def test_a_slurm_job(tmp_path: Path):
    """Where this machine is itself a node, and `sacct` works."""
    pytest.importorskip("submitit")
    executor = executors.slurm(tmp_path / "workers", MEMORY, {})
    carry_out(tmp_path / "out", executor, lambda pid: kill(parent_of(pid)))


@pytest.mark.slow
def test_a_ray_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    ray = pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    executor = executors.ray(MEMORY, {})
    try:
        carry_out(tmp_path, executor, lambda pid: kill(parent_of(pid)))
    finally:
        ray.shutdown()


def test_a_cluster_out_of_reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RunError, match=r"--executor=slurm: .*What to do: start it where sbatch works"):
        executors.slurm(tmp_path / "workers", MEMORY, {})


class FakeSubmitit(types.ModuleType):
    """As much of submitit as there is without a cluster: `sbatch` refuses, and nothing answers."""

    class AutoExecutor:
        def __init__(self, folder: str, cluster: str) -> None: ...

        def update_parameters(self, **parameters) -> None: ...

        def submit(self, *task):
            raise RuntimeError("sbatch: error: Batch job submission failed: Invalid account\nmore of it")


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for the commands of a Slurm that there is not."""
    monkeypatch.setitem(sys.modules, "submitit", FakeSubmitit("submitit"))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    (tmp_path / "bin").mkdir()
    return tmp_path / "bin"


def command(folder: Path, name: str, script: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{script}\n")
    (folder / name).chmod(0o755)


def test_a_controller_that_does_not_answer(cluster: Path, tmp_path: Path):
    with pytest.raises(RunError, match=r"--executor=slurm: .*sinfo.*\. What to do: start it where sbatch works"):
        executors.slurm(tmp_path / "workers", MEMORY, {})
    command(cluster, "sinfo", "echo 'slurm_load_partitions: Unable to contact slurm controller' >&2; exit 1")
    with pytest.raises(RunError, match=r"slurm: slurm_load_partitions: Unable to contact slurm controller\. What"):
        executors.slurm(tmp_path / "workers", MEMORY, {})
    assert not (tmp_path / "workers").exists()


def test_what_sbatch_refuses_is_a_line_of_the_run(cluster: Path, tmp_path: Path):
    command(cluster, "sinfo", "exit 0")
    executor = executors.slurm(tmp_path / "workers", MEMORY, {})
    made = plan.make([by_hand.figure("a", (CELL,))], "smoke", tmp_path / "out")
    outcome = conduct.carry_out(made, plan.look_all(made), executor, lambda *_: None)
    assert list(outcome.failed.values()) == [
        "Slurm has not taken it: sbatch: error: Batch job submission failed: Invalid account"
    ]


def test_a_ray_cluster_out_of_reach(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(RunError, match=r"--executor=ray: no cluster at RAY_ADDRESS=127.0.0.1:1"):
        executors.ray(MEMORY, {})
