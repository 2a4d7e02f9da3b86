"""The call that measures a GPU, where there is none: its parts, its time, and what it writes."""

import json
import re
import sys
from pathlib import Path

import pytest

from benchmarks import budget, gpu, gpu_stages, whole_run
from benchmarks.budget import Ended
from benchmarks.result import Result
from experiments.runs.presets import preset_config
from experiments.runs.schedule import rounds

PAPER = preset_config("paper")
RESULT = Result("SVGD step", "32 x 512-512-512-512, batch 256", 0.02, 0.03, 1.5, 1e9, 0.01).to_dict()


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def test_what_a_part_leaves_goes_to_those_after_it():
    assert budget.limit(100.0, [1, 4]) == 20.0
    assert budget.limit(99.0, [4]) == 99.0
    assert budget.limit(-3.0, [1, 4]) == 0.0


def test_a_command_that_ends_well_or_crashes(tmp_path: Path):
    assert budget.carry_out(python("print('a'); print('b')"), 60, tmp_path / "log")[::3] == ("done", "a\nb")
    ended = budget.carry_out(python("print('a'); raise SystemExit(3)"), 60, tmp_path / "log")
    assert (ended.status, ended.code, ended.tail) == ("failed", 3, "a")
    missing = budget.carry_out([str(tmp_path / "none")], 60, tmp_path / "log")
    assert (missing.status, missing.code) == ("failed", None)
    assert "none" in missing.tail


def test_a_command_that_hangs_is_ended_with_what_it_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # it starts another, and both are deaf to SIGTERM
    monkeypatch.setattr(budget, "GRACE", 0.5)
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(60)"
    both = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {deaf!r}]); {deaf}"
    ended = budget.carry_out(python(both), 2.5, tmp_path / "log")
    assert (ended.status, ended.code, ended.tail) == ("out of time", -9, "up\nup")
    assert 2.0 <= ended.seconds < 10.0


