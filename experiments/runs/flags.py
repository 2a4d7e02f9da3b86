"""Flags from configurations: every field of a dataclass is one, with its docstring as help.

The only file that knows tyro. Values are parsed here and checked by the configurations themselves, so that a bad one
gets the same message on the command line as in a file.
"""

import ast
import dataclasses
import difflib
import functools
import inspect
import re
import textwrap
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

from experiments.runs.errors import RunError

try:
    import tyro
except ImportError as error:
    raise RunError('the command line needs tyro. What to do: pip install -e ".[experiments]".') from error

NUMBERS: dict[Any, tuple[str, str]] = {int: ("INT", "a whole number"), float: ("FLOAT", "a number")}
"""What stands for a number in the help, and what is allowed."""

WIDTH = 100
"""Columns of the brief help."""


class Layout(NamedTuple):
    """How the fields of configurations become flags."""

    unprefixed: Sequence[str] = ()
    """Fields that are dataclasses and whose own fields are flags without the field's name before them."""
    choices: Mapping[str, Sequence[str]] = {}
    """Names to list in the help of a text field."""
    first: Collection[str] = ()
    """Fields whose flags `--help` shows first, within the dataclasses that have no prefix."""
    moved: Mapping[str, str] = {}
    """Flags that there were once -> what to use in their place."""


def option(argv: Sequence[str], name: str) -> str | None:
    """The value of `--name VALUE` or `--name=VALUE`; the last one given.

    Example:
        >>> option(["--env=nchain", "--env", "acrobot"], "env")
        'acrobot'
    """
    found = None
    for i, word in enumerate(argv):
        if word == f"--{name}" and i + 1 < len(argv):
            found = argv[i + 1]
        elif word.startswith(f"--{name}="):
            found = word.partition("=")[2]
    return found


def given(argv: Sequence[str]) -> list[str]:
    """The flags of a command line as paths of fields: `--sac.batch-size=8` is `sac.batch_size`.

    Example:
        >>> given(["--sac.batch-size=8", "--fit.no-restart", "--seed", "-1"])
        ['sac.batch_size', 'fit.restart', 'seed']
    """
    names = [word[2:].partition("=")[0].replace("-", "_") for word in argv if word.startswith("--")]
    return [".".join((*group, last.removeprefix("no_"))) for *group, last in (name.split(".") for name in names)]


def parse(
    argv: Sequence[str],
    groups: Sequence[Any],
    *,
    prog: str,
    description: str,
    layout: Layout,
) -> list[dict[str, Any]]:
    """Read flags.

    Args:
        argv: the words after the program's name.
        groups: dataclasses; their values are the flags' defaults.
        prog: the program's name.
        description: what it does, for `--help`.
        layout: how fields become flags.

    Returns:
        The values of each of `groups`, as nested dictionaries.

    Raises:
        ValueError: a flag that does not exist, naming the nearest; a flag without its value, or with one that it does
            not take; text where a number belongs.
        SystemExit: with 0 after `--help`.
    """
    kinds = {flag: kind for group in groups for flag, kind in _flags(group, layout.unprefixed)}
    _check_words(argv, kinds)
    names = [f"group_{i}" for i in range(len(groups))]
    mirrors = [_mirror(group, layout, top=True) for group in groups]
    fields = [(name, _group(mirror), mirror()) for name, mirror in zip(names, mirrors, strict=True)]
    arguments = dataclasses.make_dataclass("Arguments", fields, frozen=True)
    parsed, unknown = tyro.cli(arguments, prog=prog, description=description, args=list(argv), return_unknown_args=True)
    for word in unknown:
        name = word.partition("=")[0].replace("_", "-")
        if name in layout.moved:
            raise ValueError(f"{word} is no setting any more. Allowed: {layout.moved[name]}.")
        nearest = difflib.get_close_matches(name, kinds, n=1)
        hint = f" Did you mean {nearest[0]}?" if nearest else ""
        raise ValueError(f"{word} is not known.{hint} Allowed: what {prog} --help lists.")
    return [_values(group, getattr(parsed, name), layout) for group, name in zip(groups, names, strict=True)]


def _values(config: Any, parsed: Any, layout: Layout, prefix: str = "--") -> dict[str, Any]:
    """The values of a mirror of `config`, in the types of its fields.

    Raises:
        ValueError: text where a number belongs; names the flag.
    """
    found, hints = {}, typing.get_type_hints(type(config))
    for item in dataclasses.fields(config):
        value, text = getattr(config, item.name), getattr(parsed, item.name)
        name = f"{prefix}{item.name.replace('_', '-')}"
        if dataclasses.is_dataclass(value):
            found[item.name] = _values(value, text, layout, prefix if item.name in layout.unprefixed else f"{name}.")
        elif hints[item.name] in NUMBERS:
            found[item.name] = _number(name, text, hints[item.name])
        elif hints[item.name] == tuple[int, ...]:
            found[item.name] = tuple(_number(name, one, int) for word in text for one in word.split(","))
        else:
            found[item.name] = text
    return found


def _number(name: str, text: str, kind: Any) -> Any:
    try:
        return kind(text)
    except ValueError:
        raise ValueError(f"{name}={text!r} is not a number. Allowed: {NUMBERS[kind][1]}.") from None


