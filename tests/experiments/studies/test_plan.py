"""Figures as jobs: what is shared, in which order, where it stands, and what it takes."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from experiments.runs import lock
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.spec import to_json
from experiments.studies import figures_of_paper, plan
from experiments.studies.plan import State
from tests.experiments.studies.by_hand import CHILD, VISITS, cell, figure, finish


def test_a_run_that_two_figures_need_is_one_job(tmp_path: Path):
    first = figure("first", (cell("implicit"), cell("max")))
    second = figure("second", (cell("implicit", "ours"), cell("icm")))
    made = plan.make([first, second], "laptop", tmp_path)
    # Three methods, and a process for each of two seeds, as the ant's physics is on the host.
    assert len(made.jobs) == 6
    (shared,) = {made.cells["first", 0, "implicit"], made.cells["second", 0, "ours"]}
    assert [made.jobs[key].figures for key in shared] == [("first", "second")] * 2
    assert [list(made.jobs[key].seeds) for key in shared] == [[0], [1]]
    assert made.jobs[made.cells["second", 0, "icm"][0]].figures == ("second",)


def test_fewer_seeds_of_a_cell_are_among_the_more(tmp_path: Path):
    made = plan.make([figure("a", (cell("max", seeds=3),)), figure("b", (cell("max", seeds=2),))], "laptop", tmp_path)
    assert len(made.jobs) == 3
    assert made.cells["b", 0, "max"] == made.cells["a", 0, "max"][:2]


def test_seeds_of_a_device_environment_share_a_program_and_so_do_those_of_smoke(tmp_path: Path):
    on_device = plan.make([figure("a", (cell("max", env="acrobot"),))], "laptop", tmp_path)
    smoke = plan.make([figure("a", (cell("max"),))], "smoke", tmp_path)
    for made in (on_device, smoke):
        (job,) = made.jobs.values()
        assert job.spec is not None and job.spec.config.num_seeds == 2 and list(job.seeds) == [0, 1]


def test_parents_come_first_and_seed_by_seed(tmp_path: Path):
    made = plan.make([figure("a", (CHILD,)), figure("b", (cell("random"),))], "laptop", tmp_path)
    jobs = list(made.jobs.values())
    names = [job.spec.config.method if job.spec else "" for job in jobs]
    assert names == ["disagreement", "disagreement", "random", "random", "sac", "sac"]
    for parent, child in zip(jobs[:2], jobs[4:], strict=True):
        assert child.parent == parent.key and parent.is_parent and child.seeds == parent.seeds
        assert child.spec is not None and child.spec.parent is not None
        ref = child.spec.parent
        assert (ref.directory, ref.step, ref.identity) == (str(parent.path), 300, parent.key)
    # A child from another step, or of another parent, is another run.
    other = plan.make([figure("a", (CHILD._replace(parent=cell("max", env="half_cheetah_task")),))], "laptop", tmp_path)
    assert not {job.key for job in jobs[4:]} & other.jobs.keys()


def test_a_parent_at_an_earlier_step(tmp_path: Path):
    at = {"laptop": 275}
    made = plan.make([figure("a", (CHILD, CHILD._replace(label="early", parent_at=at)))], "laptop", tmp_path)
    refs = [job.spec.parent.step for job in made.jobs.values() if job.spec and job.spec.parent]
    assert refs == [300, 300, 275, 275]


def test_where_jobs_stand(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit", seeds=4),))], "laptop", tmp_path / "out")
    jobs = list(made.jobs.values())
    finish(jobs[0])
    finish(jobs[1])
    RunDirectory(jobs[1].path).path.joinpath("outcome.json").unlink()
    finish(jobs[2])
    (jobs[2].path / "outcome.json").write_text('{"status": "diverged", "diverged": {}}')
    found = plan.look_all(made)
    assert [one.state for one in found.values()] == [State.FINISHED, State.PARTIAL, State.DIVERGED, State.TO_DO]
    assert [one.step for one in found.values()] == [300, 300, 300, 0]
    assert found[jobs[2].key].reason
    text = plan.describe(made, found, {})
    assert "4 runs, 1 of them finished, 1 partial, 1 diverged" in text
    assert f"{jobs[2].name} diverged" in text


def test_a_finished_run_elsewhere_counts_if_its_identity_is_the_same(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit"),))], "laptop", tmp_path / "out")
    first, second = made.jobs.values()
    other = finish(first, path=tmp_path / "others" / "mine")
    assert second.spec is not None
    changed = dataclasses.replace(second.spec, config=dataclasses.replace(second.spec.config, obs_noise=0.5))
    finish(second._replace(spec=changed), path=tmp_path / "others" / "nearly")
    found = plan.look_all(made, [tmp_path / "others", tmp_path / "nowhere"])
    assert found[first.key].path == other and found[first.key].state is State.FINISHED
    assert found[second.key].state is State.TO_DO


@pytest.mark.parametrize("walks", [True, False])
def test_what_was_only_kept_stands_in_for_no_parent_and_no_walk_that_it_lacks(walks: bool, tmp_path: Path):
    figures = [figure("a", (CHILD,)), figure("b", (cell("max"),)), figure("c", (cell("implicit"),), VISITS)]
    made = plan.make(figures, "laptop", tmp_path / "out")
    for job in made.jobs.values():
        RunDirectory(finish(job, path=tmp_path / "whole" / job.name)).keep(tmp_path / "kept")
        if not walks:
            (tmp_path / "kept" / job.name / "walk.npz").unlink()
    shutil.rmtree(tmp_path / "whole")
    found = plan.look_all(made, [tmp_path / "kept"])
    finished = {made.jobs[key].spec.config.method for key, one in found.items() if one.state is State.FINISHED}  # pyright: ignore
    assert finished == ({"sac", "max", "implicit"} if walks else {"sac", "max"})


def test_another_run_in_its_place_is_refused(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit", seeds=1),))], "laptop", tmp_path)
    (job,) = made.jobs.values()
    assert job.spec is not None
    other = dataclasses.replace(job.spec, config=dataclasses.replace(job.spec.config, obs_noise=0.5))
    finish(job._replace(spec=other), path=job.path)
    with pytest.raises(RunError, match="holds a run of other settings"):
        plan.look_all(made)


def test_a_half_written_testbed_is_to_be_done(tmp_path: Path):
    one = figure("a", ())._replace(testbeds=(figures_of_paper.Testbed("max", "max"),))
    made = plan.make([one], "smoke", tmp_path)
    (job,) = made.jobs.values()
    job.path.parent.mkdir()
    job.path.write_text('{"stored": [')
    assert plan.look(job).state is State.TO_DO
    job.path.write_text('{"stored": []}')
    assert plan.look(job).state is State.FINISHED


def test_the_command_starts_a_run_or_goes_on(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit", seeds=1),))], "laptop", tmp_path)
    (job,) = made.jobs.values()
    plan.write_settings(made, plan.look_all(made))
    assert job.spec is not None
    assert plan.settings_of(job).read_text() == to_json(job.spec)
    assert plan.command(job)[2:] == [f"--out={job.path}", "--processes=1", f"--config={plan.settings_of(job)}"]
    # What a run that was killed at its start has left goes away; what is none of ours stays.
    job.path.mkdir()
    (job.path / "versions.json").write_text("{}")
    assert plan.command(job)[-1].startswith("--config=") and not list(job.path.iterdir())
    (job.path / "thesis.tex").write_text("")
    with pytest.raises(RunError, match="holds other files"):
        plan.command(job)
    (job.path / "thesis.tex").unlink()
    finish(job)
    assert plan.command(job)[-1] == "--resume"
    with lock.claimed(job.path):
        assert not plan.is_free(job)
    assert plan.is_free(job)


def test_a_child_is_told_where_its_parent_was_found(tmp_path: Path):
    made = plan.make([figure("a", (CHILD,))], "laptop", tmp_path / "out")
    parent, _, child, _ = made.jobs.values()
    place = finish(parent, path=tmp_path / "others" / "mine")
    plan.write_settings(made, plan.look_all(made, [tmp_path / "others"]))
    assert json.loads(plan.settings_of(child).read_text())["parent"]["directory"] == str(place)


def test_the_directory_is_of_one_preset_and_holds_nothing_else(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit"),))], "laptop", tmp_path / "out")
    plan.check_out(tmp_path / "out", "laptop")
    plan.write_settings(made, plan.look_all(made))
    plan.check_out(tmp_path / "out", "laptop")
    with pytest.raises(RunError, match=r"preset=laptop\. Allowed: --preset=laptop"):
        plan.check_out(tmp_path / "out", "smoke")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("")
    with pytest.raises(RunError, match=r"holds other files \(thesis.tex\)"):
        plan.check_out(tmp_path / "thesis", "laptop")


def test_a_plan_larger_than_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = plan.make([figure("a", (cell("implicit"),))], "laptop", tmp_path / "out")
    found = plan.look_all(made)
    plan.check_disk(made, found)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(plan.shutil, "disk_usage", lambda path: usage._replace(free=2**20))
    with pytest.raises(ValueError, match=r"2 runs need 0\.\d GiB of disk at the most, and there are 0\.0 GiB"):
        plan.check_disk(made, found)
    for job in made.jobs.values():
        finish(job)
    plan.check_disk(made, plan.look_all(made))  # nothing left to do


def test_the_time_is_that_of_runs_of_before(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit"), cell("max")))], "laptop", tmp_path / "out")
    jobs = list(made.jobs.values())
    finish(jobs[0])
    known = plan.rates([jobs[0].path, tmp_path / "nothing"])
    assert known == {("ant_maze", "implicit", "laptop"): pytest.approx(0.01)}
    found = plan.look_all(made)
    assert [plan.seconds_left(job, found[job.key], known) for job in jobs] == [0.0, pytest.approx(3.0), None, None]
    text = plan.describe(made, found, known, 2)
    assert "left: 3 s of computing, 2 at a time: 2 s; 2 runs of a kind that has not been run here" in text
    assert "no run to tell from" in text
    assert "left: 3 runs of a kind that has not been run here" in plan.describe(made, found, {})


def test_the_state_of_the_papers_networks_is_traced(tmp_path: Path):
    small, large = (plan.make([figure("a", (cell("random"),))], name, tmp_path) for name in ("laptop", "paper"))
    sizes = [plan.size(next(iter(made.jobs.values()))) for made in (small, large)]
    # 10,001 transitions of 31 + 8 + 1 + 31 + 2 numbers are 2.9 MB, and random actions keep nothing else.
    state = (sizes[1].memory - plan.PROCESS) / plan.PER_STATE
    assert 2.7e6 < state < 4e6
    assert sizes[0].memory > sizes[1].memory
