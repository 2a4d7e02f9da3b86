"""When rounds end, and rows that are not as a run wrote them."""

import dataclasses
from typing import Any

import pytest

from experiments.runs.presets import preset_config
from experiments.runs.schedule import due, gap, on_schedule, rounds
from jaxplore.config import ExplorationConfig

CONFIG = dataclasses.replace(
    preset_config("smoke", "acrobot"),
    steps=81,
    num_seeds=2,
    explorer=dataclasses.replace(ExplorationConfig(), warm_up_steps=31),
)
ENDS = (25, 31, 50, 75, 81)


def written(**changes: Any) -> list[dict[str, Any]]:
    """The rows of a whole run, or of a seed of it."""
    return [{"step": end, "seed": seed, **changes} for end in ENDS for seed in (0, 1)]


def test_rounds_of_a_longer_run_leave_out_the_end_of_a_shorter_one():
    assert tuple(end for _, end in rounds(CONFIG, 0)) == ENDS
    longer = dataclasses.replace(CONFIG, steps=120)
    assert on_schedule(longer, ENDS) == 75
    assert on_schedule(CONFIG, ENDS) == 81
    assert on_schedule(longer, [81]) is None
    assert [due(40, *pair, 81) for pair in rounds(CONFIG, 0)] == [False, False, True, False, True]
    assert not any(due(0, *pair, 81) for pair in rounds(CONFIG, 0))


def test_rows_as_they_were_written():
    assert gap(CONFIG, written(), 81) is None
    assert gap(CONFIG, written()[:6], 50) is None
    # rows that come after the checkpoint are cut back anyway
    assert gap(CONFIG, [*written(), *written()[:2]], 24) is None
    # a seed that diverged has no rows from then on
    rows = [row for row in written() if row["seed"] == 0 or row["step"] <= 31]
    rows[3]["diverged"] = "fit/loss"
    assert rows[3] == {"step": 31, "seed": 1, "diverged": "fit/loss"}
    assert gap(CONFIG, rows, 81) is None


@pytest.mark.parametrize(
    ("spoil", "good", "what"),
    [
        (lambda rows: [], 0, "lacks 5 rows from step 25 to 81 of seed 0"),
        (lambda rows: rows[:-1], 75, "lacks the row of step 81 of seed 1"),
        (lambda rows: rows[:4] + rows[6:], 31, "lacks the row of step 50 of seed 0"),
        (lambda rows: rows[2:], 0, "lacks the row of step 25 of seed 0"),
        (lambda rows: rows[:6] + rows[4:], 50, "has the row of step 50 more than once of seed 0"),
        (lambda rows: rows[:2] + rows[4:6] + rows[2:4] + rows[6:], 25, "has rows that are out of order of seed 0"),
        (lambda rows: [*rows, {"step": 81, "seed": 5}], 0, "has rows of seed 5, which the run does not have"),
    ],
)
def test_rows_that_somebody_has_touched(spoil: Any, good: int, what: str):
    assert gap(CONFIG, spoil(written()), 81) == (good, what)
