"""Command lines as processes: stopped while they start, terminated, with nobody who reads, without their packages."""

import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest

from experiments import runtime
from tests.experiments.tiny import ROOT

RUN = [sys.executable, "-m", "experiments.run", "--env=acrobot", "--method=random", "--preset=smoke"]


def start(command: list[str], **options) -> subprocess.Popen[str]:
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def test_ctrl_c_while_modules_are_imported_is_a_line():
    with start(RUN) as process:
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=60)
    assert (stdout, stderr) == ("", "\nStopped.\n")
    assert process.returncode in (-signal.SIGINT, 130)


def test_ctrl_c_in_an_import_that_catches_everything_is_heeded():
    caught = "try: os.kill(os.getpid(), signal.SIGINT); time.sleep(5)\nexcept BaseException: print('caught')"
    program = f"import os, signal, time\nfrom experiments import process\nprocess.be_brief()\n{caught}"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr, done.returncode) == ("", "\nStopped.\n", 130)


def test_sigterm_says_how_to_go_on(tmp_path: Path):
    out = tmp_path / "run"
    with start([*RUN, "--steps=1000000", f"--out={out}"]) as process:
        deadline = time.monotonic() + 120
        while not (out / "metrics.jsonl").exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 143, stderr
    assert f"Stopped. To continue from the latest checkpoint: python -m experiments.run --out={out} --resume" in stderr
    assert "Traceback" not in stderr


@pytest.mark.slow
def test_a_closed_console_does_not_end_a_run(tmp_path: Path):
    # as when a terminal is closed: both streams broken, and SIGHUP
    out = tmp_path / "run"
    with start([*RUN, f"--out={out}"]) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        process.stderr.close()
        while not (out / "config.json").exists() and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(signal.SIGHUP)
        assert process.wait(timeout=120) == 0
    assert (out / "outcome.json").exists() and (out / "coverage.png").exists()


@pytest.mark.parametrize("package", ["tyro", "matplotlib"])
def test_a_package_that_is_missing_is_named(package: str, tmp_path: Path):
    (tmp_path / f"{package}.py").write_text("raise ImportError('no such package')")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(RUN, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ") and package in done.stderr and "pip install" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_what_a_run_needs_when_it_ends_does_not_keep_it_from_starting():
    heavy = "('matplotlib.figure', 'scipy.stats', 'scipy.special', 'tensorflow_probability')"
    program = f"import sys, experiments.run; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_compiled_programs_are_kept_where_nobody_else_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    chosen = {}
    config = types.SimpleNamespace(values={"jax_compilation_cache_dir": None}, update=chosen.__setitem__)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(runtime, "jax", types.SimpleNamespace(config=config))
    runtime.use_compilation_cache()
    directory = tmp_path / "jaxplore" / "jax"
    assert chosen.pop("jax_compilation_cache_dir") == str(directory)
    assert directory.stat().st_mode & 0o777 == 0o700
    directory.chmod(0o777)
    runtime.use_compilation_cache()
    assert "jax_compilation_cache_dir" not in chosen
    assert capsys.readouterr().err.startswith(f"{directory} can be written to by others")
