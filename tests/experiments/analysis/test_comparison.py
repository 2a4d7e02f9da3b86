import numpy as np

from experiments.analysis.comparison import coverage_table
from experiments.analysis.statistics import Group, Outcome
from experiments.runs.scene import Cells


def make_group(label: str, *reached: tuple[int, ...]) -> Group:
    outcomes = [Outcome(seed, len(steps), steps, 1.0, {}, None, None) for seed, steps in enumerate(reached)]
    coverage = np.array([[len(steps) / 2] for steps in reached])
    return Group(label, outcomes, np.array([100]), coverage, np.full_like(coverage, np.nan))


def test_where_nothing_or_not_all_was_found_there_is_no_step():
    groups = [make_group("lost", (), ()), make_group("half", (), (50,)), make_group("found", (25, 1000), (25, 75))]
    _, _, *lines = coverage_table(groups, Cells(2, "horizontal poses")).splitlines()
    assert [line.split(" | ")[4] for line in lines] == ["-", "-", "1,000, 75"]
