"""Curves as SVG in the page's colours. Scripts read the same geometry from `geometry`."""

from html import escape
from typing import Any, NamedTuple

import numpy as np

from experiments.analysis.pages.contents import Panel, Series
from experiments.analysis.pages.numbers import Scale, Summary, short, step_name, summary, ticks

COLOURS = 7
"""The page's `--c0` to `--c6`; further series have them again, dashed."""

MOST_IN_PICTURE = 7
"""So many series share a picture; of more each gets its own, with the others in grey."""


class Frame(NamedTuple):
    """A picture's size, and the box in it that values are drawn in."""

    width: int
    height: int
    left: int
    top: int
    right: int
    bottom: int


WHOLE = Frame(360, 230, 40, 8, 340, 196)
"""All series in one picture."""
SMALL = Frame(180, 122, 32, 6, 166, 104)
"""A series of many."""


class Line(NamedTuple):
    """A series that is drawn."""

    number: int
    label: str
    steps: np.ndarray
    summary: Summary


def lines_of(series: list[Series]) -> list[Line]:
    """Each series with its mean and spread over seeds, in their order."""
    return [Line(i, one.label, one.steps, summary(one.values)) for i, one in enumerate(series)]


def letter(index: int) -> str:
    """What a curve's end and its legend share: A to Z, then A1, B1 and so on."""
    return chr(ord("A") + index % 26) + (str(index // 26) if index >= 26 else "")


def colour(index: int) -> str:
    """The classes of a series."""
    return f"c{index % COLOURS}" + (" dash" if index // COLOURS % 2 else "")


def coordinates(frame: Frame, x: Scale, y: Scale, steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Points `[T, 2]` in the picture; NaN where there is no value."""
    across = frame.left + x.at(np.asarray(steps, float)) * (frame.right - frame.left)
    up = frame.bottom - y.at(values) * (frame.bottom - frame.top)
    return np.stack([across, up], axis=1)


def path(points: np.ndarray) -> str:
    """A line through points `[T, 2]`, with a gap where one is NaN; a point alone becomes a dot."""
    return "".join(f"M{_pairs(run)}" + ("h0" if len(run) == 1 else "") for run in _runs(points, _known(points)))


def ribbon(low: np.ndarray, high: np.ndarray) -> str:
    """The area between two lines of the same steps, `[T, 2]` each, where both are known."""
    known = _known(low) & _known(high)
    halves = zip(_runs(low, known), _runs(high, known), strict=True)
    return "".join(f"M{_pairs(upper)}L{_pairs(lower[::-1])}Z" for lower, upper in halves if len(lower) > 1)


def draw(panel: Panel, lines: list[Line], name: str, shared: str, frame: Frame, x: Scale, y: Scale, title: str) -> str:
    """One picture: axes, bands, means, and letters at the ends of the lines.

    Args:
        panel: whose ceiling and names of axes are drawn.
        lines: those of this picture.
        name: of the picture, for ids.
        shared: id of something to draw faintly below them, or "".
        frame: its size.
        x: of the steps.
        y: of the values.
        title: what a screen reader says first.
    """
    clip = f"{name}-clip"
    width, height = frame.right - frame.left, frame.bottom - frame.top
    known = [line for line in lines if np.isfinite(line.summary.mean).any()]
    bands = "".join(_band(line, frame, x, y) for line in known)
    means = "".join(
        f'<path class="mean {colour(line.number)}" data-series="{line.number}" '
        f'd="{path(coordinates(frame, x, y, line.steps, line.summary.mean))}"/>'
        for line in known
    )
    parts = [
        f'<svg viewBox="0 0 {frame.width} {frame.height}" role="img" tabindex="0" '
        f'aria-labelledby="{name}-t {name}-d" data-series="{" ".join(str(line.number) for line in lines)}">',
        f'<title id="{name}-t">{escape(title)}</title>',
        f'<desc id="{name}-d">{escape(described(panel, lines))}</desc>',
        f'<clipPath id="{clip}"><rect x="{frame.left}" y="{frame.top - 1}" width="{width + 1}" '
        f'height="{height + 2}"/></clipPath>',
        _axes(panel, frame, x, y),
        f'<g clip-path="url(#{clip})">',
        f'<use href="#{shared}"/>' if shared else "",
        bands,
        '<g class="seeds"></g>',
        means,
        '</g><g class="live"></g>',
        _letters(known, frame, x, y),
        "" if known else f'<text class="none" x="{frame.left + width / 2:g}" y="{height / 2:g}">no values</text>',
        "</svg>",
    ]
    return "".join(parts)


def faint(lines: list[Line], name: str, frame: Frame, x: Scale, y: Scale) -> str:
    """Definitions of the means of all series in grey, as `draw` takes them for `shared`."""
    drawn = "".join(path(coordinates(frame, x, y, line.steps, line.summary.mean)) for line in lines)
    return f'<svg class="defs" aria-hidden="true"><defs><path class="others" id="{name}" d="{drawn}"/></defs></svg>'


def described(panel: Panel, lines: list[Line]) -> str:
    """A picture in words: where each curve ends."""
    said = []
    for line in lines:
        known = np.flatnonzero(np.isfinite(line.summary.mean))
        if not len(known):
            said.append(f"{line.label}: no values")
            continue
        end = known[-1]
        mean, spread = float(line.summary.mean[end]), float(line.summary.spread[end])
        more = f" plus or minus {short(spread, 2)}" if np.isfinite(spread) else ""
        said.append(f"{line.label}: {short(mean)}{more} at {line.steps[end]:,.0f}")
    return f"{panel.measure} over {panel.steps_label}, mean of the seeds. " + "; ".join(said)


def geometry(frame: Frame, x: Scale, y: Scale) -> dict[str, Any]:
    """What a script needs to find points in a picture."""
    return {"box": list(frame), "x": list(x), "y": list(y)}


def _axes(panel: Panel, frame: Frame, x: Scale, y: Scale) -> str:
    """Lines and numbers at round values; the ceiling dashed."""
    small = frame.width < WHOLE.width
    parts = []
    for tick in ticks(y, 3 if small else 5):
        up = _number(frame.bottom - float(y.at(np.array(tick))) * (frame.bottom - frame.top))
        parts.append(f'<path class="grid" d="M{frame.left} {up}H{frame.right}"/>')
        parts.append(f'<text class="y" x="{frame.left - 4}" y="{up}" dy=".32em">{escape(_tick(tick))}</text>')
    for tick in ticks(x, 2 if small else 4):
        across = _number(frame.left + float(x.at(np.array(tick))) * (frame.right - frame.left))
        parts.append(f'<path class="tick" d="M{across} {frame.bottom}v3"/>')
        # The last number would stick out of a small picture.
        place = (
            f'class="x last" x="{frame.width}"'
            if small and float(across) > frame.right - 10
            else f'class="x" x="{across}"'
        )
        parts.append(f'<text {place} y="{frame.bottom + 14}">{escape(step_name(tick))}</text>')
    parts.append(f'<path class="axis" d="M{frame.left} {frame.bottom}H{frame.right}"/>')
    if panel.ceiling is not None:
        up = _number(frame.bottom - float(y.at(np.array(panel.ceiling))) * (frame.bottom - frame.top))
        parts.append(f'<path class="ceiling" d="M{frame.left} {up}H{frame.right}"/>')
    if not small:
        middle = (frame.left + frame.right) / 2
        parts.append(f'<text class="x" x="{middle:g}" y="{frame.height - 4}">{escape(panel.steps_label)}</text>')
    return "".join(parts)


def _band(line: Line, frame: Frame, x: Scale, y: Scale) -> str:
    mean, spread = line.summary.mean, line.summary.spread
    low = mean - spread
    if y.log:
        low = np.where(low > y.low, low, np.where(np.isfinite(low), y.low, np.nan))
    edges = (coordinates(frame, x, y, line.steps, edge) for edge in (low, mean + spread))
    drawn = ribbon(*edges)
    return f'<path class="band {colour(line.number)}" d="{drawn}"/>' if drawn else ""


def _letters(lines: list[Line], frame: Frame, x: Scale, y: Scale) -> str:
    """A letter at the end of each line, moved so that none lies on another."""
    if len(lines) < 2:
        return ""
    ends = []
    for line in lines:
        points = coordinates(frame, x, y, line.steps, line.summary.mean)
        points = points[_known(points)]
        if len(points):
            ends.append((float(points[-1, 1]), float(points[-1, 0]), line))
    ends.sort(key=lambda end: end[0])
    gap, heights = 12.0, []
    for up, _, _ in ends:
        heights.append(max(up, heights[-1] + gap if heights else frame.top + 2.0))
    over = max(0.0, heights[-1] - frame.bottom) if heights else 0.0
    for i in reversed(range(len(heights))):
        limit = frame.bottom - gap * (len(heights) - 1 - i)
        heights[i] = min(heights[i], limit) if over else heights[i]
    return "".join(
        f'<text class="key {colour(line.number)}" x="{_number(across + 4)}" y="{_number(height)}" dy=".32em">'
        f"{letter(line.number)}</text>"
        for height, (_, across, line) in zip(heights, ends, strict=True)
    )


def _tick(value: float) -> str:
    return step_name(value) if abs(value) >= 1e4 else f"{value:.4g}"


def _known(points: np.ndarray) -> np.ndarray:
    """Which of points `[T, 2]` have a place, `[T]`."""
    return np.isfinite(points[:, 0]) & np.isfinite(points[:, 1])


def _runs(points: np.ndarray, known: np.ndarray) -> list[np.ndarray]:
    """The parts of points `[T, 2]` without a gap."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    return [points[start:end] for start, end in zip(edges[::2], edges[1::2], strict=True)]


def _pairs(points: np.ndarray) -> str:
    return " ".join(f"{_number(x)} {_number(y)}" for x, y in points.tolist())


def _number(value: float) -> str:
    """One digit behind the point, none where it is 0."""
    text = f"{value:.1f}"
    return text.removesuffix(".0")
