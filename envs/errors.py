"""What an environment of anybody's may do wrong, in one line."""

from typing import Any


class EnvironmentFault(Exception):
    """An environment raised an error, or gave back what no environment may.

    Args:
        env: its name.
        when: at what: `"reset"`, or `"step 3 of an episode"`.
        found: what happened, such as `"raised KeyError: 'x'"` or `"returned 4 values"`.
        expected: what should have.

    Example:
        >>> print(EnvironmentFault("gymnasium:Own-v0", "reset", "returned 3 values", "an observation and an info"))
        the environment gymnasium:Own-v0 returned 3 values at reset. Expected: an observation and an info.
    """

    def __init__(self, env: str, when: str, found: str, expected: str) -> None:
        self.env, self.when, self.found, self.expected = env, when, found, expected
        super().__init__(f"the environment {env} {found} at {when}. Expected: {expected}.")


def raised(error: BaseException) -> str:
    """What an environment raised, as `found`."""
    text = str(error).strip().splitlines()
    return f"raised {type(error).__name__}{f': {text[0]}' if text else ''}"


def shape_of(value: Any) -> str:
    """The shape of what was found where an array was expected, or what it is."""
    shape = getattr(value, "shape", None)
    return f"shape {tuple(shape)}" if shape is not None else f"type {type(value).__name__}"
