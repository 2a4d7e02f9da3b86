"""Runs that are made longer, resumed beside a living process, or resumed over rows that were lost."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import pytest

import envs
from experiments import compare, run
from experiments.runs import lock
from experiments.runs.directory import RunDirectory
from experiments.runs.status import Status
from tests.experiments import tiny
from tests.experiments.tiny import leaves, rows

RANDOM = ("--env=point", "--method=random", *tiny.RUN)


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of uniform actions over 81 steps, with checkpoints at 75 and 81. Not to be written to."""
    out = tmp_path_factory.mktemp("ended") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(envs.FACTORIES, "point", tiny.make_point)
        assert run.main([f"--out={out}", *RANDOM]) == 0
    return out


@pytest.fixture
def out(ended: Path, tmp_path: Path, point: str) -> Path:
    """A copy of it."""
    shutil.copytree(ended, tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.parametrize("steps", [pytest.param(120, marks=pytest.mark.slow), 100])
def test_a_run_made_longer_is_the_run_that_was_as_long_from_the_start(steps: int, out: Path, tell, tmp_path: Path):
    # 81 is not where a longer run's rounds end: it continues from 75
    told = tell(out, "--resume", f"--steps={steps}")
    assert told.status == 0, told.stderr
    assert "Continuing from step 75" in told.stderr
    words = [word for word in RANDOM if not word.startswith("--steps")]
    assert tell(tmp_path / "twin", *words, f"--steps={steps}").status == 0
    assert rows(out) == rows(tmp_path / "twin")
    assert leaves(out, steps) == leaves(tmp_path / "twin", steps)
    directory = RunDirectory(out)
    assert directory.status() is Status.FINISHED and directory.config().steps == steps
    assert directory.walk()[0].shape == (1, steps, 2)


def test_made_longer_and_killed_at_once_it_is_partial_and_goes_on(out: Path, tell):
    directory = RunDirectory(out)
    spec = directory.spec()
    directory.extend(dataclasses.replace(spec, config=dataclasses.replace(spec.config, steps=120)))
    assert directory.status() is Status.PARTIAL
    assert tell(out, "--resume").status == 0
    assert rows(out)[-1]["step"] == 120


def test_a_run_is_not_made_shorter_or_another(out: Path, tell):
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    for words, what in (
        (["--steps=75"], r"steps: 81 -> 75\. Resume with the saved values \(or more steps\)"),
        (["--steps=120", "--seed=1"], r"seed: 0 -> 1; steps: 81 -> 120"),
    ):
        told = tell(out, "--resume", *words)
        assert told.status == 2
        assert re.search(what, told.stderr), told.stderr
    shutil.rmtree(out / "checkpoints/75")
    told = tell(out, "--resume", "--steps=120")
    assert told.status == 2
    assert "cannot be made longer: its checkpoints, of steps 81, are not where a longer run's rounds" in told.stderr
    for path, content in before.items():
        assert "checkpoints/75" in str(path) or path.read_bytes() == content


def test_beside_a_living_process_it_is_told_who_has_it(out: Path, tell, tmp_path: Path):
    (out / "outcome.json").unlink()
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with lock.claimed(out):
        told = tell(out, "--resume")
        assert told.status == 1
        assert "belongs to process" in told.stderr
        with lock.claimed(tmp_path / "new"):
            told = tell(tmp_path / "new", *RANDOM)
            assert told.status == 1
            assert "belongs to process" in told.stderr
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert list((tmp_path / "new").iterdir()) == []


def test_without_out_a_name_that_is_taken_meanwhile_is_passed_over(point: str, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    original = run.prepare

    def late(spec, *, resume):
        # another process starts between our choosing a name and our making the directory
        found = original(spec, resume=resume)
        monkeypatch.setattr(run.place, "choose", taken)
        return found

    choose = run.place.choose

    def taken(*args, **kwargs):
        directory = choose(*args, **kwargs)
        directory.path.mkdir(parents=True)
        return directory

    monkeypatch.setattr(run, "prepare", late)
    assert run.main([*RANDOM]) == 0
    assert sorted(path.name for path in Path("runs").iterdir()) == [
        "point-random-smoke-seed0",
        "point-random-smoke-seed0-2",
    ]
    assert list(Path("runs/point-random-smoke-seed0").iterdir()) == []


SPOILT = {
    "deleted": lambda lines: None,
    "emptied": lambda lines: [],
    "cut": lambda lines: lines[:2],
    "with a hole": lambda lines: lines[:2] + lines[3:],
    "doubled": lambda lines: lines + lines,
}


@pytest.mark.parametrize("how", SPOILT)
def test_rows_that_are_lost_are_noticed(how: str, out: Path, tell, capsys: pytest.CaptureFixture[str]):
    (out / "outcome.json").unlink()
    path = out / "metrics.jsonl"
    lines = SPOILT[how](path.read_text().splitlines(keepends=True))
    path.unlink()
    if lines is not None:
        path.write_text("".join(lines))
    told = tell(out, "--resume")
    assert told.status == 1
    wanted = "more than once" if how == "doubled" else "lacks"
    assert f"{path} {wanted}" in told.stderr.replace("has 5 rows from step 25 to 81 ", ""), told.stderr
    assert "from before its checkpoint of step 81" in told.stderr and "put back a copy of the file" in told.stderr
    assert not path.exists() if lines is None else path.read_text() == "".join(lines)
    if how != "deleted":
        (out / "outcome.json").write_text('{"status": "finished", "diverged": {}}')
        assert compare.main([str(out), f"--out={out / 'comparison'}"]) == 1
        assert wanted in capsys.readouterr().err
        assert not (out / "comparison").exists()


def test_the_older_checkpoint_is_offered_where_the_rows_reach_it(out: Path, tell):
    (out / "outcome.json").unlink()
    path = out / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-1]))
    told = tell(out, "--resume")
    newest = out / "checkpoints/81"
    assert f"or remove {newest} to continue from the one of step 75" in told.stderr
    shutil.rmtree(newest)
    assert tell(out, "--resume").status == 0
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == list(tiny.STEPS)


@pytest.mark.slow
def test_a_longer_run_has_a_larger_replay_with_the_data_that_it_had(point: str, tell, tmp_path: Path):
    # 90 are kept of 81 steps; 120 need room for more, which is what a run of 120 had from the start
    words = [*RANDOM, "--data-capacity=90"]
    assert tell(tmp_path / "run", *words).status == 0
    told = tell(tmp_path / "run", "--resume", "--steps=120", "--data-capacity=100")
    assert told.status == 2
    assert "--data-capacity=100 is less than the run's 120 steps" in told.stderr
    assert tell(tmp_path / "run", "--resume", "--steps=120").status == 0
    longer = [word for word in RANDOM if not word.startswith("--steps")]
    assert tell(tmp_path / "twin", *longer, "--steps=120", "--data-capacity=121").status == 0
    assert RunDirectory(tmp_path / "run").config() == RunDirectory(tmp_path / "twin").config()
    assert leaves(tmp_path / "run", 120) == leaves(tmp_path / "twin", 120)


def test_what_has_lost_its_oldest_data_is_not_made_longer(out: Path, tell):
    # of before this was refused
    path = out / "config.json"
    saved = json.loads(path.read_text())
    saved["explorer"]["data_capacity"] = 50
    del saved["identity"]
    path.write_text(json.dumps(saved))
    told = tell(out, "--resume", "--steps=120")
    assert told.status == 2
    assert "cannot be made longer: of its 81 steps it keeps only the latest 50" in told.stderr
