"""The table of the benchmarks."""

import pytest

from benchmarks.result import Result, as_time, make_result, table
from benchmarks.timing import Timing


def test_a_floor_is_flops_over_the_rate():
    result = make_result("SVGD step", "4 x 8", Timing(best=0.02, median=0.03, compile=1.5), flop=1e9, rate=1e11)
    assert result.floor_seconds == pytest.approx(0.01)
    assert result.times_floor == pytest.approx(2.0)
    assert result.to_dict()["times_floor"] == pytest.approx(2.0)
    assert make_result("round", "", Timing(0.02, 0.03, 1.5)).times_floor is None


def test_the_table_has_a_line_for_each_result():
    lines = table(
        [
            Result("SVGD step", "4 x 8", 0.02, 0.03, 1.5, 1e9, 0.01),
            Result("bead", "1", 4e-5, 4e-5, 0.25, per_second=25_000),
        ]
    ).splitlines()
    assert len(lines) == 4
    assert lines[0].split("   ")[-4:] == ["floor", "x floor", "per second", "first call"]
    assert lines[2].split() == ["SVGD", "step", "4", "x", "8", "20", "ms", "10", "ms", "2", "-", "1.5", "s"]
    assert lines[3].split() == ["bead", "1", "40", "us", "-", "-", "25,000", "250", "ms"]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "-"), (83.0, "83 s"), (1.0, "1 s"), (0.25, "250 ms"), (3.1e-6, "3.1 us"), (4e-10, "0.4 ns")],
)
def test_times_have_the_largest_unit_that_they_reach(seconds, text):
    assert as_time(seconds) == text
