"""What a plan takes: memory, disk, and time by runs of before."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from experiments.studies import estimates, plan
from experiments.studies.found import setting_of
from experiments.studies.seeds import PER_STATE, PROCESS
from tests.experiments.studies.by_hand import NO_RATES, cell, figure, finish, write


def test_a_plan_larger_than_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = plan.make([figure("a", (cell("implicit"),))], "laptop", tmp_path / "out")
    found = plan.look_all(made)
    estimates.check_disk(made, found)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(estimates.shutil, "disk_usage", lambda path: usage._replace(free=2**20))
    with pytest.raises(ValueError, match=r"2 runs need 0\.\d GiB of disk at the most, and there are 0\.0 GiB"):
        estimates.check_disk(made, found)
    for job in made.jobs.values():
        finish(job)
    estimates.check_disk(made, plan.look_all(made))  # nothing left to do


def test_the_time_is_that_of_runs_of_before(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit", seeds=3), cell("max")))], "laptop", tmp_path / "out")
    jobs = list(made.jobs.values())
    finish(jobs[0])
    known = estimates.rates([jobs[0].path, tmp_path / "nothing"])
    assert known.kinds == {("ant_maze", "implicit", "laptop"): pytest.approx(0.01)}
    found = plan.look_all(made)
    left = [estimates.seconds_left(job, found[job.key], known) for job in jobs]
    assert left == [0.0, pytest.approx(3.0), pytest.approx(3.0), None, None]
    text = estimates.describe(made, found, known, 5)
    # No run is shorter than itself.
    assert "left: at least 6 s of computing, 4 at a time: 3 s; 2 runs of a kind that has not been run here" in text
    assert "no run to tell from" in text
    assert "left: 4 runs of a kind that has not been run here" in estimates.describe(made, found, NO_RATES)


def test_runs_of_the_same_settings_tell_before_others_of_their_kind(tmp_path: Path):
    (job,) = plan.make([figure("a", (cell("implicit", seeds=1),))], "laptop", tmp_path / "out").jobs.values()
    assert job.spec is not None
    slow = dataclasses.replace(job.spec.config, seed=7, obs_noise=0.5)
    paths = [write(dataclasses.replace(job.spec, config=slow), tmp_path / "slow", pace=0.05)]
    assert estimates.rates(paths).of(job.spec) == pytest.approx(0.05)
    alike = dataclasses.replace(job.spec, config=dataclasses.replace(job.spec.config, seed=5))
    paths.append(write(alike, tmp_path / "alike", pace=0.02))
    known = estimates.rates(paths)
    assert known.of(job.spec) == pytest.approx(0.02) and len(known.settings) == 2
    assert setting_of(alike) == setting_of(job.spec)


def test_the_state_of_the_papers_networks_is_traced(tmp_path: Path):
    small, large = (plan.make([figure("a", (cell("random"),))], name, tmp_path) for name in ("laptop", "paper"))
    sizes = [estimates.size(next(iter(made.jobs.values()))) for made in (small, large)]
    # 10,001 transitions of 31 + 8 + 1 + 31 + 2 numbers are 2.9 MB, and random actions keep nothing else.
    state = (sizes[1].memory - PROCESS) / PER_STATE
    assert 2.7e6 < state < 4e6
    assert sizes[0].memory > sizes[1].memory
