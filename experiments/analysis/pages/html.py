"""A report as one HTML page that needs nothing else."""

import json
from html import escape
from typing import Any

import numpy as np

from experiments.analysis.pages import curves, floor, look, svg
from experiments.analysis.pages.contents import FloorVisits, Panel, Report, Section, Table, panel_names, slug
from experiments.analysis.pages.markdown import MARKS
from experiments.analysis.pages.numbers import finite, steps_scale, thin, values_scale

POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""The browser is told that the page loads nothing."""
LOG = " The axis of values is logarithmic: a band that would reach 0 ends at the bottom."
"""Said where it is so."""


def text(report: Report, refresh: float | None = None) -> str:
    """The whole page.

    Args:
        report: what it shows.
        refresh: seconds after which it loads itself again.
    """
    again = "" if refresh is None else f' data-refresh="{refresh:g}"'
    slow = "" if refresh is None else f'<noscript><meta http-equiv="refresh" content="{refresh:g}"></noscript>'
    notes = "".join(f"<li>{escape(note)}</li>" for note in report.notes)
    return "\n".join(
        (
            f'<!DOCTYPE html>\n<html lang="en"{again}>\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta name="color-scheme" content="light dark">{slow}',
            f"<title>{escape(report.title)}</title>\n<style>{look.STYLE}</style>\n</head>\n<body>",
            f'<header><h1>{escape(report.title)}</h1><p class="soft">{escape(report.made)}</p>',
            f"<ul>{notes}</ul>" if notes else "",
            "</header>",
            _contents(report),
            "<main>",
            *map(_section, report.sections),
            f"</main>\n<script>{look.SCRIPT}</script>\n</body>\n</html>\n",
        )
    )


def _contents(report: Report) -> str:
    lines = "".join(
        f'<li><a href="#{slug(one.name)}">{escape(one.title)}</a>'
        f'<span class="soft">{escape(one.source)}</span>{_verdict(one)}</li>'
        for one in report.sections
    )
    return f'<nav aria-label="Figures and verdicts"><h2>Figures</h2><ol>{lines}</ol></nav>'


def _verdict(section: Section) -> str:
    kind = section.verdict.replace(" ", "-")
    mark = MARKS[section.verdict]
    return f'<span class="verdict {kind}"><span aria-hidden="true">{mark}</span> {section.verdict}</span>'


def _reasons(section: Section) -> str:
    """What was asked, a line each: what must be so, whether it is, and why."""
    lines = "".join(
        f'<li><span class="{one.verdict.replace(" ", "-")}"><span aria-hidden="true">{MARKS[one.verdict]}</span> '
        f'{escape(one.text)}: {one.verdict}</span>, <span class="soft">{escape(one.why)}</span></li>'
        for one in section.reasons
    )
    return f'<ul class="reasons">{lines}</ul>' if lines else ""


def _section(section: Section) -> str:
    name = slug(section.name)
    panels = zip(section.panels, panel_names(section), strict=True)
    facts = "".join(f"<dt>{escape(fact)}</dt><dd>{escape(value)}</dd>" for fact, value in section.facts.items())
    command = f'<pre tabindex="0" aria-label="command"><code>{escape(section.command)}</code></pre>'
    return "\n".join(
        (
            f'<section id="{name}" aria-labelledby="{name}-title">',
            f'<h2 id="{name}-title">{escape(section.title)}</h2><p class="soft">{escape(section.source)}</p>',
            f'<dl class="claim"><dt>The paper</dt><dd>{escape(section.claim)}</dd>',
            f"<dt>Here</dt><dd>{_verdict(section)} {escape(section.explanation)}{_reasons(section)}</dd></dl>",
            '<div class="panels">',
            *(
                _floor(panel, f"p-{own}", own) if isinstance(panel, FloorVisits) else _curves(panel, f"p-{own}", own)
                for panel, own in panels
            ),
            "</div>",
            *map(_table, section.tables),
            f'<dl class="facts">{facts}</dl>' if facts else "",
            command if section.command else "",
            "</section>",
        )
    )


def _curves(panel: Panel, name: str, file: str) -> str:
    """A panel of curves: pictures, legend, numbers."""
    x, y = steps_scale(panel), values_scale(panel)
    thinned = [thin(one) for one in panel.series]
    lines = svg.lines_of(thinned)
    many = len(lines) > svg.MOST_IN_PICTURE
    frame = svg.SMALL if many else svg.WHOLE
    if many:
        shared = f"{name}-all"
        pictures = "".join(
            f'<div class="one"><p class="{svg.colour(line.number)}">{_key(line)}</p>'
            + _plot(
                svg.draw(panel, [line], f"{name}-{line.number}", shared, frame, x, y, f"{panel.title}: {line.label}")
            )
            + "</div>"
            for line in lines
        )
        drawn = f'{svg.faint(lines, shared, frame, x, y)}<div class="many">{pictures}</div>'
        below = f'<p class="soft">Grey: the means of the others. Below each picture: {escape(panel.steps_label)}.</p>'
    else:
        drawn = _plot(svg.draw(panel, lines, name, "", frame, x, y, panel.title))
        items = "".join(f'<li class="{svg.colour(line.number)}">{_key(line)}</li>' for line in lines)
        below = f'<ul class="legend">{items}</ul>'
    ceiling = "" if panel.ceiling is None else f"; dashed: the most there can be, {panel.ceiling:g}"
    data = {
        **svg.geometry(frame, x, y),
        "csv": file,
        "column": panel.column,
        "series": [
            {
                "label": one.label,
                "seeds": [int(seed) for seed in one.seeds],
                "steps": [int(s) if float(s).is_integer() else float(s) for s in np.asarray(one.steps).tolist()],
                "values": [[_rounded(value) for value in line] for line in finite(one.values).tolist()],
            }
            for one in thinned
        ],
    }
    return "\n".join(
        (
            f'<figure class="{"wide" if many else "curves"}" aria-labelledby="{name}-h">',
            f'<h3 id="{name}-h">{escape(panel.title)}</h3><p class="measure">{escape(panel.measure)}</p>',
            drawn,
            below,
            f'<p class="soft">{curves.BAND}{ceiling}.{LOG if y.log else ""}</p>',
            f'<p class="tools"><label><input type="checkbox" class="each"> each seed</label>{_files(file)}</p>',
            f'<p class="said" aria-live="polite"></p>{_data(data)}',
            _table(curves.table(panel)),
            "</figure>",
        )
    )


def _floor(panel: FloorVisits, name: str, file: str) -> str:
    """A panel of visits: picture, shades, numbers."""
    cells = floor.histogram(panel)
    levels = floor.limits(cells.counts)
    shades = "".join(
        f'<li><svg class="swatch" viewBox="0 0 12 12" aria-hidden="true"><path class="v{shade}" d="M0 0h12v12h-12z"/>'
        f"</svg>{low:,}{'+' if number == len(levels) else ''}</li>"
        for number, low in enumerate(levels, 1)
        for shade in (floor.shade_of(number, len(levels)),)
    )
    return "\n".join(
        (
            f'<figure class="floor" aria-labelledby="{name}-h"><h3 id="{name}-h">{escape(panel.title)}</h3>',
            f'<p class="measure">{floor.measure(panel, cells)}</p>',
            _plot(floor.draw(panel, name, cells)),
            f'<ul class="legend"><li>visits, from:</li>{shades}</ul>',
            f'<p class="tools">{_files(file)}</p><p class="said" aria-live="polite"></p>',
            _data({**floor.geometry(cells), "csv": file}),
            _table(floor.table(panel)),
            "</figure>",
        )
    )


def _key(line: svg.Line) -> str:
    """A sample of a line with its letter and name."""
    empty = "" if np.isfinite(line.summary.mean).any() else " (no values)"
    return (
        f'<svg class="sample" viewBox="0 0 22 8" aria-hidden="true"><path class="mean {svg.colour(line.number)}" '
        f'd="M1 4H21"/></svg><b>{svg.letter(line.number)}</b> <span>{escape(line.label)}{empty}</span>'
    )


def _plot(picture: str) -> str:
    return f'<div class="plot">{picture}<div class="box" hidden></div></div>'


def _files(file: str) -> str:
    """The CSV beside the page, and the one that the page makes of what it holds, for a page that was sent alone."""
    return (
        f'<a href="csv/{file}.csv" download>CSV, all digits</a>'
        '<button type="button" class="save" title="also where the page was sent alone">CSV from this page</button>'
    )


def _data(data: dict[str, Any]) -> str:
    """JSON that no text in it can end."""
    body = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json">{body}</script>'


def _rounded(value: float) -> float | int | None:
    if not np.isfinite(value):
        return None
    rounded = float(f"{value:.4g}")
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e15 else rounded


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in table.head)
    lines = "".join(
        f'<tr><th scope="row">{escape(line[0])}</th>{"".join(f"<td>{escape(one)}</td>" for one in line[1:])}</tr>'
        for line in table.lines
        if line
    )
    caption = f"<caption><span>{escape(table.caption)}</span></caption>" if table.caption else ""
    label = escape(table.caption or "table")
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{label}"><table>{caption}'
        f"<thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table></div>"
    )
