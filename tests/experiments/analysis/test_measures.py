from pathlib import Path

import numpy as np
import pytest

from experiments.analysis import measures
from experiments.analysis.load import load
from experiments.analysis.measures import COVERAGE, RETURN, curves
from experiments.analysis.statistics import group
from experiments.studies import plan
from tests.experiments.studies.by_hand import cell, figure, finish

NAN = float("nan")


def test_the_mean_height_is_the_area_over_the_width():
    steps, values = np.array([100, 200, 300, 400]), np.array([[0.0, 0.5, 0.5, 1.0], [1.0, 1.0, 1.0, 1.0]])
    # A step function: 0 until 200, a half until 400, where it ends.
    assert measures.mean_height(steps, values) == pytest.approx([1 / 3, 1.0], abs=0.01)


def test_the_mean_height_is_that_of_a_comparison(tmp_path: Path):
    (job,) = plan.make([figure("a", (cell("random", env="acrobot", seeds=3),))], "laptop", tmp_path).jobs.values()
    path = finish(job, {0: 4, 1: 2, 2: 1})
    _, (compared,) = group([path])
    steps, values = curves(load(path).rows, COVERAGE) or (np.zeros(0), np.zeros(0))
    heights = dict(enumerate(measures.mean_height(steps, values).tolist()))
    assert heights == pytest.approx(compared.heights)
    # As a measure it is in points of coverage.
    assert COVERAGE.score(steps, values) == pytest.approx([100 * height for height in heights.values()])


def test_the_step_at_which_all_was_seen_or_the_last_one():
    steps, values = np.array([10, 20, 30]), np.array([[0.5, 1.0, 1.0], [0.5, 0.5, 0.5]])
    assert measures.whole_at(steps, values).tolist() == [20.0, 30.0]


def test_what_stays_is_the_second_half_over_the_first():
    steps = np.array([10, 20, 30, 40])
    assert measures.staying(steps, np.array([[1.0, 3.0, 4.0, 4.0], [4.0, NAN, 1.0, NAN]])).tolist() == [2.0, 0.25]


def test_what_rises_is_asked_until_a_seed_has_seen_all():
    steps = np.array([10, 20, 30, 40, 50])
    values = np.array([[NAN, 1.0, 3.0, 0.0, 0.0], [NAN, 4.0, 4.0, 2.0, 2.0], [NAN, 1.0, 9.0, 9.0, 9.0]])
    # Of the first seed 20 and 30 are left, of the second all but the warm-up, of the last one a single value.
    assert measures.rising(steps, values, np.array([30, 50, 20])).tolist()[:2] == [3.0, 0.5]
    assert np.isnan(measures.rising(steps, values, np.array([30, 50, 20]))[2])


def test_an_ending_is_the_mean_of_the_last_tenth_or_the_last_there_is():
    steps = np.array([10, 95, 100])
    found = measures.ending(steps, np.array([[9.0, 1.0, 3.0], [9.0, NAN, 3.0], [9.0, NAN, NAN], [NAN, NAN, NAN]]))
    assert found[:3].tolist() == [2.0, 3.0, 9.0] and np.isnan(found[3])


def test_the_first_field_that_the_rows_have_is_taken_and_coverage_is_held():
    rows = [
        {"step": 1, "seed": 0, "coverage": 0.5, "episode_return": 3.0},
        {"step": 2, "seed": 0, "coverage": 0.75},
        {"step": 1, "seed": 1, "coverage": 0.25},
    ]
    steps, values = curves(rows, COVERAGE) or (None, None)
    assert steps is not None and values is not None
    assert values.tolist() == [[0.5, 0.75], [0.25, 0.25]]
    steps, values = curves(rows, RETURN) or (None, None)
    assert steps is not None and steps.tolist() == [1]
    evaluated = [{**row, "eval/return": 7.0} for row in rows]
    assert (curves(evaluated, RETURN) or (None, np.zeros(0)))[1][0].tolist() == [7.0, 7.0]
    assert curves([{"step": 1, "seed": 0}], RETURN) is None
