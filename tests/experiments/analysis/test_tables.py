import pytest

from experiments.analysis.tables import number, spans


@pytest.mark.parametrize(
    ("value", "want"),
    [(None, "-"), (0.0, "0"), (0.01234, "0.012"), (99.4, "99"), (99.6, "100"), (-99.6, "-100"), (12_345.6, "12,346")],
)
def test_numbers_never_turn_into_powers_of_ten_below_a_million(value, want):
    assert number(value) == want


def test_whole_numbers_as_ranges():
    assert spans([27, 20, 21, 22, 21]) == "20 to 22, 27"
    assert spans({5: 1.0}) == "5" and spans([]) == ""
