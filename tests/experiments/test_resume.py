"""Killed at any moment, a run resumes and ends as one that was never killed, to the bit."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import envs
from envs import stepper
from experiments import run
from experiments.runs import schedule
from experiments.runs.checkpoint import Checkpoints
from experiments.runs.directory import RunDirectory
from experiments.runs.metrics import MetricsLog
from experiments.runs.tensorboard import TensorBoardLog
from experiments.training import build
from tests.experiments import tiny
from tests.experiments.tiny import ROOT, STEPS, TINY, assert_same_run, rows

POINT = ("--env=point", *TINY)

# The command line with the point in it, and a hook: `{where}` is called as usual `{times}` times, and then kills.
KILLED = """
import os, sys, envs
from experiments import run
from experiments.runs import checkpoint, metrics
from tests.experiments.tiny import make_point

envs.FACTORIES["point"] = make_point
original, calls = {where}, 0

def kill(*args, **kwargs):
    global calls
    calls += 1
    if calls > {times}:
        os._exit(9)
    return original(*args, **kwargs)

{where} = kill
sys.exit(run.main(sys.argv[1:]))
"""


def start(code: str, out: Path, *words: str) -> subprocess.Popen[str]:
    """A process that computes to the bit what this one does."""
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": "2", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    command = [sys.executable, "-c", code, f"--out={out}", *words]
    return subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)


def killed(out: Path, where: str, times: int, *words: str) -> None:
    process = start(KILLED.format(where=where, times=times), out, *words)
    stderr = process.communicate(timeout=280)[1]
    assert process.returncode == 9, stderr


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the point that nothing disturbs. Not to be written to."""
    out = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(envs.FACTORIES, "point", tiny.make_point)
        assert run.main([f"--out={out}", *POINT]) == 0
    return out


def test_killed_between_checkpoints(tell, point: str, whole: Path, tmp_path: Path):
    """Before a row is written, in another process than the one that resumes."""
    out = tmp_path / "run"
    killed(out, "metrics.MetricsLog.append", 3, *POINT)
    assert Checkpoints(out / "checkpoints").steps() == [25, 50]
    assert len(rows(out)) == 3
    assert not (out / "walk.npz").exists()
    told = tell(out, "--resume")
    assert told.status == 0
    assert "Continuing from step 50" in told.stderr
    assert_same_run(whole, out)


