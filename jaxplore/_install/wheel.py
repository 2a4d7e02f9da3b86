"""What hatchling does beside packing files: the wheel has `envs/` and `experiments/` as `jaxplore.envs` and so on.

They are too generic as names of their own, so what imports or names them is renamed on the way. Nothing but the
standard library and hatchling is there when a wheel is built.
"""

import ast
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDERS = ("envs", "experiments")
LEFT_OUT = ("results",)
"""Folders in them that are of the repository."""
PTH, STARTUP = "jaxplore.pth", "_jaxplore_gymnasium.py"
AT_START = "import _jaxplore_gymnasium; _jaxplore_gymnasium.wait()\n"
"""What Python carries out when it starts."""

_NAMES = "|".join(FOLDERS)
_FROM = re.compile(rf"\Afrom\s+(?=(?:{_NAMES})\b)")
_TEXTS: tuple[tuple[re.Pattern[str], str], ...] = (
    (re.compile(rf"(?<![\w./-])(?=(?:{_NAMES})\.[\w{{])"), "jaxplore."),  # envs.base
    (re.compile(rf"(?<=\bimport )(?=(?:{_NAMES})\b(?!\.))"), "jaxplore."),  # import envs
    (re.compile(r"(?<=pip install )-e (\\?[\"'])\.(?=\[)"), r"\1jaxplore"),  # pip install -e ".[experiments]"
)
"""In texts: what to look for, and what to put there."""


class BuildHook(BuildHookInterface):
    """Called by hatchling around each build."""

    _drafts: Path | None = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add files to a wheel; an editable one gets only what Python reads at its start."""
        root, self._drafts = Path(self.root), Path(tempfile.mkdtemp())
        pth = self._drafts / PTH
        pth.write_text(AT_START)
        startup = {str(pth): PTH, str(root / "jaxplore/_install/startup.py"): STARTUP}
        if version == "editable":
            build_data["force_include_editable"].update(startup)
            return
        build_data["force_include"].update(startup)
        for path in sources(root):
            draft = self._drafts / path
            draft.parent.mkdir(parents=True, exist_ok=True)
            draft.write_text(rename((root / path).read_text(encoding="utf-8"), str(path)), encoding="utf-8")
            build_data["force_include"][str(draft)] = f"jaxplore/{path.as_posix()}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the drafts."""
        if self._drafts is not None:
            shutil.rmtree(self._drafts, ignore_errors=True)


def sources(root: Path) -> Iterator[Path]:
    """The Python files of the folders, as paths from `root`."""
    for folder in FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            own = path.relative_to(root)
            if not set(LEFT_OUT) & set(own.parts):
                yield own


def rename(source: str, name: str = "source") -> str:
    """Python code with `envs` and `experiments` as parts of `jaxplore`: imports, and texts that name modules.

    Args:
        source: the code.
        name: of its file, for messages.

    Returns:
        The code, as many lines; comments stay.

    Raises:
        ValueError: an import of a form that cannot be renamed.

    Example:
        >>> rename("from envs.base import EnvSpec")
        'from jaxplore.envs.base import EnvSpec'
    """
    lines = source.encode().splitlines(keepends=True)
    edits = [*_edits(ast.parse(source), name)]
    # From the last one to the first, so that places stay true.
    for node, change in sorted(edits, key=lambda edit: (edit[0].lineno, edit[0].col_offset), reverse=True):
        first, last = node.lineno - 1, (node.end_lineno or node.lineno) - 1
        before, after = lines[first][: node.col_offset], lines[last][node.end_col_offset :]
        own = b"".join(lines[first : last + 1])
        text = own[len(before) : len(own) - len(after)].decode()
        lines[first : last + 1] = (before + change(text).encode() + after).splitlines(keepends=True)
    return b"".join(lines).decode()


def _edits(tree: ast.AST, name: str) -> Iterator[tuple[Any, Callable[[str], str]]]:
    """The nodes of a tree that are written otherwise, and how."""
    for node in ast.iter_child_nodes(tree):
        match node:
            case ast.ImportFrom(module=str(module), level=0) if _is_ours(module):
                yield node, lambda text: _FROM.sub("from jaxplore.", text)
            case ast.Import(names=names) if any(_is_ours(alias.name) for alias in names):
                yield node, _rename_import(names, f"{name}, line {node.lineno}")
            case ast.Constant(value=str()):
                yield node, _rename_text
            case ast.JoinedStr():
                # Not its parts: their places are not known before Python 3.12.
                if any(isinstance(part, ast.Name) and part.id in FOLDERS for part in ast.walk(node)):
                    raise ValueError(f"{name}, line {node.lineno}: a module in an f-string. Allowed: outside of it.")
                yield node, _rename_text
            case _:
                yield from _edits(node, name)


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] in FOLDERS


def _rename_import(names: list[ast.alias], where: str) -> Callable[[str], str]:
    """How `import envs` and `import envs.base as base` are written."""
    (first, *others) = names
    if others or ("." in first.name and not first.asname):
        raise ValueError(f"{where}: this import cannot be renamed. Allowed: `import envs`, `from envs import base`.")
    renamed = f" as {first.asname}" if first.asname else ""
    new = f"import jaxplore.{first.name}" if renamed else f"from jaxplore import {first.name}"
    return lambda text: f"{new}{renamed}"


def _rename_text(text: str) -> str:
    for pattern, new in _TEXTS:
        text = pattern.sub(new, text)
    return text
