"""A report as Markdown, for a repository's page: the same words and tables, and pictures that only show."""

import re

from experiments.analysis.pages import curves, floor
from experiments.analysis.pages.contents import FloorVisits, Report, Section, Table, panel_names, slug
from experiments.analysis.tables import markdown_table

MARKS = {"holds": "✓", "does not hold": "✗", "undecided": "?", "not run": "o", "not asked": "-"}
"""In front of each verdict, so that colour is not needed."""


def text(report: Report) -> str:
    """The whole report."""
    parts = [f"# {plain(report.title)}", plain(report.made), *(f"- {plain(note)}" for note in report.notes)]
    parts.append("To read values off, with every seed's curve: [index.html](index.html).")
    lines = [
        (f"[{plain(one.title)}](#{slug(one.name)})", plain(one.source), f"{MARKS[one.verdict]} {one.verdict}")
        for one in report.sections
    ]
    parts.append(markdown_table(("figure", "source", "verdict"), lines))
    return "\n\n".join([*parts, *map(_section, report.sections)]) + "\n"


def plain(words: str) -> str:
    """Words as they are, on one line, whatever signs of Markdown or HTML are in them."""
    return re.sub(r"([\\`*_{}\[\]<>()#+!|~&$])", r"\\\1", " ".join(words.split()))


def fenced(code: str) -> str:
    """Code as it is; the fence is longer than any in it."""
    fence = "`" * max(3, *(len(run) + 1 for run in re.findall(r"`+", code)), 3)
    return f"{fence}\n{code}\n{fence}"


def _section(section: Section) -> str:
    parts = [
        f'<a id="{slug(section.name)}"></a>\n\n## {plain(section.title)}',
        f"{plain(section.source)}. The paper: {plain(section.claim)}",
        f"**{MARKS[section.verdict]} {section.verdict}.** {plain(section.explanation)}".rstrip(),
    ]
    if section.reasons:
        parts.append("\n".join(f"- {MARKS[one.verdict]} {plain(str(one))}" for one in section.reasons))
    for panel, name in zip(section.panels, panel_names(section), strict=True):
        own = floor.table(panel) if isinstance(panel, FloorVisits) else curves.table(panel)
        parts += [f"### {plain(panel.title)}", f"![{plain(panel.title)}](pictures/{name}.svg)", _table(own)]
        parts.append(f"[All of it as CSV](csv/{name}.csv)")
    parts += map(_table, section.tables)
    if section.facts:
        parts.append("\n".join(f"- {plain(name)}: {plain(value)}" for name, value in section.facts.items()))
    if section.command:
        parts.append(fenced(section.command))
    return "\n\n".join(parts)


def _table(table: Table) -> str:
    caption = f"{plain(table.caption)}\n\n" if table.caption else ""
    return caption + markdown_table([*map(plain, table.head)], [[*map(plain, line)] for line in table.lines])
