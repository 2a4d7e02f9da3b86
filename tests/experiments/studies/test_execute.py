"""Processes of which each is held by the one that started it; here they are small scripts."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.studies import execute
from experiments.studies.execute import End, Job, run_all
from tests.experiments.tiny import ROOT

# As a command of ours is: told to stop by a signal, or by the pipe that its parent holds.
SLEEPER = """
import pathlib, sys, time
from experiments import process

def main():
    pathlib.Path(sys.argv[1]).write_text(str(__import__("os").getpid()))
    time.sleep(60)
    return 0

process.carry_out(main)
"""


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(execute, "POLL", 0.02)


def jobs(folder: Path, *scripts: str) -> list[Job]:
    return [Job(i, ["-c", script], folder / f"{i}.log") for i, script in enumerate(scripts)]


def lives(pid: int) -> bool:
    # One that has ended and that nobody has waited for is a zombie on Linux: it has no command line.
    try:
        return bool(Path(f"/proc/{pid}/cmdline").read_bytes())
    except FileNotFoundError:
        return False


def wait_until(true, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_so_many_at_a_time_and_how_each_ended(tmp_path: Path):
    most, told = [], []

    def tell(running, ended):
        most.append(len(running))
        told.append(dict(ended))

    (tmp_path / "1.log").write_text("error: of before\n")
    ended = run_all(
        jobs(
            tmp_path,
            "print('well')",
            "print('error: the disk is full'); print('later'); raise SystemExit(1)",
            "import os; os.kill(os.getpid(), 9)",
            "print('what?'); raise SystemExit(7)",
            "import os; print(os.environ['HOW']); raise SystemExit(130)",
        ),
        2,
        tell,
        {"HOW": "so"},
    )
    assert max(most) == 2 and most[-1] == 0
    assert told[-1] == ended
    assert {key: end.status for key, end in ended.items()} == {0: 0, 1: 1, 2: -9, 3: 7, 4: 130}
    assert ended[0] == End(0, None)
    assert ended[1].error == "the disk is full"
    # `run`, whose seeds these are, has a flag for that; a paper's plan has none.
    killed = "it was ended by SIGKILL, perhaps because memory was short"
    assert ended[2].error == f"{killed}: give fewer --processes"
    one = execute.start(Job(0, ["-c", "import os; os.kill(os.getpid(), 9)"], tmp_path / "paper.log"), {})
    one.popen.wait()
    assert execute.end(one).error == killed
    assert ended[3].error == "exit status 7 after: what?"
    assert ended[4].error == "it was stopped"
    assert (tmp_path / "4.log").read_text() == "so\n"


def test_it_imports_what_this_process_can(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "mine.py").write_text("print('mine')")
    monkeypatch.syspath_prepend(tmp_path)
    script = "import os, mine, experiments; print(os.environ['PYTHONPATH'])"
    ended = run_all(jobs(tmp_path, script), 1, lambda *_: None)
    assert ended[0] == End(0, None)
    said, path = (tmp_path / "0.log").read_text().splitlines()
    assert said == "mine"
    # which another Python that it starts could not bear
    assert "site-packages" not in path and os.path.dirname(os.__file__) not in path.split(os.pathsep)


def test_a_log_of_before_is_kept_and_not_read(tmp_path: Path):
    (tmp_path / "0.log").write_text("error: of before\n")
    ended = run_all(jobs(tmp_path, "raise SystemExit(1)"), 1, lambda *_: None)
    assert ended[0].error == "exit status 1"
    assert (tmp_path / "0.log").read_text() == "error: of before\n"


def test_what_interrupts_it_stops_them_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pids = [tmp_path / "a", tmp_path / "b"]
    both = [Job(i, ["-c", SLEEPER, str(path)], tmp_path / f"{i}.log") for i, path in enumerate(pids)]

    def tell(*_):
        if all(path.exists() and path.read_text() for path in pids):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_all(both, 2, tell)
    assert not any(lives(int(path.read_text())) for path in pids)
    assert "Stopping 2 processes" in capsys.readouterr().err
    assert "Traceback" not in (tmp_path / "0.log").read_text()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks for processes in /proc")
def test_one_whose_parent_is_killed_stops(tmp_path: Path):
    pid = tmp_path / "pid"
    code = f"""
import pathlib, sys
from experiments.studies.execute import Job, run_all
run_all([Job(0, ["-c", {SLEEPER!r}, {str(pid)!r}], pathlib.Path({str(tmp_path / "log")!r}))], 1, lambda *_: None)
"""
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT) as parent:
        wait_until(lambda: pid.exists() and pid.read_text())
        child = int(pid.read_text())
        assert lives(child)
        os.kill(child, 2)  # Ctrl-C reaches all of a terminal's processes; this one leaves it to its parent.
        time.sleep(0.1)
        assert lives(child)
        parent.kill()
    wait_until(lambda: not lives(child))
    assert "Stopped." in (tmp_path / "log").read_text()
