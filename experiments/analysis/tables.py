"""Numbers and tables as text: one number format, one printer for terminals, one for Markdown."""

from collections.abc import Iterable, Sequence


def number(value: float | None) -> str:
    """Two digits, or whole numbers from 100 on; `-` for what is not there."""
    # From 99.5 on two digits would be 1e+02.
    return "-" if value is None else f"{value:.2g}" if abs(value) < 99.5 else f"{value:,.0f}"


def duration(seconds: float) -> str:
    """A time in words, such as `"45 s"`, `"13 min 52 s"` or `"2 h 05 min"`."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 1:
        return f"{rest} s"
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def span(low: str, high: str, to: str = " to ") -> str:
    """A range; one end where both are the same."""
    return low if low == high else f"{low}{to}{high}"


def spans(numbers: Iterable[int]) -> str:
    """Whole numbers as ranges, such as `"20 to 24, 27"`."""
    found: list[list[int]] = []
    for number in sorted(set(numbers)):
        if found and found[-1][1] == number - 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return ", ".join(span(str(low), str(high)) for low, high in found)


def text_table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Right-aligned columns with a rule below their names, as plain text."""
    widths = [max(map(len, column)) for column in zip(head, *lines, strict=True)]
    text = ["   ".join(map(str.rjust, line, widths)) for line in (head, *lines)]
    return "\n".join((text[0], "-" * len(text[0]), *text[1:]))


def markdown_table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines))
