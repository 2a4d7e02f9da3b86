"""Seeds of which each has a process and a directory of its own."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import envs
from experiments import calibrate, compare, export, machine, run
from experiments.analysis import report
from experiments.runs.directory import RunDirectory
from experiments.runs.metrics import last_row
from experiments.runs.seeds import SeedRuns
from experiments.runs.status import Status
from experiments.studies import seeds
from experiments.studies.execute import End
from experiments.training import build
from jaxplore import load_policy
from tests.experiments import tiny
from tests.experiments.tiny import ROOT, STEPS, TINY, assert_same_run, rows

# Rounds that end at 25, 30, 50 and 60; checkpoints at 25, 50 and 60.
RANDOM = (
    *("--env=point", "--method=random", "--preset=smoke"),
    *("--steps=60", "--warm-up-steps=30", "--checkpoint-every=20"),
)
SPLIT = ("--num-seeds=3", "--processes=2")


class Here(list):
    """The seeds that were run in this process; in place of those in `fails` its functions were called."""

    def __init__(self) -> None:
        self.fails: dict[int, Callable[[], End]] = {}
        self.variables: dict[str, str] = {}

    def run_all(self, jobs, at_a_time, tell, variables) -> dict[int, End]:
        ended, self.variables = {}, variables
        for job in jobs:
            tell([job.key], ended)
            assert job.words[:2] == ["-m", "experiments.run"]
            self.append(job.key)
            if job.key in self.fails:
                ended[job.key] = self.fails[job.key]()
            else:
                status = run.main(job.words[2:])
                ended[job.key] = End(status, None if status == 0 else "what its log says")
            tell([], ended)
        return ended


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Here:
    """Has what would be processes run in this one, one after the other, without a run's own pictures."""
    ran = Here()
    monkeypatch.setattr(seeds, "run_all", ran.run_all)
    monkeypatch.setattr(report, "write", lambda directory: "")
    return ran


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# As processes.


def start(out: Path, *words: str) -> subprocess.Popen[str]:
    """A command that computes to the bit what this process does."""
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": "2", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    command = [sys.executable, "-m", "experiments.run", f"--out={out}", *words]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.slow
def test_the_command_spreads_seeds_of_an_environment_on_the_host(finished, tmp_path: Path):
    # unasked; and each ends as the run of its seed alone, to the bit
    out = tmp_path / "run"
    with start(out, "--env=ant_maze", "--num-seeds=2", *TINY) as process:
        stdout, stderr = process.communicate(timeout=280)
    assert process.returncode == 0, stderr
    assert_same_run(finished.out, out / "seed-0")
    for name in ("config.json", "scene.json", "versions.json"):
        assert (out / "seed-0" / name).read_bytes() == (finished.out / name).read_bytes()
    assert [row["seed"] for row in rows(out / "seed-1")] == [1] * len(STEPS)
    assert "seeds 0 to 1" in stdout and "a process for each seed" in stdout
    assert re.search(r"^ +1 +[1-7] +\d+ +81 +", stdout, re.M)
    assert re.search(r"^ *range  ", stdout, re.M) and "| `implicit` | 2 |" in stdout
    assert re.search(r"^100% \| 162/162  .*seed [01] at 81, cells \d/7", stderr, re.M)
    assert {"Seed 0 is done", "Seed 1 is done"} <= {line.partition(":")[0] for line in stderr.splitlines()}
    assert {path.name for path in out.iterdir()} == {
        *("seeds.json", "seed-0", "seed-1", "seed-0.log", "seed-1.log"),
        *("coverage.png", "variance.png", "comparison.json"),
    }


