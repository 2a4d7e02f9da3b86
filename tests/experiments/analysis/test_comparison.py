import numpy as np

from experiments.analysis.comparison import coverage_table, paired_table
from experiments.analysis.statistics import Group, Outcome
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
