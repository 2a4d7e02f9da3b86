"""What a refused setting says, and how whoever knows the field by another name says it."""

import dataclasses

import numpy as np
import pytest

from jaxplore import validate
from jaxplore.validate import Checks, FieldError


@dataclasses.dataclass(frozen=True)
class Config:
    rate: float = 0.5
    count: int = 3
    name: str = "left"
    hidden: tuple[int, ...] = (8,)


@pytest.mark.parametrize(
    ("problem", "want"),
    [
        ("", "lr=-1.0. Allowed: above 0."),
        ("is out of range", "lr=-1.0 is out of range. Allowed: above 0."),
        ("is not known. Did you mean 'rl'?", "lr=-1.0 is not known. Did you mean 'rl'? Allowed: above 0."),
        ("is not known.", "lr=-1.0 is not known. Allowed: above 0."),
    ],
)
def test_a_message_is_one_sentence_and_what_is_allowed(problem, want):
    # with one full stop wherever the problem ends
    assert str(FieldError("lr", -1.0, "above 0", problem)) == want


def test_the_field_has_the_name_of_whoever_speaks_of_it():
    # as the code has it, with its class; as a flag; and as a path without the class, which the others leave as it was
    error = FieldError("lr", "fast", "a number", "is out of range")
    rest = "='fast' is out of range. Allowed: a number."
    assert str(error) == f"lr{rest}"
    owned = error.of("SACConfig")
    assert str(owned) == f"SACConfig.lr{rest}" and owned.owner == "SACConfig"
    assert owned.spell("--explorer.sac.lr") == f"--explorer.sac.lr{rest}"
    nested = owned.at("sac.").at("explorer.")
    assert str(nested) == f"explorer.sac.lr{rest}"
    assert (nested.field, nested.value, nested.allowed, nested.problem, nested.owner) == (
        "explorer.sac.lr",
        "fast",
        "a number",
        "is out of range",
        "",
    )
    assert (error.field, owned.field) == ("lr", "lr")
    assert isinstance(nested, ValueError)


def test_a_refusal_names_class_field_and_value():
    # of a field that is fine by itself
    error = Checks(Config(rate=0.25)).refusal("rate", "does not go with count=3", "1.0")
    assert str(error) == "Config.rate=0.25 does not go with count=3. Allowed: 1.0."
    assert (error.field, error.owner, error.value) == ("rate", "Config", 0.25)


@pytest.mark.parametrize(
    ("check", "config", "message"),
    [
        (
            ("in_range", "rate", 0.0, 1.0),
            Config(rate=1.5),
            r"Config\.rate=1\.5 is out of range\. Allowed: .*\[0, 1\]\.$",
        ),
        (("in_range", "rate"), Config(rate=float("nan")), r"Config\.rate=nan .*a finite number in \(-inf, inf\)\.$"),
        (("in_range", "count", 0.0), Config(count=True), r"Config\.count=True .*\[0, inf\)\.$"),
        (
            ("at_least", "count", 4),
            Config(),
            r"Config\.count=3 is out of range\. Allowed: a whole number, 4 or more\.$",
        ),
        (("at_least", "rate", 0), Config(), r"Config\.rate=0\.5 .*a whole number, 0 or more\.$"),
        (("one_of", "name", ["right", "up"]), Config(name="rigth"), r"='rigth' is not known\. Did you mean 'right'\? "),
        (("one_of", "name", ["right", "up"]), Config(), r"='left' is not known\. Allowed: right, up\.$"),
        (
            ("widths", "hidden"),
            Config(hidden=()),
            r"Config\.hidden=\(\) is not a list of layer widths\. Allowed: one or",
        ),
        (("widths", "hidden"), Config(hidden=(8, 0)), r"Config\.hidden=0 is out of range\. .* 1 or more\.$"),
    ],
)
def test_checks_name_the_field_its_value_and_what_is_allowed(check, config, message):
    name, *arguments = check
    with pytest.raises(FieldError, match=message) as caught:
        getattr(Checks(config), name)(*arguments)
    assert (caught.value.owner, caught.value.field) == ("Config", arguments[0])


def test_open_ends_are_left_out():
    # 0 and 1 themselves, each where its end is open
    validate.in_range("rate", 0.0, 0.0, 1.0, open_high=True)
    validate.in_range("rate", 1, 0.0, 1.0, open_low=True)
    for value, ends in ((0.0, {"open_low": True}), (1.0, {"open_high": True})):
        with pytest.raises(FieldError, match=r"a finite number in "):
            validate.in_range("rate", value, 0.0, 1.0, **ends)


@pytest.mark.parametrize(
    ("given", "wanted", "allowed"),
    [
        ((5, 1), ("B", 3), r"\[B, 3\], B 1 or more\."),
        ((0, 3), ("B", 3), r"\[B, 3\], B 1 or more\."),
        ((3,), ("B", 3), r"\[B, 3\]"),
        ((2, 5, 3), ("B", 3), r"\[B, 3\]"),
        ((3, 1), ("...", 3), r"\[\.\.\., 3\]\."),
        ((), ("...", 3), r"\[\.\.\., 3\]\."),
        ((1,), (), r"\[\]\."),
        ((4, 0), ("N", "O"), r"\[N, O\], N and O 1 or more\."),
    ],
)
def test_another_shape_is_refused(given, wanted, allowed):
    with pytest.raises(
        FieldError, match=rf"rows=\({', '.join(map(str, given))},?\) is its shape\. Allowed: .*{allowed}"
    ):
        validate.shape("rows", np.zeros(given), *wanted)


def test_shapes_that_are_wanted_pass():
    # letters are any length but 0, three dots any axes
    for given, wanted in (((5, 3), ("B", 3)), ((3,), ("...", 3)), ((0, 2, 3), ("...", 3)), ((), ()), ((2,), (2,))):
        validate.shape("rows", np.zeros(given), *wanted)
