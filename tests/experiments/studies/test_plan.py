"""Figures as jobs: what is shared, in which order, where it stands, and what it takes."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from experiments.runs import lock
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.spec import RunSpec, to_json
from experiments.studies import estimates, figures_of_paper, plan
from experiments.studies.plan import State
from tests.experiments.studies.by_hand import CHILD, NO_RATES, RETURN, SHORT, VISITS, cell, figure, finish, write


def test_a_run_that_two_figures_need_is_one_job(tmp_path: Path):
    first = figure("first", (cell("implicit"), cell("max")))
    second = figure("second", (cell("implicit", "ours"), cell("icm")))
    made = plan.make([first, second], "laptop", tmp_path)
    # Three methods, and a process for each of two seeds, as the ant's physics is on the host.
    assert len(made.jobs) == 6
    (shared,) = {made.cells["first", 0, "implicit"], made.cells["second", 0, "ours"]}
    assert [made.jobs[key].figures for key in shared.keys] == [("first", "second")] * 2
    assert [made.jobs[key].seeds for key in shared.keys] == [(0,), (1,)] and shared.seeds == (0, 1)
    assert made.jobs[made.cells["second", 0, "icm"].keys[0]].figures == ("second",)


def test_fewer_seeds_of_a_cell_are_among_the_more(tmp_path: Path):
    made = plan.make([figure("a", (cell("max", seeds=3),)), figure("b", (cell("max", seeds=2),))], "laptop", tmp_path)
    assert len(made.jobs) == 3
    assert made.cells["b", 0, "max"].keys == made.cells["a", 0, "max"].keys[:2]
    assert [job.figures for job in made.jobs.values()] == [("a", "b"), ("a", "b"), ("a",)]
    # Where they share a program, the run of the more has those of the fewer.
    more, fewer = figure("a", (cell("max", env="acrobot", seeds=3),)), figure("b", (cell("max", env="acrobot"),))
    together = plan.make([more, fewer], "laptop", tmp_path)
    (job,) = together.jobs.values()
    assert job.seeds == (0, 1, 2) and together.cells["b", 0, "max"] == plan.Taken((job.key,), (0, 1))


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
        assert child.parent == parent.key and child.seeds == parent.seeds
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
    text = estimates.describe(made, found, NO_RATES)
    assert "4 runs, 1 of them finished, 1 partial, 1 diverged" in text and "| 0 to 3 |" in text
    assert f"{jobs[2].name} diverged" in text


def standings(made: plan.Plan) -> dict[tuple[int, ...], State]:
    return {made.jobs[key].seeds: one.state for key, one in plan.look_all(made).items()}


def spec_of(job: plan.Job, first: int, count: int = 1, **changes) -> RunSpec:
    """The specification of a job's run with other seeds."""
    assert job.spec is not None
    config = dataclasses.replace(job.spec.config, seed=first, num_seeds=count, **changes)
    return dataclasses.replace(job.spec, config=config)


def test_a_finished_run_elsewhere_counts_if_its_settings_are_the_same(tmp_path: Path):
    one = figure("a", (cell("implicit"),))
    first, second = plan.make([one], "laptop", tmp_path / "out").jobs.values()
    other = finish(first, path=tmp_path / "others" / "mine")
    write(spec_of(second, 1, obs_noise=0.5), tmp_path / "others" / "nearly")
    # When it is saved and looked at, and what its method does not read, decides nothing.
    assert second.spec is not None
    made = plan.make([one], "laptop", tmp_path / "out", [tmp_path / "others", tmp_path / "nowhere"])
    assert [job.path for job in made.jobs.values()] == [other, second.path]
    assert standings(made) == {(0,): State.FINISHED, (1,): State.TO_DO}
    write(spec_of(second, 1, checkpoint_every=7, preset="smoke"), tmp_path / "others" / "alike")
    made = plan.make([one], "laptop", tmp_path / "out", [tmp_path / "others"])
    assert standings(made) == {(0,): State.FINISHED, (1,): State.FINISHED}


