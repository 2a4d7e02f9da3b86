import io
import re
import time

import pytest

from experiments.runs.config import replace
from experiments.runs.presets import preset_config
from experiments.studies.display import Display

CONFIG = replace(preset_config("smoke"), {"num_seeds": 3, "steps": 1000, "explorer": {"warm_up_steps": 100}})


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def row(step: int, cells: int = 2) -> dict:
    return {"step": step, "seed": 0, "cells": cells, "coverage": cells / 7, "wall_time": 61.0, "intrinsic_reward": 3.0}


def test_a_line_for_each_tenth_of_all_and_for_each_end(clock: list[float]):
    stream = io.StringIO()
    display = Display(CONFIG, 2, 7, stream=stream)
    display.update({0: None, 1: None})
    for step in (50, 100, 200, 300, 400, 500):
        display.update({0: row(step), 1: row(step, 5)})
        clock[0] += 10.0
    display.update({0: row(1000), 1: row(500, 5)})
    display.end(0, row(1000), None)
    display.end(1, row(500), "the disk is full")
    display.update({2: None})
    assert stream.getvalue().splitlines() == [
        " 13% |   400/3,000  0 of 3 done  seed 0 at 200, cells 2/7; seed 1 at 200, cells 5/7",
        # both at 10 steps/s: 700 steps left of each, and then the third seed's 1,000
        " 20% |   600/3,000  0 of 3 done  20 steps/s  2 min 50 s left  seed 0 at 300, cells 2/7; seed 1 at 300, "
        "cells 5/7",
        " 33% | 1,000/3,000  0 of 3 done  20 steps/s  2 min 30 s left  seed 0 at 500, cells 2/7; seed 1 at 500, "
        "cells 5/7",
        # 20 and 10 steps/s, and the third seed starts at once
        " 50% | 1,500/3,000  0 of 3 done  30 steps/s  1 min 07 s left  seed 0 at 1,000, cells 2/7; seed 1 at 500, "
        "cells 5/7",
        "Seed 0 is done: cells 2/7 in 1 min 01 s",
        "Seed 1 failed after step 500: the disk is full",
    ]


def test_a_seed_that_continues_has_no_pace_before_it_has_learned_again(clock: list[float]):
    stream = io.StringIO()
    display = Display(CONFIG, 1, 7, stream=stream)
    display.begin({0: 1000, 1: 500}, ended=[0])
    for step in (500, 450, 550, 650, 850):  # the last row, back to the checkpoint, and on
        display.update({1: row(step)})
        clock[0] += 100.0 if step < 550 else 10.0
    lines = stream.getvalue().splitlines()
    # 300 steps in 20 s: a round that waited 100 s for the compiler is not counted; and then seed 2's 1,000
    assert lines == [" 62% | 1,850/3,000  1 of 3 done  15 steps/s  1 min 17 s left  seed 1 at 850, cells 2/7"]


def test_lines_that_are_drawn_over(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "50")
    monkeypatch.setenv("LINES", "20")
    stream = io.StringIO()
    display = Display(CONFIG, 2, 7, stream=stream, live=True)
    display.update({0: row(300), 1: None})
    display.update({0: row(400), 1: row(25)})
    display.end(0, row(1000), None)
    screen: list[str] = []
    for part in re.split(r"(\x1b\[\d+F)", stream.getvalue()):
        if up := re.fullmatch(r"\x1b\[(\d+)F", part):
            del screen[len(screen) - int(up[1]) :]
        else:
            screen += [re.sub(r"\x1b\[[JK]", "", line) for line in part.split("\n") if re.sub(r"\x1b\[[JK]", "", line)]
    assert screen == ["Seed 0 is done: cells 2/7 in 1 min 01 s"]
    drawn = [re.sub(r"\x1b\[\d*[FJK]", "", line) for line in stream.getvalue().splitlines()]
    assert drawn[:3] == [
        "seed 0    30% |   300/1,000  cells 2/7  reward 3",
        "seed 1    starting",
        "all       10% |   300/3,000  0 of 3 done",
    ]
    assert max(map(len, drawn)) < 50
