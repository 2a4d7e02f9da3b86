"""Jobs carried out in order and once each, by an executor that is a list of what happens."""

import itertools
from pathlib import Path

import pytest

from experiments.studies import conduct, execute, plan
from experiments.studies.conduct import Executor
from experiments.studies.execute import End
from experiments.studies.plan import Job, State
from tests.experiments.studies.by_hand import CHILD, cell, figure, finish

KILLED, WRONG = End(-9, "it was ended by SIGKILL"), End(1, "the disk is full")


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(execute, "POLL", 0.0)


class Script:
    """An executor that finishes jobs, but for those that a script gives other ends."""

    def __init__(self, ends: dict[str, list[End]] | None = None, at_a_time: int = 2) -> None:
        self.ends, self.started, self.stopped = ends or {}, list[str](), list[str]()
        self.working, self.most = 0, 0
        self.executor = Executor("script", at_a_time, self.start, self.poll, self.stop)

    def start(self, job: Job) -> Job:
        self.started.append(name_of(job))
        self.working += 1
        self.most = max(self.most, self.working)
        return job

    def poll(self, job: Job) -> End:
        self.working -= 1
        left = self.ends.get(name_of(job), [])
        if left:
            return left.pop(0)
        finish(job)
        return End(0, None)

    def stop(self, jobs) -> None:
        self.stopped += [name_of(job) for job in jobs]


def name_of(job: Job) -> str:
    return job.name.rpartition("-")[0].removeprefix("half_cheetah_task-").removeprefix("ant_maze-")


def carry_out(made: plan.Plan, script: Script, tell=lambda *_: None, again=lambda *_: None) -> conduct.Outcome:
    return conduct.carry_out(made, plan.look_all(made), script.executor, tell, again)


def test_parents_first_so_many_at_a_time_and_what_is_finished_stays(tmp_path: Path):
    made = plan.make([figure("a", (CHILD, cell("random", seeds=3)))], "laptop", tmp_path)
    jobs = list(made.jobs.values())
    finish(jobs[2])
    script = Script()
    outcome = carry_out(made, script)
    assert script.started[:2] == ["disagreement-seed0", "disagreement-seed1"]
    children = ["sac-from-disagreement-seed0", "sac-from-disagreement-seed1"]
    assert sorted(script.started[2:]) == ["random-seed1", "random-seed2", *children]
    assert script.most == 2
    assert {one.state for one in outcome.standings.values()} == {State.FINISHED} and not outcome.failed


def test_one_that_was_killed_is_started_again_and_one_that_failed_is_not(tmp_path: Path):
    made = plan.make([figure("a", (cell("random", seeds=3),))], "laptop", tmp_path)
    script = Script({"random-seed0": [KILLED, KILLED], "random-seed1": [WRONG], "random-seed2": [KILLED] * 9})
    told = []
    outcome = carry_out(made, script, again=lambda key, why: told.append((name_of(made.jobs[key]), why)))
    counts = {name: len(list(all_of)) for name, all_of in itertools.groupby(sorted(script.started))}
    assert counts == {"random-seed0": 3, "random-seed1": 1, "random-seed2": conduct.TRIES}
    failed = {name_of(made.jobs[key]): why for key, why in outcome.failed.items()}
    assert failed == {"random-seed1": "the disk is full", "random-seed2": "it was ended by SIGKILL"}
    # What is given up is told as failed, not as going on.
    again = [(f"random-seed{seed}", KILLED.error) for seed in (0, 2)]
    assert sorted(told) == sorted(again * 2)


def test_one_that_gets_on_between_kills_is_started_as_often_as_it_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = plan.make([figure("a", (cell("random", seeds=1),))], "laptop", tmp_path)
    script, steps = Script({"random-seed0": [KILLED] * 9}), itertools.count(25, 25)
    look = plan.look
    monkeypatch.setattr(plan, "look", lambda job, *more: look(job, *more)._replace(step=next(steps)))
    assert not carry_out(made, script).failed
    assert len(script.started) == 10


def test_a_child_whose_parent_failed_is_left_out(tmp_path: Path):
    made = plan.make([figure("a", (CHILD,))], "laptop", tmp_path)
    script = Script({"disagreement-seed0": [WRONG]})
    outcome = carry_out(made, script)
    assert "sac-from-disagreement-seed0" not in script.started
    assert "sac-from-disagreement-seed1" in script.started
    assert sum("which it starts from, is not finished" in why for why in outcome.failed.values()) == 1


def test_one_that_diverged_is_not_started_and_told_with_its_reason(tmp_path: Path):
    made = plan.make([figure("a", (cell("random", seeds=2),))], "laptop", tmp_path)
    first = next(iter(made.jobs.values()))
    finish(first)
    (first.path / "outcome.json").write_text('{"status": "diverged", "diverged": {}}')
    script = Script()
    outcome = carry_out(made, script)
    assert script.started == ["random-seed1"]
    assert outcome.failed.keys() == {first.key} and "not finite" in outcome.failed[first.key]


def test_what_interrupts_it_stops_what_is_at_work(tmp_path: Path):
    made = plan.make([figure("a", (cell("random", seeds=3),))], "laptop", tmp_path)
    script = Script()

    def tell(standings, working, failed, waiting):
        assert waiting == 1
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        carry_out(made, script, tell)
    assert script.stopped == ["random-seed0", "random-seed1"]


def test_a_run_that_another_process_owns_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = plan.make([figure("a", (cell("random", seeds=2),))], "laptop", tmp_path)
    first = next(iter(made.jobs.values()))
    looks = itertools.count()
    monkeypatch.setattr(plan, "is_free", lambda job: job.key != first.key or next(looks) > 3)
    script = Script()
    assert not carry_out(made, script).failed
    assert script.started == ["random-seed1", "random-seed0"]
