import pytest

from experiments.analysis.verdicts import ahead, at_least, at_most, judge, stays

GOOD, BAD, MIXED = {0: 0.9, 1: 0.8, 2: 0.85}, {0: 0.1, 1: 0.05, 2: 0.0}, {0: 0.2, 1: 0.9, 2: 0.1}


@pytest.mark.parametrize(
    ("scores", "answer"),
    [
        ({"a": GOOD, "b": BAD}, "holds"),
        ({"a": BAD, "b": GOOD}, "does not hold"),
        ({"a": GOOD, "b": MIXED}, "undecided"),
        ({"a": GOOD, "b": GOOD}, "undecided"),
        ({"a": {0: 1.0}, "b": {0: 0.0}}, "undecided"),  # one seed has no interval
        ({"a": {0: 1.0}, "b": {1: 0.0}}, "undecided"),
        ({"a": GOOD}, "not run"),
    ],
)
def test_ahead_is_the_paired_interval_above_nothing(scores, answer: str):
    assert ahead("a", "b").decide(scores)[0] == answer


def test_its_words_have_the_difference_and_its_interval():
    # Differences 0.8, 0.75, 0.85: mean 0.8, deviation 0.05, t(2) = 4.303, so 4.303 * 0.05 / sqrt(3) = 0.124.
    assert ahead("a", "b").decide({"a": GOOD, "b": BAD})[1] == "a less b: 0.8 ± 0.12 on 3 seeds"


def test_what_stays_is_as_high_later():
    assert stays("a").decide({"a": {0: 1.1, 1: 1.2, 2: 1.15}})[0] == "holds"
    assert stays("a").decide({"a": {0: 0.4, 1: 0.3, 2: 0.35}}) == ("does not hold", "a: 0.35 ± 0.12")
    assert stays("a").decide({"a": {0: 0.5, 1: 1.5, 2: 1.0}})[0] == "undecided"
    assert stays("a").decide({})[0] == "not run"


def test_at_most_and_at_least():
    assert at_most("a", 0.4).decide({"a": BAD})[0] == "holds"
    assert at_most("a", 0.4).decide({"a": GOOD})[0] == "does not hold"
    assert at_most("a", 0.4).decide({"a": MIXED})[0] == "undecided"
    assert at_most("a", 0.4).decide({})[0] == "not run"
    assert at_least("a", 0.8).decide({"a": GOOD})[0] == "holds"
    assert at_least("a", 0.8).decide({"a": MIXED}) == ("undecided", "a comes to 80% on 1 of 3 seeds")
    assert at_least("a", 0.8).decide({"a": BAD})[0] == "does not hold"


def test_a_claim_holds_if_all_of_it_does():
    scores = [{"a": GOOD, "b": BAD, "c": MIXED}, {"a": BAD, "b": GOOD}]
    ends = [{"a": GOOD, "b": BAD}, {}]
    assert judge([ahead("a", "b"), at_most("b", 0.4)], scores, ends)[0] == "holds"
    assert judge([ahead("a", "b"), ahead("a", "c")], scores, ends)[0] == "undecided"
    assert judge([ahead("a", "c"), ahead("a", "b", 1)], scores, ends)[0] == "does not hold"
    assert judge([ahead("a", "b"), ahead("a", "x")], scores, ends)[0] == "undecided"
    assert judge([ahead("x", "b")], scores, ends)[0] == "not run"
    assert judge([], scores, ends)[0] == "undecided"


def test_ends_are_asked_where_the_measure_is_another_number():
    scores, ends = [{"a": {0: -500.0, 1: -400.0}}], [{"a": {0: 1.0, 1: 1.0}}]
    assert judge([at_least("a", 1.0)], scores, ends)[0] == "holds"