def test_seeds_are_done_whatever_others_they_ran_beside(tmp_path: Path):
    one, places = figure("a", (cell("max", env="acrobot", seeds=10),)), [tmp_path / "kept"]
    (job,) = plan.make([one], "laptop", tmp_path / "out").jobs.values()
    write(spec_of(job, 0, 3), places[0] / "first")
    write(spec_of(job, 5, 2), places[0] / "second")
    made = plan.make([one], "laptop", tmp_path / "out", places)
    found = {(0, 1, 2): State.FINISHED, (3, 4): State.TO_DO, (5, 6): State.FINISHED, (7, 8, 9): State.TO_DO}
    assert standings(made) == found
    assert len(made.cells["a", 0, "max"].keys) == 4
    # One that diverged there is run again; others of its run are not.
    (places[0] / "first" / "outcome.json").write_text(
        '{"status": "finished", "diverged": {"1": {"step": 50, "what": "fit/loss"}}}'
    )
    made = plan.make([one], "laptop", tmp_path / "out", places)
    assert {(0, 2): State.FINISHED, (1,): State.TO_DO}.items() <= standings(made).items()
    write(spec_of(job, 0, 10), places[0] / "zero")
    assert State.TO_DO not in standings(plan.make([one], "laptop", tmp_path / "out", places)).values()


def test_where_the_first_seed_draws_the_environment_it_must_be_the_same(tmp_path: Path):
    one, places = figure("a", (cell("max", env="nchain", seeds=3),)), [tmp_path / "kept"]
    (job,) = plan.make([one], "laptop", tmp_path / "out").jobs.values()
    write(spec_of(job, 1, 2), places[0] / "later")
    write(spec_of(job, 0, 2), places[0] / "first")
    made = plan.make([one], "laptop", tmp_path / "out", places)
    assert standings(made) == {(0, 1): State.FINISHED, (2,): State.TO_DO}
    (left,) = plan.open_jobs(made, plan.look_all(made))
    assert left.spec is not None and (left.spec.config.seed, left.spec.config.num_seeds) == (0, 3)


def test_what_has_begun_in_the_plans_own_directory_goes_on_as_it_is(tmp_path: Path):
    few, many = (figure("a", (cell("max", env="acrobot", seeds=count),)) for count in (2, 4))
    (job,) = plan.make([few], "laptop", tmp_path).jobs.values()
    finish(job)
    (job.path / "outcome.json").unlink()
    (job.path / "walk.npz").unlink()
    made = plan.make([many], "laptop", tmp_path)
    assert standings(made) == {(0, 1): State.PARTIAL, (2, 3): State.TO_DO}
    finish(job)
    # A seed that diverged in a run that survived is not run again.
    (job.path / "outcome.json").write_text('{"status": "finished", "diverged": {"1": {"step": 50, "what": "q"}}}')
    assert standings(plan.make([many], "laptop", tmp_path)) == {(0, 1): State.FINISHED, (2, 3): State.TO_DO}


@pytest.mark.parametrize("walks", [True, False])
def test_what_was_only_kept_stands_in_for_no_parent_and_no_walk_that_it_lacks(walks: bool, tmp_path: Path):
    figures = [figure("a", (CHILD,)), figure("b", (cell("max"),)), figure("c", (cell("implicit"),), VISITS)]
    made = plan.make(figures, "laptop", tmp_path / "out")
    for job in made.jobs.values():
        RunDirectory(finish(job, path=tmp_path / "whole" / job.name)).keep(tmp_path / "kept")
        if not walks:
            (tmp_path / "kept" / job.name / "walk.npz").unlink()
    shutil.rmtree(tmp_path / "whole")
    kept = [tmp_path / "kept"]
    # Nobody needs a parent whose children are finished.
    again = plan.make(figures, "laptop", tmp_path / "out", kept)
    found = plan.look_all(again)
    methods = [again.jobs[key].spec.config.method for key in found]  # pyright: ignore[reportOptionalMemberAccess]
    assert sorted(methods) == ["implicit", "implicit", "max", "max", "sac", "sac"]
    left = {job.spec.config.method for job in plan.open_jobs(again, found) if job.spec}
    assert left == (set() if walks else {"implicit"})
    # Where a child is not, its own parent is made again.
    (child,) = [job for job in made.jobs.values() if job.name.startswith("half_cheetah_task-sac") and job.seeds == (1,)]
    shutil.rmtree(tmp_path / "kept" / child.name)
    again = plan.make(figures[:1], "laptop", tmp_path / "out", kept)
    left = [(job.spec.config.method, job.seeds) for job in plan.open_jobs(again, plan.look_all(again)) if job.spec]
    assert left == [("disagreement", (1,)), ("sac", (1,))]


