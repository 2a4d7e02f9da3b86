import pytest

from experiments.analysis.verdicts import Numbers, ahead, at_least, at_most, falls, judge, ranks, rises

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
    assert ahead("a", "b").decide(Numbers(scores))[0] == answer


def test_its_words_have_the_difference_its_interval_and_its_unit():
    # Differences 0.8, 0.75, 0.85: mean 0.8, deviation 0.05, t(2) = 4.303, so 4.303 * 0.05 / sqrt(3) = 0.124.
    assert ahead("a", "b").decide(Numbers({"a": GOOD, "b": BAD}))[1] == "by 0.8 ± 0.12 on 3 seeds"
    steps = Numbers({"a": BAD, "b": GOOD}, "steps")
    assert ahead("a", "b").decide(steps)[1] == "by -0.8 ± 0.12 steps on 3 seeds"


def test_what_rises_and_what_falls():
    up, down, level = {0: 1.1, 1: 1.2, 2: 1.15}, {0: 0.4, 1: 0.3, 2: 0.35}, {0: 0.5, 1: 1.5, 2: 1.0}
    for condition, name, good, bad in ((rises, "rises", up, down), (falls, "changes", down, up)):
        decide = condition("a").decide
        assert decide(Numbers(**{name: {"a": good}}))[0] == "holds"
        assert decide(Numbers(**{name: {"a": bad}}))[0] == "does not hold"
        assert decide(Numbers(**{name: {"a": level}}))[0] == "undecided"
        assert decide(Numbers(**{name: {"a": {0: 9.0}}}))[0] == "undecided"  # one seed has no interval
        assert decide(Numbers())[0] == "not run"
    assert falls("a").decide(Numbers(changes={"a": down})) == ("holds", "0.35 ± 0.12 times as high on 3 seeds")


def test_at_most_and_at_least_are_asked_of_every_seed():
    assert at_most("a", 0.4).decide(Numbers(ends={"a": BAD})) == ("holds", "on 3 of 3 seeds, the highest at 10%")
    assert at_most("a", 0.4).decide(Numbers(ends={"a": MIXED}))[0] == "does not hold"
    assert at_most("a", 0.4).decide(Numbers())[0] == "not run"
    assert at_least("a", 0.8).decide(Numbers(ends={"a": GOOD}))[0] == "holds"
    refuted = at_least("a", 0.8).decide(Numbers(ends={"a": MIXED}))
    assert refuted == ("does not hold", "on 1 of 3 seeds, the lowest at 10%")
    # All that are there do, and some are not there yet.
    early = at_least("a", 0.8).decide(Numbers(ends={"a": GOOD}, wanted={"a": 5}))
    assert early == ("undecided", "on 3 of 3 seeds, the lowest at 80%; 2 more are not there")
    assert at_least("a", 0.8).decide(Numbers(ends={"a": MIXED}, wanted={"a": 5}))[0] == "does not hold"


def test_a_belief_ranks_its_errors_in_every_fit():
    assert ranks("a").decide(Numbers({"a": {0: 0.3, 1: 0.1}})) == ("holds", "in 2 of 2 fits; the lowest is 0.1")
    assert ranks("a").decide(Numbers({"a": {0: 0.3, 1: -0.1}}))[0] == "does not hold"
    assert ranks("a").decide(Numbers())[0] == "not run"


def test_a_claim_holds_if_all_of_it_does():
    numbers = [
        Numbers({"a": GOOD, "b": BAD, "c": MIXED}, ends={"a": GOOD, "b": BAD}),
        Numbers({"a": BAD, "b": GOOD}),
    ]
    assert judge([ahead("a", "b"), at_most("b", 0.4)], numbers)[0] == "holds"
    assert judge([ahead("a", "b"), ahead("a", "c")], numbers)[0] == "undecided"
    assert judge([ahead("a", "c"), ahead("a", "b", 1)], numbers)[0] == "does not hold"
    assert judge([ahead("a", "b"), ahead("a", "x")], numbers)[0] == "undecided"
    assert judge([ahead("x", "b")], numbers)[0] == "not run"
    # Without a condition nothing was asked, which is no verdict.
    assert judge([], numbers) == ("not asked", ())
