"""Checks that configurations and factories run on their input.

Each raises a `FieldError`, a `ValueError` that knows the field, its value and what is allowed; a misspelt name gets the
nearest match.
"""

import contextlib
import difflib
import math
import numbers
from collections.abc import Iterable, Iterator
from typing import Any

import jax.core
import numpy as np


class FieldError(ValueError):
    """A field holds what it may not.

    Its text names the field as the code does (`SACConfig.lr`). Who knows the field by another name, such as a flag,
    has `spell` for it.

    Args:
        field: name of the field, or its path from the outermost configuration, such as `explorer.sac.lr`.
        value: what it holds.
        allowed: what it may hold.
        problem: what is wrong with the value, as the rest of a sentence: `"is out of range"`.
        owner: name of the class that the field is of.

    Example:
        >>> error = FieldError("lr", -1.0, "a finite number in (0, inf)", "is out of range", "SACConfig")
        >>> str(error)
        'SACConfig.lr=-1.0 is out of range. Allowed: a finite number in (0, inf).'
        >>> error.spell("--sac.lr")
        '--sac.lr=-1.0 is out of range. Allowed: a finite number in (0, inf).'
    """

    def __init__(self, field: str, value: Any, allowed: str, problem: str = "", owner: str = "") -> None:
        self.field, self.value, self.allowed, self.problem, self.owner = field, value, allowed, problem, owner
        super().__init__(self.spell(f"{owner}.{field}" if owner else field))

    def spell(self, name: str) -> str:
        """The message, with the field called `name`."""
        problem = f" {self.problem}." if self.problem and self.problem[-1] not in ".?" else f" {self.problem}".rstrip()
        return f"{name}={self.value!r}{problem or '.'} Allowed: {self.allowed}."

    def of(self, owner: str) -> "FieldError":
        """The same error, of a field of `owner`."""
        return FieldError(self.field, self.value, self.allowed, self.problem, owner)

    def at(self, prefix: str) -> "FieldError":
        """The same error, of a field with the path `prefix` before its name and no owner."""
        return FieldError(f"{prefix}{self.field}", self.value, self.allowed, self.problem)


def one_of(field: str, value: Any, allowed: Iterable[str]) -> None:
    """Raise unless `value` is one of the names in `allowed`."""
    names = sorted(allowed)
    if value in names:
        return
    close = difflib.get_close_matches(str(value), names, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    raise FieldError(field, value, ", ".join(names), f"is not known.{hint}")


def in_range(
    field: str,
    value: float,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    open_low: bool = False,
    open_high: bool = False,
) -> None:
    """Raise unless `value` is a finite number in the range; `open_low` and `open_high` leave that end out."""
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if number and (value > low if open_low else value >= low) and (value < high if open_high else value <= high):
        return
    left = f"{'(' if open_low or low == -math.inf else '['}{low:g}"
    right = f"{high:g}{')' if open_high or high == math.inf else ']'}"
    raise FieldError(field, value, f"a finite number in {left}, {right}", "is out of range")


def at_least(field: str, value: int, low: int) -> None:
    """Raise unless `value` is a whole number of at least `low`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise FieldError(field, value, f"a whole number, {low} or more", "is out of range")


def sizes(**values: int) -> None:
    """Raise unless each value, called as its keyword, is a whole number of at least 1; NumPy's are, too."""
    for field, value in values.items():
        at_least(field, int(value) if isinstance(value, numbers.Integral) else value, 1)


def shape(field: str, value: Any, *wanted: int | str) -> None:
    """Raise unless an array has the shape that is wanted: what JAX would broadcast, or refuse in words of its own.

    Args:
        field: what the array is called.
        value: the array, which may be traced.
        *wanted: the length of each axis; a letter stands for any but 0, and `"..."`, at the start, for any axes.

    Example:
        >>> import numpy as np
        >>> shape("obs", np.zeros((5, 3)), "B", 3)
        >>> shape("obs", np.zeros((5, 1)), "...", 3)
        Traceback (most recent call last):
        jaxplore.validate.FieldError: obs=(5, 1) is its shape. Allowed: shape [..., 3].
    """
    given, free = np.shape(value), wanted[:1] == ("...",)
    axes = wanted[1:] if free else wanted
    last = given[len(given) - len(axes) :] if free else given
    if len(last) == len(axes) and all(n > 0 if isinstance(w, str) else n == w for n, w in zip(last, axes, strict=True)):
        return
    letters = [axis for axis in axes if isinstance(axis, str)]
    least = f", {' and '.join(letters)} 1 or more" if letters else ""
    raise FieldError(field, given, f"shape [{', '.join(map(str, wanted))}]{least}", "is its shape")


def known(value: Any) -> bool:
    """Whether a value is known here, or only when the program that is being traced runs."""
    return not isinstance(value, jax.core.Tracer)


def widths(field: str, value: tuple[int, ...]) -> None:
    """Raise unless `value` is a tuple of layer widths, each a whole number of at least 1."""
    if not isinstance(value, tuple) or not value:
        raise FieldError(field, value, "one or more whole numbers", "is not a list of layer widths")
    for width in value:
        at_least(field, width, 1)


class Checks:
    """The checks above on the fields of one object, which the messages name: `SACConfig.lr=-1 is out of range`.

    Example:
        >>> import types
        >>> Checks(types.SimpleNamespace(lr=-1.0)).in_range("lr", 0.0)
        Traceback (most recent call last):
        jaxplore.validate.FieldError: SimpleNamespace.lr=-1.0 is out of range. Allowed: a finite number in [0, inf).
    """

    def __init__(self, config: Any) -> None:
        self._config = config

    @contextlib.contextmanager
    def _owned(self) -> Iterator[None]:
        try:
            yield
        except FieldError as error:
            raise error.of(type(self._config).__name__) from None

    def one_of(self, field: str, allowed: Iterable[str]) -> None:
        """See `validate.one_of`."""
        with self._owned():
            one_of(field, getattr(self._config, field), allowed)

    def in_range(self, field: str, low: float = -math.inf, high: float = math.inf, **ends: bool) -> None:
        """See `validate.in_range`."""
        with self._owned():
            in_range(field, getattr(self._config, field), low, high, **ends)

    def at_least(self, field: str, low: int) -> None:
        """See `validate.at_least`."""
        with self._owned():
            at_least(field, getattr(self._config, field), low)

    def widths(self, field: str) -> None:
        """See `validate.widths`."""
        with self._owned():
            widths(field, getattr(self._config, field))

    def refusal(self, field: str, problem: str, allowed: str) -> FieldError:
        """The error to raise for a field that does not go with the others."""
        return FieldError(field, getattr(self._config, field), allowed, problem, type(self._config).__name__)
