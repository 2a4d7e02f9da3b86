import io
import time

import pytest

from experiments import progress
from experiments.progress import Progress, track


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_a_plain_line_each_tenth(clock: list[float]):
    stream = io.StringIO()
    shown = Progress("drawing", 40, stream=stream, live=False)
    for done in (3, 4, 5, 20, 19, 40):
        clock[0] += 10.0
        shown.reach(done)
    shown.close()
    assert stream.getvalue() == "drawing  10% | 4/40  3 min 00 s left\ndrawing  50% | 20/40  40 s left\n"


def test_what_is_done_at_once_is_not_talked_of(clock: list[float]):
    stream = io.StringIO()
    shown = Progress("drawing", 40, stream=stream, live=False)
    for done in range(41):
        clock[0] += progress.PATIENCE / 41
        shown.reach(done)
    assert stream.getvalue() == ""


def test_a_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch):
    stream = io.StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", stream)
    seen = []
    for item in track("acting", iter("abcde"), 5):
        seen.append(item)
        time.sleep(0.11)  # tqdm draws ten times a second.
    assert seen == list("abcde")
    assert "acting:  60%" in stream.getvalue() and "3/5" in stream.getvalue()
    assert stream.getvalue().split("\r")[-1].strip() == "", "it goes away"


def test_a_bar_goes_away_when_it_is_interrupted(monkeypatch: pytest.MonkeyPatch):
    stream = io.StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", stream)
    items = track("acting", range(9), 9)
    next(items)
    with pytest.raises(KeyboardInterrupt):
        items.throw(KeyboardInterrupt)
    assert stream.getvalue().split("\r")[-1].strip() == ""