@pytest.mark.slow
def test_stopped_and_killed_they_resume_and_end_the_same(tell, tmp_path: Path):
    """Ctrl-C, SIGTERM and a kill of the command, and a kill of one of its processes."""
    out, words = tmp_path / "a run", ["--env=gymnasium:Pendulum-v1", "--method=random", "--preset=smoke"]
    words += ["--steps=6000", "--checkpoint-every=50", "--num-seeds=3"]

    def reached() -> list[int]:
        found = [last_row(out / f"seed-{seed}" / "metrics.jsonl") for seed in (0, 1)]
        return [row["step"] if row else 0 for row in found]

    def wait(process: subprocess.Popen[str]) -> None:
        """Until both seeds have gone on."""
        before, deadline = reached(), time.monotonic() + 120
        while any(now <= then for now, then in zip(reached(), before, strict=True)) and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def children() -> list[int]:
        found = subprocess.run(["pgrep", "-f", "--", f"--out={out}/seed-"], capture_output=True, text=True).stdout
        return [int(pid) for pid in found.split()]

    for number, status in ((signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)):
        with start(out, "--processes=2", *(["--resume"] if out.exists() else words)) as process:
            wait(process)
            process.send_signal(number)
            _, stderr = process.communicate(timeout=60)
        assert process.returncode == status
        assert "Traceback" not in stderr
        if number != signal.SIGKILL:
            assert f"experiments.run --out='{out}' --resume" in stderr
            assert children() == []
    with start(out, "--processes=2", "--resume") as process:  # which waits until the children of before have stopped
        wait(process)
        os.kill(children()[0], signal.SIGKILL)
        stdout, stderr = process.communicate(timeout=280)
    assert process.returncode == 1
    assert "was ended by SIGKILL, perhaps because memory was short" in stderr
    assert "1 of 3 seeds are not in the tables" in stderr and "| `random` | 2 |" in stdout
    with start(out, "--resume") as process:
        assert process.wait(280) == 0
    alone = tell(tmp_path / "alone", *words[:-1], "--seed=1")
    assert_same_run(alone.out, out / "seed-1", 6000)


def test_a_process_for_each_seed(tmp_path: Path):
    out = tmp_path / "run"
    words = ["--env=gymnasium:Pendulum-v1", "--method=random", "--preset=smoke", "--steps=300", "--eval-every=300"]
    with start(out, *words, "--num-seeds=2", "--processes=2") as process:
        stdout, stderr = process.communicate(timeout=280)
    assert process.returncode == 0, stderr
    assert "seeds 0 to 1" in stdout and "a process for each seed, 2 at a time" in stdout
    assert "| `random` | 2 |" in stdout
    for seed in (0, 1):
        assert f"Seed {seed} is done: cells" in stderr
        assert (
            f"random on gymnasium:Pendulum-v1: smoke preset, seed {seed}, 300 steps"
            in SeedRuns(out).log(seed).read_text()
        )
        assert rows(out / f"seed-{seed}")[-1]["seed"] == seed and "eval/return" in rows(out / f"seed-{seed}")[-1]


# Where each seed goes.


@pytest.mark.parametrize(
    ("words", "is_command", "split"),
    [
        (("--env=ant_maze", "--num-seeds=2"), True, True),
        (("--env=ant_maze", "--num-seeds=2"), False, False),
        (("--env=ant_maze", "--num-seeds=2", "--processes=1"), True, False),
        (("--env=ant_maze", "--num-seeds=2", "--processes=2"), False, True),
        (("--env=ant_maze", "--num-seeds=1", "--processes=2"), True, False),
        (("--env=ant_maze",), True, False),
        (("--env=ant_maze", "--num-seeds=2", "--backend=mjx"), True, False),
        (("--env=point", "--num-seeds=2"), True, False),
        (("--env=point", "--num-seeds=2", "--processes=2"), True, True),
    ],
)
def test_what_is_spread(words: tuple[str, ...], is_command: bool, split: bool, point: str):
    command, spec = run.parse(words)
    env = build.make_env(spec.config)
    assert seeds.are_split(command, spec, env, is_command=is_command) is split