def test_a_parent_must_have_the_checkpoint_that_its_child_starts_from(tmp_path: Path):
    one = figure("a", (CHILD._replace(parent_at={"laptop": 275}),))
    made = plan.make([one], "laptop", tmp_path / "out")
    others = [tmp_path / "others"]
    for job in [job for job in made.jobs.values() if job.parent is None]:
        finish(job, path=others[0] / job.name)
        (others[0] / job.name / "checkpoints" / "300").mkdir(parents=True)
    again = plan.make([one], "laptop", tmp_path / "out", others)
    assert len(plan.open_jobs(again, plan.look_all(again))) == 4
    for path in others[0].iterdir():
        (path / "checkpoints" / "275").mkdir()
    again = plan.make([one], "laptop", tmp_path / "out", others)
    left = plan.open_jobs(again, plan.look_all(again))
    assert [job.spec.config.method for job in left if job.spec] == ["sac", "sac"]
    # One of the plan's own cannot be made a second time beside itself.
    for job in [job for job in made.jobs.values() if job.parent is None]:
        finish(job)
    with pytest.raises(RunError, match=r"has no checkpoint of step 275, which a needs\. What to do: move it"):
        plan.make([one], "laptop", tmp_path / "out")


def test_a_child_side_by_side_starts_where_its_parent_does(tmp_path: Path):
    one = figure("a", (CHILD,))
    made = plan.make([one], "laptop", tmp_path / "out")
    parent = next(iter(made.jobs.values()))
    both = write(spec_of(parent, 0, 2), tmp_path / "others" / "both")
    (both / "checkpoints" / "300").mkdir(parents=True)
    again = plan.make([one], "laptop", tmp_path / "out", [tmp_path / "others"])
    (child,) = plan.open_jobs(again, plan.look_all(again))
    assert child.spec is not None and child.spec.parent is not None
    # Alone, seed 1 would take over from the parent's first seed.
    assert child.seeds == (0, 1) and (child.spec.config.seed, child.spec.config.num_seeds) == (0, 2)
    assert child.spec.parent.directory == str(both)
    assert child.spec.parent.identity == RunDirectory(both).spec().identity
    # Finished, it counts, also without its parent; a child of another parent does not.
    finish(child, path=tmp_path / "children" / "mine")
    assert standings(plan.make([one], "laptop", tmp_path / "new", [tmp_path / "children"])) == {(0, 1): State.FINISHED}
    other = figure("a", (CHILD._replace(parent=cell("max", env="half_cheetah_task")),))
    assert len(plan.make([other], "laptop", tmp_path / "new", [tmp_path / "children"]).jobs) == 4


def test_a_run_without_evaluations_has_no_returns(tmp_path: Path):
    task = cell("sac", env="half_cheetah_task", seeds=1, settings={**SHORT, "eval_every": 100})
    one = figure("a", (task,), RETURN)
    (job,) = plan.make([one], "laptop", tmp_path / "out").jobs.values()
    write(spec_of(job, 0, eval_every=0), tmp_path / "others" / "blind")
    made = plan.make([one], "laptop", tmp_path / "out", [tmp_path / "others"])
    assert standings(made) == {(0,): State.TO_DO}
    write(spec_of(job, 0, eval_every=50), tmp_path / "others" / "seeing")
    made = plan.make([one], "laptop", tmp_path / "out", [tmp_path / "others"])
    assert standings(made) == {(0,): State.FINISHED}


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
    (place / "checkpoints" / "300").mkdir(parents=True)
    made = plan.make([figure("a", (CHILD,))], "laptop", tmp_path / "out", [tmp_path / "others"])
    plan.write_settings(made, plan.look_all(made))
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