@pytest.mark.slow
def test_killed_over_and_over(tell, point: str, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """In this process, at each of the moments at which a round touches the disk, time and again."""

    class Killed(BaseException):
        pass

    out = tmp_path / "run"
    moments = [
        (RunDirectory, "begin", True),
        (MetricsLog, "append", True),
        (Checkpoints, "save", False),
        (Checkpoints, "save", True),
        (TensorBoardLog, "append", True),
        (RunDirectory, "write_walk", False),
        (RunDirectory, "write_outcome", False),
    ]
    for place, name, after in moments:
        original = getattr(place, name)

        def kill(*args, original=original, after=after):
            if after:
                original(*args)
            raise Killed

        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(place, name, kill)
            run.main([f"--out={out}", *(["--resume"] if out.exists() else []), *POINT])
    assert tell(out, "--resume").status == 0
    assert_same_run(whole, out)


@pytest.mark.slow
def test_killed_before_the_first_checkpoint_a_run_starts_over(tell, point: str, whole: Path, tmp_path: Path):
    out = tmp_path / "run"
    killed(out, "checkpoint.sync", 0, *POINT)
    assert Checkpoints(out / "checkpoints").steps() == []
    assert len(rows(out)) == 1
    told = tell(out, "--resume")
    assert told.status == 0
    assert "There is no checkpoint yet: starting over" in told.stderr
    assert_same_run(whole, out)


@pytest.mark.slow
def test_kill_9_while_saving_the_ant(tell, finished, tmp_path: Path):
    """A real kill, of the real command, in the middle of a save."""
    out = tmp_path / "run"
    process = start(KILLED.format(where="checkpoint.sync", times=10**9), out, "--env=ant_maze", *TINY)
    saving = out / "checkpoints" / "saving-50"
    deadline = time.monotonic() + 280
    while not saving.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert Checkpoints(out / "checkpoints").steps() in ([25], [25, 50])
    told = tell(out, "--resume")
    assert told.status == 0
    assert "Continuing from step " in told.stderr
    assert_same_run(finished.out, out)
    assert sorted(path.name for path in (out / "checkpoints").iterdir()) == ["75", "81"]


@pytest.mark.slow
def test_a_damaged_checkpoint_falls_back_and_ends_the_same(
    tell, point: str, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    out = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(RunDirectory, "write_walk", lambda *_: 1 / 0)
        run.main([f"--out={out}", *POINT])
    (out / "checkpoints" / "81" / "manifest.json").write_text("")
    told = tell(out, "--resume")
    assert told.status == 0
    assert "the checkpoint of step 81 is damaged" in told.stderr
    assert "Continuing from step 75" in told.stderr
    assert_same_run(whole, out)


@pytest.mark.slow
def test_mjx_resumes_to_the_bit(tell, tmp_path: Path):
    ant = ("--env=ant_maze", "--backend=mjx", *TINY)
    whole = tell(tmp_path / "whole", *ant)
    assert whole.status == 0
    out = tmp_path / "run"
    killed(out, "metrics.MetricsLog.append", 3, *ant)
    assert tell(out, "--resume").status == 0
    assert_same_run(whole.out, out)


@pytest.mark.parametrize("env", [pytest.param("ant_maze", marks=pytest.mark.slow), "point"])
def test_each_program_is_traced_once(
    env: str, tell, point: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finished
):
    """Over rounds of 25, 6, 19, 25 and 6 steps, before and after the warm-up, and after a resume."""
    traces = {"improve": 0, "act": 0, "collect": 0, "init": 0}

    def counted(name, function):
        def call(*args):
            traces[name] += 1
            return function(*args)

        return call

    make_explorer, make_collect, make_collect_all = build.make_explorer, stepper.make_collect, stepper.make_collect_all

    def make_counted_explorer(*args):
        explorer = make_explorer(*args)
        names = ("improve", "act", "init")
        return explorer._replace(**{name: counted(name, getattr(explorer, name)) for name in names})

    monkeypatch.setattr(build, "make_explorer", make_counted_explorer)
    monkeypatch.setattr(stepper, "make_collect", lambda *args: counted("collect", make_collect(*args)))
    monkeypatch.setattr(stepper, "make_collect_all", lambda *args: counted("collect", make_collect_all(*args)))
    out = tmp_path / "run"
    assert tell(out, f"--env={env}", *TINY).status == 0
    assert traces["improve"] == 1
    assert traces["init"] == 1
    if env == "point":
        assert traces["collect"] == 1
        assert traces["act"] == 2, "for the shapes and for the loop, in one trace of the program"
    else:
        assert traces["collect"] == len(STEPS), "a loop on the host"
        assert traces["act"] == 1


def test_rounds_start_where_they_would_have():
    config = run.parse(["--preset=smoke", "--steps=601"])[1].config
    whole = list(schedule.rounds(config, 0))
    assert whole[0] == (0, 25)
    assert (250, 256) in whole
    assert (256, 275) in whole
    assert whole[-1] == (600, 601)
    assert [first for first, _ in whole[1:]] == [end for _, end in whole[:-1]]
    for start_again in (end for _, end in whole):
        assert list(schedule.rounds(config, start_again)) == [step for step in whole if step[0] >= start_again]
    assert list(schedule.rounds(config, 601)) == []


def test_the_point_is_what_it_is_said_to_be():
    env = tiny.make_point()
    assert env.compiled
    assert env.coverage.num_cells == 3