@pytest.mark.parametrize(
    ("words", "cores", "gigabytes", "processes"),
    [
        ((), 8, 64, 5),
        ((), 4, 64, 4),
        ((), 8, 4, 2),  # 1.5 GiB each
        ((), 8, 1, 1),
        (("--processes=3",), 1, 1, 3),
        (("--processes=9",), 1, 1, 5),
    ],
)
def test_as_many_as_cores_and_memory_allow(
    words: tuple[str, ...],
    cores: int,
    gigabytes: int,
    processes: int,
    point: str,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(machine, "cores", lambda: cores)
    monkeypatch.setattr(machine, "free_memory", lambda: gigabytes * 2**30)
    command, spec = run.parse([*RANDOM, "--num-seeds=5", "--seed=7", *words])
    env, agent, spec = run.prepare(spec, resume=False)
    found = seeds.plan(command, spec, env, agent)
    assert found.processes == processes
    assert [(one.config.seed, one.config.num_seeds) for one in found.new] == [(seed, 1) for seed in range(7, 12)]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("-1", "--processes=-1 is out of range. Allowed: a whole number, 1 or more, or 0 for as many as cores"),
        ("two", "--processes='two' is not a number. Allowed: a whole number."),
    ],
)
def test_a_bad_number_is_refused_and_nothing_is_written(value: str, message: str, tell, point: str, tmp_path: Path):
    told = tell(tmp_path / "run", *RANDOM, "--num-seeds=2", f"--processes={value}")
    assert told.status == 2
    (line,) = told.stderr.splitlines()
    assert line.startswith(f"error: {message}")
    assert list(tmp_path.iterdir()) == []


