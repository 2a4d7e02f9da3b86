"""Weights & Biases: what it is given, with a stand-in, and with itself where it is installed."""

import importlib.util
import os
import subprocess
import sys
import types
from pathlib import Path

import pytest

from experiments.runs.errors import RunError
from experiments.runs.wandb import WandbLog

ROWS = [
    {"step": 25, "seed": 0, "coverage": 0.5, "policy/q": float("nan"), "diverged": "q", "eval/return": None},
    {"step": 25, "seed": 1, "coverage": 0.25, "wall_time": 3},
    {"step": 50, "seed": 0, "coverage": 0.75, "policy/q": 2.0},
]
SEEN = "exploration/coverage"


class Run:
    """Notes what it is told."""

    def __init__(self, **options):
        self.options, self.defined, self.logged, self.finished = options, [], [], False

    def define_metric(self, name, **options):
        self.defined.append((name, options))

    def log(self, values):
        self.logged.append(values)

    def finish(self):
        self.finished = True


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Run]:
    runs: list[Run] = []

    def init(**options):
        runs.append(Run(**options))
        return runs[-1]

    module = types.ModuleType("wandb")
    module.__dict__.update(init=init, Settings=lambda **options: options)
    monkeypatch.setitem(sys.modules, "wandb", module)
    return runs


def test_nothing_happens_unless_it_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    log = WandbLog(tmp_path / "wandb", None)
    log.append(ROWS)
    log.close()
    assert not log.available and list(tmp_path.iterdir()) == []
    with pytest.raises(RunError, match=r'--wandb needs wandb \(.*\)\. What to do: pip install -e "\.\[wandb\]"\.'):
        WandbLog(tmp_path / "wandb", "mine")


def test_numbers_are_grouped_by_step_and_named_as_in_tensorboard(tmp_path: Path, started: list[Run]):
    log = WandbLog(tmp_path / "run" / "wandb", "mine", num_seeds=2, config={"env": "acrobot"})
    log.append(ROWS)
    (run,) = started
    assert run.logged == [
        {"step": 25, f"{SEEN}/seed_0": 0.5, f"{SEEN}/seed_1": 0.25, "time/wall_time/seed_1": 3},
        {"step": 50, f"{SEEN}/seed_0": 0.75, "policy/q/seed_0": 2.0},
    ]
    assert run.defined == [("step", {"hidden": True}), ("*", {"step_metric": "step"})]
    options = {name: run.options[name] for name in ("project", "dir", "name", "resume", "config", "settings")}
    assert options == {
        "project": "mine",
        "dir": tmp_path / "run",
        "name": "run",
        "resume": "allow",
        "config": {"env": "acrobot"},
        "settings": {"console": "off"},
    }
    assert log.available
    log.close()
    log.close()
    assert run.finished and not log.available


def test_a_resumed_run_is_the_same_one_and_a_new_one_another(tmp_path: Path, started: list[Run]):
    for directory, after_step in (("a", None), ("a", 50), ("a", -1), ("b", 50), ("a", None)):
        log = WandbLog(tmp_path / directory / "wandb", "mine", after_step=after_step)
        log.append([{"step": 75, "seed": 0, "coverage": 1.0}])
    first, resumed, over, moved, anew = (run.options["id"] for run in started)
    assert first == resumed == over
    assert len({first, moved, anew}) == 3
    assert started[0].logged == [{"step": 75, SEEN: 1.0}]


def test_what_goes_wrong_is_said_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, started: list[Run]):
    log = WandbLog(tmp_path / "wandb", "mine")
    with pytest.raises(ValueError, match="a row needs step and seed"):
        log.append([{"seed": 0}])

    def fail(*_, **__):
        raise ConnectionError("no route\nto the host")

    monkeypatch.setattr(started[0], "log", fail)
    with pytest.raises(
        RunError, match=r"^Weights & Biases cannot log: ConnectionError: no route\. What to do: set WAN"
    ):
        log.append(ROWS)
    monkeypatch.setattr(sys.modules["wandb"], "init", fail)
    with pytest.raises(RunError, match=r"^Weights & Biases cannot start: ConnectionError: no route\."):
        WandbLog(tmp_path / "wandb", "mine")


SCRIPT = """
import sys
from pathlib import Path
from experiments.runs.wandb import WandbLog
for after_step in (None, 25):
    log = WandbLog(Path(sys.argv[1]) / "wandb", "mine", num_seeds=2, after_step=after_step, config={"env": "acrobot"})
    log.append([{"step": 50, "seed": seed, "coverage": 0.5} for seed in (0, 1)])
    log.close()
"""


@pytest.mark.skipif(importlib.util.find_spec("wandb") is None, reason="needs wandb")
def test_weights_and_biases_itself_takes_it_offline(tmp_path: Path):
    out = tmp_path / "run"
    environment = {**os.environ, "WANDB_MODE": "offline"}
    subprocess.run([sys.executable, "-c", SCRIPT, out], env=environment, check=True, timeout=120)
    own_id = (out / "wandb" / "id").read_text().strip()
    kept = list(out.rglob(f"run-{own_id}.wandb"))
    assert kept and b"exploration/coverage/seed_1" in b"".join(path.read_bytes() for path in kept)
