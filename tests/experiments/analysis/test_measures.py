import numpy as np
import pytest

from experiments.analysis import measures
from experiments.analysis.measures import COVERAGE, RETURN, curves

NAN = float("nan")


def test_the_mean_height_is_the_area_over_the_width():
    steps, values = np.array([100, 200, 300, 400]), np.array([[0.0, 0.5, 0.5, 1.0], [1.0, 1.0, 1.0, 1.0]])
    # A step function: 0 until 200, a half until 400, where it ends.
    assert measures.mean_height(steps, values) == pytest.approx([1 / 3, 1.0], abs=0.01)


def test_the_step_at_which_all_was_seen_or_the_last_one():
    steps, values = np.array([10, 20, 30]), np.array([[0.5, 1.0, 1.0], [0.5, 0.5, 0.5]])
    assert measures.whole_at(steps, values).tolist() == [20.0, 30.0]


def test_what_stays_is_the_second_half_over_the_first():
    steps = np.array([10, 20, 30, 40])
    assert measures.staying(steps, np.array([[1.0, 3.0, 4.0, 4.0], [4.0, NAN, 1.0, NAN]])).tolist() == [2.0, 0.25]


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
