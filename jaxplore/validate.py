"""Checks that configurations and factories run on their input.

Each raises a `ValueError` that names the field, its value and what is allowed; a misspelt name gets the nearest match.
"""

import difflib
import math
from collections.abc import Iterable
from typing import Any


def one_of(field: str, value: Any, allowed: Iterable[str]) -> None:
    """Raise unless `value` is one of the names in `allowed`."""
    names = sorted(allowed)
    if value in names:
        return
    close = difflib.get_close_matches(str(value), names, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    raise ValueError(f"{field}={value!r} is not known.{hint} Allowed: {', '.join(names)}.")


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
    raise ValueError(f"{field}={value!r} is out of range. Allowed: a finite number in {left}, {right}.")


def at_least(field: str, value: int, low: int) -> None:
    """Raise unless `value` is a whole number of at least `low`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ValueError(f"{field}={value!r} is out of range. Allowed: a whole number, {low} or more.")


def widths(field: str, value: tuple[int, ...]) -> None:
    """Raise unless `value` is a tuple of layer widths, each a whole number of at least 1."""
    if not isinstance(value, tuple) or not value:
        raise ValueError(f"{field}={value!r} is not a list of layer widths. Allowed: one or more whole numbers.")
    for width in value:
        at_least(field, width, 1)


class Checks:
    """The checks above on the fields of one object, which the messages name: `SACConfig.lr=-1 is out of range`.

    Example:
        >>> import types
        >>> Checks(types.SimpleNamespace(lr=-1.0)).in_range("lr", 0.0)
        Traceback (most recent call last):
        ValueError: SimpleNamespace.lr=-1.0 is out of range. Allowed: a finite number in [0, inf).
    """

    def __init__(self, config: Any) -> None:
        self._config = config

    def _name(self, field: str) -> str:
        return f"{type(self._config).__name__}.{field}"

    def one_of(self, field: str, allowed: Iterable[str]) -> None:
        """See `validate.one_of`."""
        one_of(self._name(field), getattr(self._config, field), allowed)

    def in_range(self, field: str, low: float = -math.inf, high: float = math.inf, **ends: bool) -> None:
        """See `validate.in_range`."""
        in_range(self._name(field), getattr(self._config, field), low, high, **ends)

    def at_least(self, field: str, low: int) -> None:
        """See `validate.at_least`."""
        at_least(self._name(field), getattr(self._config, field), low)

    def widths(self, field: str) -> None:
        """See `validate.widths`."""
        widths(self._name(field), getattr(self._config, field))
