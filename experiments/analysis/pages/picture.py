"""A panel as an SVG file of its own, for pages that show pictures and run no scripts, such as a repository's."""

import math
from html import escape

from experiments.analysis.pages import floor, look, svg
from experiments.analysis.pages.contents import FloorVisits, Panel
from experiments.analysis.pages.numbers import short, steps_scale, thin, values_scale

ROW = 14
"""Height of a line of text."""
WIDEST = 720
"""Of small pictures side by side, where each series has its own."""
LETTER = 6
"""Width of a letter, about."""
STYLE = f"{look.COLOURS}{look.PICTURES}text{{font-family:system-ui,sans-serif}}svg .paper{{fill:var(--paper)}}"


def text(panel: Panel | FloorVisits) -> str:
    """The file: colours follow the reader's choice of light or dark, as on the page."""
    return _visits(panel) if isinstance(panel, FloorVisits) else _curves(panel)


def _curves(panel: Panel) -> str:
    x, y = steps_scale(panel), values_scale(panel)
    lines = svg.lines_of([thin(one) for one in panel.series])
    if len(lines) <= svg.MOST_IN_PICTURE:
        frame = svg.WHOLE
        drawn = svg.draw(panel, lines, "p", "", frame, x, y, panel.title)
        keys = "".join(_key(line, 36, 2 * ROW + frame.height + i * ROW) for i, line in enumerate(lines))
        return _file(frame.width, ROW * (len(lines) + 2) + frame.height, panel.measure, [_at(0, ROW, drawn), keys])
    frame = svg.SMALL
    step = max(frame.width, 40 + LETTER * max(len(line.label) for line in lines))
    columns = max(1, WIDEST // step)
    parts = [svg.faint(lines, "all", frame, x, y)]
    for i, line in enumerate(lines):
        left, top = i % columns * step, ROW + i // columns * (frame.height + ROW)
        drawn = svg.draw(panel, [line], f"p-{i}", "all", frame, x, y, f"{panel.title}: {line.label}")
        parts += [_key(line, left + 4, top + ROW - 3), _at(left, top + ROW, drawn)]
    height = ROW * 2 + math.ceil(len(lines) / columns) * (frame.height + ROW)
    parts.append(_text(4, height - 4, f"grey: the means of the others; below each picture {panel.steps_label}"))
    return _file(columns * step, height, panel.measure, parts)


def _visits(panel: FloorVisits) -> str:
    cells = floor.histogram(panel)
    drawn = floor.draw(panel, "p", cells)
    width, height = _size(drawn)
    levels = floor.limits(cells.counts)
    parts, left = [_at(0, ROW, drawn)], 32.0
    for number, low in enumerate(levels, 1):
        said, at = short(low) + ("+" if number == len(levels) else ""), ROW + height
        parts.append(f'<path class="v{floor.shade_of(number, len(levels))}" d="M{left:g} {at + 2:g}h10v10h-10z"/>')
        parts.append(_text(left + 14, at + 11, said))
        left += 26 + LETTER * len(said)
    return _file(width, height + 2 * ROW + 4, floor.measure(panel, cells), parts)


def _file(width: float, height: float, said: str, parts: list[str]) -> str:
    # Twice the size of the drawing's units, as text of 11 units is small print.
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{2 * width:g}" height="{2 * height:g}" '
        f'viewBox="0 0 {width:g} {height:g}">'
        f'<style>{STYLE}</style><path class="paper" d="M0 0H{width:g}V{height:g}H0Z"/>'
        f"{_text(4, 10, said)}{''.join(parts)}</svg>\n"
    )


def _at(x: float, y: float, drawn: str) -> str:
    """A drawing at a place within another."""
    width, height = _size(drawn)
    return drawn.replace("<svg ", f'<svg x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" ', 1)


def _size(drawn: str) -> tuple[float, float]:
    width, height = drawn.split('viewBox="0 0 ', 1)[1].split('"', 1)[0].split()
    return float(width), float(height)


def _key(line: svg.Line, x: float, y: float) -> str:
    colour = svg.colour(line.number)
    return (
        f'<path class="mean {colour}" d="M{x:g} {y - 4:g}h18"/><text class="key {colour}" x="{x + 22:g}" y="{y:g}">'
        f"{svg.letter(line.number)}</text>{_text(x + 36, y, line.label)}"
    )


def _text(x: float, y: float, said: str) -> str:
    return f'<text x="{x:g}" y="{y:g}">{escape(said)}</text>'
