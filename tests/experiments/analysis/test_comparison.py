import numpy as np
import pytest

from experiments.analysis.comparison import coverage_table, paired_return_table, paired_table
from experiments.analysis.statistics import Group, Outcome, Returns, paired_returns
from experiments.runs.scene import Cells


def make_group(label: str, *reached: tuple[int, ...]) -> Group:
    outcomes = [Outcome(seed, len(steps), steps, 1.0, {}, None, None) for seed, steps in enumerate(reached)]
    coverage = np.array([[len(steps) / 2] for steps in reached])
    nothing = np.full_like(coverage, np.nan)
    return Group(label, outcomes, np.array([100]), coverage, nothing, np.array([]), nothing[:, :0])


def test_where_nothing_or_not_all_was_found_there_is_no_step():
    groups = [make_group("lost", (), ()), make_group("half", (), (50,)), make_group("found", (25, 1000), (25, 75))]
    _, _, *lines = coverage_table(groups, Cells(2, "horizontal poses")).splitlines()
    assert [line.split(" | ")[4] for line in lines] == ["-", "-", "1,000, 75"]


def test_methods_are_compared_seed_by_seed():
    groups = [make_group("lost", (), ()), make_group("half", (), (50,)), make_group("found", (25, 1000), (25, 75))]
    table = paired_table(groups, "half")
    assert table is not None
    head, _, *lines = (line.strip("| ").split(" | ") for line in table.splitlines())
    assert head[2:4] == ["less `half`, by seed: mean, 95 %", "seeds ahead of `half`"]
    # 0 and 50 % against 0 and 0: -25 +- t(1) * 25; by seed one tie and one behind; of four pairs two ties, two behind
    assert lines[0] == ["`lost`", "0% (0% to 0%)", "-25 +- 318 points", "0.5 of 2", "0.25 (0.00 to 0.50)"]
    assert lines[1] == ["`half`", "25% (0% to 50%)", "-", "-", "-"]
    assert lines[2][2:] == ["+75 +- 318 points", "2 of 2", "1.00 (1.00 to 1.00)"]
    assert paired_table(groups[:1], "lost") is None


def test_one_seed_has_no_interval():
    table = paired_table([make_group("one", (25,)), make_group("two", (25, 75))], "one")
    assert table is not None
    assert table.splitlines()[-1] == "| `two` | 100% | +50 points | 1 of 1 | 1.00 |"


PLAIN = Returns("plain", (0, 1), np.array([100, 200, 300, 400]), np.array([[0, 0, 30, 40], [0, 0, 0, 0.0]]))
MOVED = Returns("moved", (2, 0), np.array([250, 350, 400, 500]), np.array([[0, 0, 0, 0], [10, 20, 50, 900.0]]))


def test_returns_are_compared_over_the_steps_that_both_have():
    # from 250, where the later one begins, to 400, where the other one ends; of 0, the only seed of both:
    # 10, 15, 20, 50 and 15, 30, 35, 40 at 250, 300, 350, 400
    found = paired_returns(MOVED, PLAIN)
    assert found is not None and (found.first, found.last) == (250, 400)
    assert found.final == ((0,), (10.0, None), 1.0)
    assert found.mean == ((0,), (23.75 - 30.0, None), 0.0)
    table = paired_return_table({"moved": found}, "plain")
    assert table is not None
    assert table.splitlines()[-1] == "| `moved` | 250 to 400 | +10.0 | 1 of 1 | -6.2 | 0 of 1 |"


def test_on_the_same_steps_the_area_is_the_mean_of_the_evaluations():
    # over two seeds: 7 - 1 and 5 - 3 at the end; 4 - 2 and 5 - 1 on average
    steps = np.array([10, 20, 60])
    first = Returns("first", (3, 4), steps, np.array([[1.0, 4, 7], [5, 5, 5]]))
    second = Returns("second", (3, 4), steps, np.array([[3.0, 2, 1], [0, 0, 3]]))
    found = paired_returns(first, second)
    assert found is not None and found.final.ahead == found.mean.ahead == 2
    # the half-width is t(1, 0.975) = 12.706 times half the distance between two values
    assert found.final.difference == pytest.approx((4.0, 2 * 12.7062), rel=1e-5)
    assert found.mean.difference == pytest.approx((3.0, 1 * 12.7062), rel=1e-5)


@pytest.mark.parametrize(
    "other",
    [
        PLAIN._replace(steps=np.zeros(0, int), values=np.zeros((2, 0))),
        PLAIN._replace(steps=np.array([600, 700, 800, 900])),
        PLAIN._replace(seeds=(5, 6)),
    ],
)
def test_where_no_step_or_seed_is_in_both_returns_are_not_compared(other: Returns):
    assert paired_returns(MOVED, other) is None and paired_returns(other, MOVED) is None
