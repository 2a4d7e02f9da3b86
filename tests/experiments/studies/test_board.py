import io
import itertools
from pathlib import Path

import pytest

from experiments.studies import board, plan
from experiments.studies.estimates import Rates
from experiments.studies.plan import State
from tests.experiments.studies.by_hand import NO_RATES, cell, figure


@pytest.fixture
def made(tmp_path: Path) -> plan.Plan:
    return plan.make([figure("a", (cell("random", seeds=3),))], "laptop", tmp_path)


def test_a_line_for_each_at_work_and_one_for_all(made: plan.Plan, monkeypatch: pytest.MonkeyPatch):
    stream, clock = io.StringIO(), itertools.count(0.0, 0.25)
    monkeypatch.setattr(board.time, "monotonic", lambda: next(clock))
    monkeypatch.setenv("COLUMNS", "200")
    shown = board.Board(made, Rates({}, {("ant_maze", "random", "laptop"): 0.1}), 2, stream=stream, live=True)
    first, second, third = made.jobs
    now = plan.look_all(made)
    shown.update(now, [first, second], {}, 1)
    # 300 steps at 0.1 s each by runs of before, and three of them two at a time.
    assert "0% |   0/300  30 s left" in stream.getvalue()
    assert "0 of 3 runs done, 2 at work; 45 s left" in stream.getvalue()
    now[first] = now[first]._replace(state=State.FINISHED, step=300)
    shown.update(now, [second, third], {second: "the disk is full"}, 0)
    assert f"{made.jobs[first].name} is done" in stream.getvalue()
    assert f"{made.jobs[second].name} failed: the disk is full" in stream.getvalue()
    assert "1 of 3 runs done, 2 at work, 1 failed" in stream.getvalue()


def test_a_runs_own_pace_is_taken_once_it_has_one(made: plan.Plan, monkeypatch: pytest.MonkeyPatch):
    stream, now = io.StringIO(), [0.0]
    monkeypatch.setattr(board.time, "monotonic", lambda: now[0])
    shown = board.Board(made, NO_RATES, 2, stream=stream, live=True)
    first = next(iter(made.jobs))
    standings = plan.look_all(made)
    # The first round waits for the compiler; after it 50 steps take 10 s, so that the last 150 take 30 s.
    for now[0], step in ((0.0, 0), (60.0, 50), (70.0, 100), (80.0, 150)):
        standings[first] = standings[first]._replace(step=step)
        shown.update(standings, [first], {}, 2)
    assert "50% | 150/300  30 s left" in stream.getvalue()
    assert "at least" in stream.getvalue()  # nothing tells of the others


def test_plain_lines_elsewhere(made: plan.Plan):
    stream = io.StringIO()
    shown = board.Board(made, NO_RATES, 2, stream=stream, live=False)
    now = plan.look_all(made)
    for _ in range(3):
        shown.update(now, list(made.jobs)[:2], {}, 1)
    assert stream.getvalue() == "0 of 3 runs done, 2 at work\n"


def test_a_worker_that_was_lost_is_said(made: plan.Plan):
    stream = io.StringIO()
    shown = board.Board(made, NO_RATES, 2, stream=stream, live=False)
    first = next(iter(made.jobs))
    shown.again(first, "its Slurm job 7 went away (cancelled).")
    said = f"{made.jobs[first].name}: its Slurm job 7 went away (cancelled); it goes on from its latest checkpoint\n"
    assert stream.getvalue() == said
