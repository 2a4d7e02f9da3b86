"""A report as files: a bare page until its author's is here."""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from envs.base import FloorPlan
from experiments.analysis.tables import markdown_table
from experiments.runs.files import write_text

Verdict = Literal["holds", "does not hold", "undecided", "not run"]


class Series(NamedTuple):
    """A number over steps, of several seeds."""

    label: str
    steps: np.ndarray
    """`[T]`"""
    values: np.ndarray
    """`[S, T]`"""
    seeds: tuple[int, ...]


class Panel(NamedTuple):
    """Series in one picture."""

    title: str
    measure: str
    """The axis's label, with its unit."""
    series: list[Series]
    steps_label: str = "environment steps"
    ceiling: float | None = None


class FloorVisits(NamedTuple):
    """Where several seeds have been."""

    title: str
    positions: np.ndarray
    """`[N, 2]` [m]"""
    seeds: np.ndarray
    """`[N]`"""
    floor: FloorPlan


class Table(NamedTuple):
    """A table of text."""

    head: tuple[str, ...]
    lines: list[tuple[str, ...]]
    caption: str = ""


class Section(NamedTuple):
    """One figure of the paper, and what became of its claim."""

    name: str
    title: str
    source: str
    claim: str
    verdict: Verdict
    explanation: str
    command: str
    panels: list[Panel | FloorVisits]
    tables: list[Table]
    facts: dict[str, str]


class Report(NamedTuple):
    """A title and sections."""

    title: str
    sections: list[Section]
    made: str
    notes: list[str] = []  # noqa: RUF012  (of a named tuple, and nobody writes to it)


def write(report: Report, out: Path, refresh: float | None = None) -> Path:
    """Write `index.html` and `report.md` to `out`, and give the path of `index.html`."""
    out.mkdir(parents=True, exist_ok=True)
    text = [f"# {report.title}", report.made, *report.notes]
    for one in report.sections:
        text += [f"## {one.title} ({one.source})", one.claim, f"**{one.verdict}**: {one.explanation}", one.command]
        text += [f"{table.caption}\n\n{markdown_table(table.head, table.lines)}" for table in one.tables]
        text += [f"{name}: {value}" for name, value in one.facts.items()]
    write_text(out / "report.md", "\n\n".join(text) + "\n")
    again = "" if refresh is None else f'<meta http-equiv="refresh" content="{refresh:g}">'
    write_text(out / "index.html", f"<!doctype html>{again}<pre>{'<br>'.join(text)}</pre>\n")
    return out / "index.html"
