"""Environments of other packages as ours, and ours as Gymnasium's."""

import difflib
from collections.abc import Iterable

from jaxplore.validate import FieldError

NEIGHBOURS = 5
"""Names that are listed instead."""
CLOSE = 0.6
"""Likeness from which a name may be what was meant, as `jaxplore.validate` has it."""


def check_known(package: str, name: str, known: Iterable[str]) -> None:
    """Raise `FieldError` with the nearest names unless `name` is one of those that a package has.

    Args:
        package: the prefix of its names, such as `brax`, or `gymnasium:module`.
        name: without the prefix.
        known: the package's own names.

    Example:
        >>> check_known("brax", "hoper", ["ant", "hopper"])
        Traceback (most recent call last):
        jaxplore.validate.FieldError: env='brax:hoper' is not known. Did you mean 'brax:hopper'? Allowed: a name that
        is known; the nearest are brax:hopper, brax:ant.
    """
    names = sorted(known)
    if name in names:
        return
    near = difflib.get_close_matches(name, names, n=NEIGHBOURS, cutoff=0.0)
    close = difflib.get_close_matches(name, near, n=1, cutoff=CLOSE)
    hint = f" Did you mean '{package}:{close[0]}'?" if close else ""
    allowed = f"a name that is known; the nearest are {', '.join(f'{package}:{one}' for one in near)}"
    raise FieldError("env", f"{package}:{name}", allowed, f"is not known.{hint}")