def brief(groups: Sequence[Any], prog: str, description: str, layout: Layout, notes: str = "") -> str:
    """The help in one screen: the flags that are no part's own, and where the others are."""
    lines, parts = [f"usage: {prog} [--FLAG=VALUE ...]", "", description, ""], []
    for group in groups:
        documents = document(type(group))
        for item in dataclasses.fields(group):
            value = getattr(group, item.name)
            if dataclasses.is_dataclass(value):
                inner = dataclasses.fields(value) if item.name in layout.unprefixed else ()
                parts += [field.name for field in inner if field.name in layout.first] or [item.name]
                parts = [
                    f"{part}.*" if dataclasses.is_dataclass(getattr(value, part, None)) else part for part in parts
                ]
                continue
            shown = "" if value is None or value is False or value == () else f"={value}"
            head = f"  --{item.name.replace('_', '-')}{shown}".ljust(24)
            # The first sentence: `. ` and not `.`, which is in names of files.
            text = documents.get(item.name, "").partition(". ")[0].rstrip(".")
            own = textwrap.wrap(text, WIDTH - 26) or [""]
            lines += [f"{head}  {own[0]}", *(f"{'':26}{line}" for line in own[1:])]
    for name in ("env", "method"):
        names = ", ".join(layout.choices.get(name, ()))
        lines += ["", *textwrap.wrap(f"{name}: {names}", WIDTH, subsequent_indent="  ")]
    settings = ", ".join(f"--{name.replace('_', '-')}" for name in parts)
    text = f"Settings of the method, which --help=all describes one by one: {settings}"
    lines += ["", *textwrap.wrap(text, WIDTH, subsequent_indent="  ", break_on_hyphens=False)]
    return "\n".join([*lines, "", *textwrap.wrap(notes, WIDTH, subsequent_indent="  ")] if notes else lines)


def _check_words(argv: Sequence[str], kinds: Mapping[str, Any]) -> None:
    """Refuse in one line what tyro draws a box about, or takes apart."""
    for word, after in zip(argv, [*argv[1:], "--"], strict=True):
        flag, equals, value = word.partition("=")
        flag = flag.replace("_", "-")
        switch = re.sub(r"(^--|\.)no-", r"\1", flag)
        if equals and kinds.get(switch) is bool:
            negative = re.sub(r"\.([^.]*)$", r".no-\1", switch)
            allowed = switch if negative == switch else f"{switch} or {negative}"
            raise ValueError(f"{flag}={value!r} takes no value. Allowed: {allowed}.")
        takes_one = flag in kinds and kinds[flag] is not bool and get_origin(kinds[flag]) is not tuple
        if takes_one and not equals and after.startswith("--"):
            raise ValueError(f"{flag} lacks its value. Allowed: {flag}=VALUE.")


def _flags(config: Any, unprefixed: Sequence[str], prefix: str = "--") -> Iterator[tuple[str, Any]]:
    """The flags of a dataclass's fields, and their types."""
    hints = typing.get_type_hints(type(config))
    for item in dataclasses.fields(config):
        value, name = getattr(config, item.name), item.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _flags(value, unprefixed, prefix if item.name in unprefixed else f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", hints[item.name]


def _group(mirror: type) -> Any:
    return Annotated[mirror, tyro.conf.arg(name="")]


def _mirror(config: Any, layout: Layout, *, top: bool = False) -> type:
    """A dataclass with the fields of `config`, its values as defaults, and no checks."""
    documents, hints = document(type(config)), typing.get_type_hints(type(config))
    fields = []
    for item in sorted(
        dataclasses.fields(config), key=lambda item: bool(layout.first) and item.name not in layout.first
    ):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            # Only the fields of what has no prefix are sorted.
            inner = _mirror(value, layout if item.name in layout.unprefixed else layout._replace(first=()))
            fields.append((item.name, _group(inner) if item.name in layout.unprefixed else inner, inner()))
            continue
        hint, names = hints[item.name], layout.choices.get(item.name)
        if get_origin(hint) is Literal:
            # As text: the configuration's own check knows the nearest match.
            hint, names = str, get_args(hint)
        settings: dict[str, Any] = {"help": documents.get(item.name)}
        if names:
            settings["metavar"] = "{" + ",".join(names) + "}"
        if hint == str | None:
            hint, value = str, value or ""
            settings |= {"metavar": "PATH", "help_behavior_hint": ""}
        elif hint in NUMBERS:
            # As text, too: `parse` refuses it in one line, where tyro draws a box.
            settings["metavar"], hint, value = NUMBERS[hint][0], str, str(value)
        elif hint == tuple[int, ...]:
            settings["metavar"], hint, value = "INT,INT,...", tuple[str, ...], tuple(map(str, value))
        elif hint is bool and top:
            # Nobody asks for --no-version; a setting has both, whatever its default.
            hint = tyro.conf.FlagCreatePairsOff[bool]
            settings["help_behavior_hint"] = ""
        fields.append((item.name, Annotated[hint, tyro.conf.arg(**settings)], value))
    mirror = dataclasses.make_dataclass(type(config).__name__, fields, frozen=True)
    mirror.__doc__ = type(config).__doc__
    return mirror


@functools.cache
def document(config_type: type) -> dict[str, str]:
    """The docstrings below the fields of a dataclass, each on one line."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(config_type))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, below in zip(tree.body, tree.body[1:], strict=False):
        match field, below:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                found[name] = " ".join(text.split())
    return found