def make_rows(config, until, beside, per_step, compiling=60.0, checkpoint=0.0):
    """Rows of a run whose rounds take `beside` seconds and `per_step` for each gradient step."""
    rows, clock = [], 0.0
    for _, end in rounds(config, 0):
        if end > until:
            break
        if end < config.explorer.warm_up_steps:
            clock += 0.5
        else:
            clock += beside + per_step * 50 * (end // 256) + compiling
            compiling = 0.0
        rows.append({"step": end, "seed": config.seed, "wall_time": clock})
        if end % 100 == 0:
            clock += checkpoint
    return rows


def test_a_whole_run_follows_from_its_beginning():
    # a gradient step is 0.01 s: the measured rounds hold one fit length or two, the whole run 39
    whole = make_rows(PAPER, PAPER.steps, 4.0, 0.01, compiling=0.0)[-1]["wall_time"]
    rows = make_rows(PAPER, 600, 4.0, 0.01, checkpoint=3.0)
    found = whole_run.extrapolate(PAPER, rows, seconds_per_fit_step=0.01)
    assert found["extrapolated"] is True
    # the saves of checkpoints during the random steps, and no others
    assert found["seconds"] == pytest.approx(whole, abs=10.0)
    assert found["seconds_beside_the_fit"] == pytest.approx(4.0)
    # 256 (which compiles), 275, 300, ... 600
    assert (found["rounds"], found["rounds_measured"], found["last_step_measured"]) == (401, 14, 600)
    assert found["seconds_per_fit_step_from"] == "measured alone"
    # or by the slope of rounds that differ enough; not of those that do not
    longer = make_rows(PAPER, 1500, 4.0, 0.01)
    assert whole_run.extrapolate(PAPER, longer)["seconds_per_fit_step"] == pytest.approx(0.01)
    bound = whole_run.extrapolate(PAPER, make_rows(PAPER, 600, 4.0, 0.01))
    assert "lower bound" in bound["seconds_per_fit_step_from"]
    assert bound["seconds"] < whole


def test_a_run_that_has_ended_is_not_extrapolated_and_one_without_rounds_not_at_all():
    rows = make_rows(PAPER, PAPER.steps, 4.0, 0.01)
    whole = whole_run.extrapolate(PAPER, rows, 0.01)
    assert whole == {"extrapolated": False, "seconds": rows[-1]["wall_time"], "rounds": 401}
    # the one round that learned waited for the compiler
    assert whole_run.extrapolate(PAPER, make_rows(PAPER, 256, 4.0, 0.01), 0.01) is None
    assert whole_run.extrapolate(PAPER, [], 0.01) is None


@pytest.mark.parametrize("preset", ["paper", "laptop"])
@pytest.mark.parametrize("num_data", [20, 256, 511, 5000])
def test_gradient_steps_are_those_of_the_fit(preset, num_data):
    config = preset_config(preset)
    assert whole_run.fit_steps(config, num_data) == int(config.explorer.fit.num_steps(num_data))


def test_commands_run_from_a_checkout_with_few_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    known = gpu.commands(False, tmp_path, tmp_path / "run")
    assert set(known) == set(gpu.SHARES)
    assert known["run"][1:4] == ["-m", "experiments.run", f"--out={tmp_path / 'run'}"]
    assert {"--preset=paper", "--env=ant_maze"} < set(known["run"])
    marked = {path for path in known["tests"] if path.endswith(".py")}
    assert {str(gpu.ROOT / f"tests/{name}") for name in ("envs/test_ant_maze.py", "jaxplore/test_on_gpu.py")} < marked
    # a second call continues the run
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("{}")
    assert gpu.commands(False, tmp_path, tmp_path / "run")["run"][-1] == "--resume"
    monkeypatch.setattr(gpu, "_installed", lambda *names: "tyro" not in names)
    few = gpu.commands(False, tmp_path, tmp_path / "run")
    assert few["run"][1:4] == ["-m", "benchmarks.gpu_stages", "run"]
    left_out = marked - set(few["tests"])
    assert left_out == {str(gpu.ROOT / "tests/experiments/test_on_gpu.py")}
    monkeypatch.setattr(gpu, "_installed", lambda *names: False)
    assert gpu.commands(False, tmp_path, tmp_path / "run")["tests"] == "pytest is not installed"


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Parts are not carried out: `pretended(platform, **statuses)` says what becomes of them."""
    monkeypatch.setattr(gpu.jax.config, "update", lambda *_: None)
    seen: dict[str, list[str]] = {}

    def pretend(platform: str, **statuses: str):
        def carry_out(command, seconds, log, folder=None):
            name = log.stem
            seen[name] = command
            assert 0 < seconds < gpu.BUDGET
            if name == "driver":
                return Ended("failed", 0.0, None, "not there")
            lines = {
                "hardware": [
                    {"platform": platform, "device": "Made Up 9000", "num_devices": 1, "versions": {}},
                    {"matmul_precision": "default", "flops_per_second": 4e14},
                ],
                "kernels": [RESULT],
                "environments": [{**RESULT, "kernel": "ant_maze, MJX", "shape": "16 in parallel", "per_second": 9e5}],
            }
            if name in lines:
                text = "".join(json.dumps(line) + "\n" for line in lines[name])
                Path(command[4]).write_text(text + '{"kernel": "cut o')  # killed while it wrote
            if name == "run":
                out = Path(next(word for word in command if word.startswith("--out="))[6:])
                out.mkdir(parents=True)
                rows = make_rows(PAPER, 400, 4.0, 0.02)
                (out / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
            tail = "1 failed, 4 passed, 2 skipped in 3.1s" if name == "tests" else "Killed"
            status = statuses.get(name, "done")
            return Ended(status, 12.5, 0 if status == "done" else -9, tail)

        monkeypatch.setattr(budget, "carry_out", carry_out)
        words = [f"--out={tmp_path / 'gpu.json'}", f"--run={tmp_path / 'run'}"]
        return gpu.main(words), seen

    return pretend


def test_a_part_that_fails_costs_no_other(pretended, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    status, seen = pretended("gpu", tests="failed", kernels="out of time", run="out of time")
    assert status == 1
    assert list(seen) == ["hardware", "driver", "tests", "kernels", "environments", "run"]
    report = json.loads((tmp_path / "gpu.json").read_text())
    assert {"format", "reduced", "budget_seconds", "seconds", "machine", "stages", "whole_run"} == report.keys()
    assert (report["format"], report["reduced"]) == (1, False)
    assert report["machine"]["device"] == "Made Up 9000"
    assert report["machine"]["driver"] is None
    stages = report["stages"]
    assert {name: stage["status"] for name, stage in stages.items()} == {
        "hardware": "done",
        "tests": "failed",
        "kernels": "out of time",
        "environments": "done",
        "run": "out of time",
    }
    assert stages["tests"]["results"] == {"failed": 1, "passed": 4, "skipped": 2}
    assert (stages["tests"]["exit_status"], "printed" in stages["environments"]) == (-9, False)
    assert stages["kernels"]["results"] == [RESULT]
    assert stages["run"]["results"][-1]["step"] == 400
    # by the gradient step that the kernels measured, though not all of those were
    assert (report["whole_run"]["extrapolated"], report["whole_run"]["seconds_per_fit_step"]) == (True, 0.02)
    told = capsys.readouterr().out
    assert "Made Up 9000 x 1, float32 matrix product: 400 TFLOP/s (default)" in told
    assert re.search(r"ant_maze, MJX +16 in parallel .* 900,000 ", told)
    assert re.search(r"The whole run of 401 rounds: \d+ h \d+ min \(EXTRAPOLATED from 6 rounds", told)


def test_without_a_gpu_it_says_so_in_a_line(pretended, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    status, seen = pretended("cpu")
    (line,) = capsys.readouterr().err.splitlines()
    assert status == 2
    assert line.startswith("error: no GPU: JAX computes on 'Made Up 9000'. --allow-cpu ")
    assert list(seen) == ["hardware"]
    assert not (tmp_path / "gpu.json").exists()


def test_a_budget_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        gpu.main(["--budget=5"])
    assert "--budget=5. Allowed: 50 seconds or more." in capsys.readouterr().err


def test_hardware_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(gpu_stages, "matmul_rate", lambda: 1e9)
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    machine, *rates = gpu_stages.hardware(small=True)
    assert machine["platform"] == "cpu"
    assert machine["variables"]["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"
    assert {"jax", "jaxlib", "mujoco-mjx", "python"} <= machine["versions"].keys()
    assert [rate["matmul_precision"] for rate in rates] == ["default", "highest"]
    json.dumps(machine)


def test_a_run_without_the_command_line_goes_on_where_it_was(tmp_path: Path):
    # without what is not installed on every machine, in a process of its own; it is cut short after two rounds
    code = """
import dataclasses, sys
sys.modules.update(dict.fromkeys(["tyro", "matplotlib", "scipy", "tqdm", "tensorboardX", "imageio", "pytest"]))
from benchmarks import gpu_stages
from experiments.runs.presets import preset_config
from experiments.training import loop
config = dataclasses.replace(preset_config("smoke", "acrobot", "random"), steps=100, checkpoint_every=25)
whole = loop.rounds
loop.rounds = lambda *args: list(whole(*args))[:2]
gpu_stages.carry_out_run(config, sys.argv[1])
loop.rounds = whole
gpu_stages.carry_out_run(config, sys.argv[1])
"""
    ended = budget.carry_out([*python(code), str(tmp_path / "run")], 120, tmp_path / "log", gpu.ROOT)
    assert ended.status == "done", ended.tail
    steps = [row["step"] for row in gpu.read_run(tmp_path / "run", PAPER)]
    assert steps == [25, 50, 75, 100]
