"""One owner of a run's directory at a time, and none after it has ended."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.runs import lock
from experiments.runs.errors import RunError
from tests.experiments.tiny import ROOT

HOLDER = """
import pathlib, sys, time
from experiments.runs import lock
with lock.claimed(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_second_is_told_who_has_it_and_a_kill_lets_go(tmp_path: Path):
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        expected = rf"{tmp_path} belongs to process {holder.pid} on .*, since 2.*another --out"
        with pytest.raises(RunError, match=expected), lock.claimed(tmp_path):
            pass
        holder.send_signal(signal.SIGKILL)
    assert (tmp_path / lock.NAME).exists(), "nobody was there to remove it"
    with lock.claimed(tmp_path):
        assert (tmp_path / lock.NAME).read_text().startswith(f"process {os.getpid()} on ")
    assert list(tmp_path.iterdir()) == []


def test_within_one_process_too_and_an_error_lets_go(tmp_path: Path):
    with pytest.raises(KeyError), lock.claimed(tmp_path / "a/run"):
        with pytest.raises(RunError, match="belongs to process"), lock.claimed(tmp_path / "a/run"):
            pass
        raise KeyError
    with lock.claimed(tmp_path / "a/run"):
        pass


def test_a_new_directory_is_made_by_one_alone(tmp_path: Path):
    run = tmp_path / "run"
    with lock.claimed(run, new=True), pytest.raises(FileExistsError), lock.claimed(run, new=True):
        pass


def test_a_lock_that_its_holder_removes_meanwhile_is_not_taken_for_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # between our opening and our locking it, the holder ends and a third process makes a file of its own
    attempt, calls = lock._try, []

    def late(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) == 1:
            (tmp_path / lock.NAME).unlink()
            (tmp_path / lock.NAME).write_text("another")
        attempt(descriptor)

    monkeypatch.setattr(lock, "_try", late)
    with lock.claimed(tmp_path):
        assert len(calls) == 2
        assert (tmp_path / lock.NAME).read_text().startswith("process ")


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    expected = "cannot start the run in .*a file stands where a directory is needed"
    with pytest.raises(RunError, match=expected), lock.claimed(tmp_path / "file"):
        pass