def test_without_out_they_make_a_place_of_their_own(here, point: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    here.fails = {seed: lambda: End(1, "not now") for seed in (4, 5, 6)}
    assert run.main([*RANDOM, *SPLIT, "--seed=4"]) == 1
    assert here == [4, 5, 6]
    assert here.variables == {"WANDB_RUN_GROUP": "point-random-smoke-seeds4-6"}
    assert SeedRuns("runs/point-random-smoke-seeds4-6").seeds() == range(4, 7)


# Resumed.


@pytest.mark.slow
def test_what_is_finished_is_kept_and_the_rest_goes_on(here, tell, point: str, tmp_path: Path):
    out = tmp_path / "run"
    here.fails = {1: lambda: End(-9, "killed"), 2: lambda: End(1, "the disk is full")}
    told = tell(out, *RANDOM, *SPLIT)
    assert told.status == 1
    assert "Seed 1 failed after step 0: killed" in told.stderr
    assert "error: 2 of 3 seeds are not in the tables: seed 1 stands at step 0" in told.stderr
    assert told.stderr.endswith(f"experiments.run --out={out} --resume\n")
    assert "| `random` | 1 |" in told.stdout
    before, here.fails = files(out / "seed-0"), {}
    here.clear()
    again = tell(out, "--resume")
    assert again.status == 0
    assert here == [1, 2]
    assert files(out / "seed-0") == before
    assert "| `random` | 3 |" in again.stdout
    assert tell(tmp_path / "alone", *RANDOM, "--seed=2").status == 0
    assert_same_run(tmp_path / "alone", out / "seed-2", 60)
    assert (tmp_path / "alone/config.json").read_bytes() == (out / "seed-2/config.json").read_bytes()
    here.clear()
    assert "nothing left to do: drawing them again" in tell(out, "--resume").stdout
    assert here == []


@pytest.mark.slow
def test_more_steps_and_more_seeds(here, tell, point: str, tmp_path: Path):
    out = tmp_path / "run"
    assert tell(out, *RANDOM, "--num-seeds=2", "--processes=2").status == 0
    here.clear()
    assert tell(out, "--resume", "--steps=85", "--num-seeds=3").status == 0
    assert here == [0, 1, 2]
    assert [rows(out / f"seed-{seed}")[-1]["step"] for seed in here] == [85, 85, 85]
    told = tell(out, "--resume", "--num-seeds=2", "--sac.lr=0.5", "--method=implicit")
    assert told.status == 2
    assert "in method: 'random' -> 'implicit'; num_seeds: 3 -> 2; sac.lr" in told.stderr
    assert "Resume with the saved values (or more steps or seeds)" in told.stderr


def test_seeds_that_share_a_directory_go_on_sharing_it(here, tell, point: str, tmp_path: Path):
    out = tmp_path / "run"
    assert tell(out, *RANDOM, "--num-seeds=2").status == 0
    told = tell(out, "--resume", "--processes=2", "--steps=85")
    assert told.status == 2
    assert f"error: --processes=2 cannot be: the seeds in {out} share a program and a directory" in told.stderr
    command, spec = run.parse([f"--out={out}", "--resume", "--steps=85"])
    assert not seeds.are_split(command, spec, build.make_env(spec.config), is_command=True)
    assert tell(out, "--resume", "--steps=85").status == 0
    assert here == [] and not SeedRuns(out).exists()
    assert f"--out={out} holds another run" in tell(out, *RANDOM, *SPLIT).stderr


@pytest.mark.slow
def test_a_seed_that_diverged_is_told_of_and_not_run_again(here, tell, point: str, tmp_path: Path):
    out = tmp_path / "run"

    def diverge() -> End:
        told = tell(out / "seed-1", "--resume")
        assert told.status == 0
        path = out / "seed-1" / "metrics.jsonl"
        first, second, third, _ = path.read_text().splitlines(keepends=True)
        path.write_text(first + second + json.dumps({**json.loads(third), "diverged": "fit/loss"}) + "\n")
        RunDirectory(out / "seed-1").write_outcome(Status.DIVERGED, {1: {"step": 50, "what": "fit/loss"}})
        return End(1, "numbers that are not finite")

    here.fails = {1: diverge}
    told = tell(out, *RANDOM, *SPLIT)
    assert told.status == 1
    assert "Seed 1 failed after step 50: numbers that are not finite" in told.stderr
    expected = "error: 1 of 3 seeds are not in the tables: seed 1 diverged at step 50 (not finite: fit/loss)."
    assert expected in told.stderr and "--resume" not in told.stderr
    here.clear()
    again = tell(out, "--resume")
    assert (again.status, list(here)) == (1, [])
    assert expected in again.stderr and "| `random` | 2 |" in again.stdout


# What else reads them.


def test_other_commands_read_them(
    here, tell, point: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    out, asked = tmp_path / "run", []
    assert tell(out, *RANDOM, "--num-seeds=2", "--processes=2").status == 0
    capsys.readouterr()
    assert compare.main([f"mine={out}", f"--out={tmp_path / 'compared'}"]) == 0
    assert "| `mine` | 2 |" in capsys.readouterr().out
    assert export.main([str(out)]) == 0
    assert capsys.readouterr().out.count("\n") == 1 + 2 * 4
    monkeypatch.setattr(calibrate, "write", lambda path, until: asked.append(path) or "asked")
    assert calibrate.main([str(out)]) == 0
    assert asked == [out / "seed-0", out / "seed-1"]
    assert (load_policy(out).origin.seed, load_policy(out, seed=1).origin.seed) == (0, 1)
    with pytest.raises(ValueError, match=r"seed=5 is none of the run's\. Allowed: the run's seeds, 0, 1"):
        load_policy(out, seed=5)


@pytest.mark.slow
def test_each_seed_continues_the_parent_with_its_place(here, tell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def make_task(backend: str = "auto", obs_noise: float = 0.0):
        return tiny.make_point(backend, obs_noise, has_reward=True)

    monkeypatch.setitem(envs.FACTORIES, "point", make_task)
    words = ["--env=point", "--method=sac", *tiny.tiny_flags("sac")]
    parents = tmp_path / "parents"
    assert tell(parents, *words, "--num-seeds=2", "--processes=2").status == 0
    out = tmp_path / "run"
    assert tell(out, *words, "--seed=5", *SPLIT, f"--parent={parents}@75").status == 0
    found = [RunDirectory(out / f"seed-{seed}").spec().parent for seed in (5, 6, 7)]
    assert [(ref.directory, ref.step) for ref in found if ref] == [(str(parents / f"seed-{i}"), 75) for i in (0, 1, 0)]
    alone = tell(tmp_path / "alone", *words, "--seed=6", f"--parent={parents / 'seed-1'}@75")
    assert alone.status == 0
    assert_same_run(alone.out, out / "seed-6")
    here.clear()
    assert tell(out, "--resume").status == 0 and here == []
    told = tell(tmp_path / "no", *words, f"--parent={parents}")
    assert told.status == 2
    assert f"--parent={parents} holds a run for each of several seeds. Allowed: one of them, such as" in told.stderr
    shared = tmp_path / "shared"
    assert tell(shared, *words, "--num-seeds=2").status == 0
    told = tell(tmp_path / "no", *words, *SPLIT, f"--parent={shared}")
    assert told.status == 2
    assert f"--processes=2 cannot be: seeds that share a program in --parent={shared}" in told.stderr
    assert not (tmp_path / "no").exists()
