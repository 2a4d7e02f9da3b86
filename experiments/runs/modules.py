"""Modules with methods and environments of a person's own, imported when that person says so, not because a file does.

Importing a module runs it. A run's directory may come from somebody else, so its files only say which modules it needs.
"""

import argparse
import importlib
import sys
from collections.abc import Iterable, Sequence

from experiments.runs.errors import RunError

HELP = "a module of your own that registers methods or environments"


def add_flag(parser: argparse.ArgumentParser) -> None:
    """Give a command line `--import=MODULE`; `load` what it holds."""
    parser.add_argument("--import", dest="imports", action="append", default=[], metavar="MODULE", help=HELP)


def take(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """The modules that a command line names, and the rest of its words.

    Example:
        >>> take(["--import=mine", "--env=my_env", "--import", "others"])
        (['mine', 'others'], ['--env=my_env'])
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    add_flag(parser)
    arguments, rest = parser.parse_known_args(list(argv))
    return arguments.imports, rest


def load(names: Sequence[str]) -> None:
    """Import modules.

    Raises:
        RunError: one that cannot be imported.
    """
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:  # A module of anybody's raises anything.
            raise RunError(
                f"--import={name}: cannot import it ({type(error).__name__}: {error}). Allowed: modules that Python "
                "finds from here."
            ) from error


def of_env(env: str | None) -> list[str]:
    """The module in an environment's name, which Gymnasium calls `gymnasium:MODULE:ID`.

    Example:
        >>> of_env("gymnasium:mine:Own-v0"), of_env("gymnasium:Pendulum-v1")
        (['mine'], [])
    """
    package, _, rest = (env or "").partition(":")
    module, colon, _ = rest.rpartition(":")
    return [module] if package == "gymnasium" and colon else []


def check(names: Iterable[str], source: str) -> None:
    """Refuse a file that needs a module which nobody has asked for.

    Raises:
        RunError: names the module and the flag.
    """
    missing = [name for name in names if name not in sys.modules]
    if missing:
        flags = " ".join(f"--import={name}" for name in missing)
        raise RunError(
            f"{source} needs the module {', '.join(missing)}, and importing it runs it. What to do: if you trust it, "
            f"give {flags}."
        )
