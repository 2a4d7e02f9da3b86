"""What a report holds, as records."""

from typing import Literal, NamedTuple, get_args

import numpy as np

from envs.base import FloorPlan

Verdict = Literal["holds", "does not hold", "undecided", "not run", "not asked"]
"""`undecided`: conditions were asked, and so few seeds do not tell; `not asked`: there are none."""


class Series(NamedTuple):
    """One method's curves, a line for each seed."""

    label: str
    steps: np.ndarray
    """`[T]`, increasing."""
    values: np.ndarray
    """`[S, T]`; NaN where a seed has none."""
    seeds: tuple[int, ...]


class Panel(NamedTuple):
    """Curves that share their axes."""

    title: str
    measure: str
    """What the values are, with the unit."""
    series: list[Series]
    steps_label: str = "environment steps"
    ceiling: float | None = None
    """What the values cannot exceed, drawn as a line."""

    @property
    def column(self) -> str:
        """What the CSV calls the steps."""
        return "step" if self.steps_label == "environment steps" else slug(self.steps_label)


class FloorVisits(NamedTuple):
    """Where agents have been, seen from above."""

    title: str
    positions: np.ndarray
    """`[N, 2]`, metres."""
    seeds: np.ndarray
    """`[N]`"""
    floor: FloorPlan


class Table(NamedTuple):
    """Lines as long as their head."""

    head: tuple[str, ...]
    lines: list[tuple[str, ...]]
    caption: str = ""


class Reason(NamedTuple):
    """Something that was asked of a claim."""

    text: str
    """What must be so."""
    verdict: Verdict
    why: str

    def __str__(self) -> str:
        """All of it in a line."""
        return f"{self.text}: {self.verdict} ({self.why})"


class Section(NamedTuple):
    """A figure or a table of the paper, beside what became of it here."""

    name: str
    """Short; links and CSV files are called by it."""
    title: str
    source: str
    claim: str
    verdict: Verdict
    explanation: str
    command: str
    panels: list[Panel | FloorVisits]
    tables: list[Table]
    facts: dict[str, str]
    """What to know of the runs: seeds, steps, wall time, hardware, versions."""
    reasons: tuple[Reason, ...] = ()
    """Of the verdict, a line each, below the explanation."""


class Report(NamedTuple):
    """The whole page."""

    title: str
    sections: list[Section]
    made: str
    """When and from what it was made."""
    notes: list[str] = []  # noqa: RUF012 - nobody adds to it


def slug(name: str) -> str:
    """A name as it can stand in a link and in a file name: lower case letters, digits, `-` and `_`."""
    kept = "".join(one if one.isascii() and (one.isalnum() or one == "_") else "-" for one in name.lower())
    return "-".join(part for part in kept.split("-") if part)


def panel_names(section: Section) -> list[str]:
    """What the panels of a section are called in links and files: as the section, numbered where there are several."""
    name = slug(section.name)
    if len(section.panels) == 1:
        return [name]
    return [f"{name}-{number}" for number in range(1, len(section.panels) + 1)]


def check(report: Report) -> None:
    """Refuse a report that cannot be drawn.

    Raises:
        ValueError: names are empty or come twice, shapes do not match, a table's line is not as long as its head, or
            there is no such verdict.
    """
    names: list[str] = []
    for section in report.sections:
        where = f"section {section.name!r}"
        if not slug(section.name):
            raise ValueError(f"{where}: its name must have a letter or a digit")
        if section.verdict not in get_args(Verdict):
            raise ValueError(f"{where}: verdict is {section.verdict!r}; must be one of {', '.join(get_args(Verdict))}")
        names += dict.fromkeys([slug(section.name), *panel_names(section)])
        for panel in section.panels:
            _check_floor(where, panel) if isinstance(panel, FloorVisits) else _check_curves(where, panel)
        for table in section.tables:
            if any(len(line) != len(table.head) for line in table.lines):
                raise ValueError(f"{where}, table {table.caption!r}: every line must have {len(table.head)} entries")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"sections: {', '.join(twice)} comes twice; names must differ in letters, digits or _")


def _check_curves(where: str, panel: Panel) -> None:
    for one in panel.series:
        steps, values = np.shape(one.steps), np.shape(one.values)
        if len(steps) != 1 or values != (len(one.seeds), *steps):
            raise ValueError(
                f"{where}, panel {panel.title!r}, {one.label!r}: steps {steps} and values {values} must be [T] and "
                f"[S, T], for S = {len(one.seeds)} seeds"
            )


def _check_floor(where: str, panel: FloorVisits) -> None:
    positions, seeds = np.shape(panel.positions), np.shape(panel.seeds)
    if len(seeds) != 1 or positions != (*seeds, 2):
        raise ValueError(
            f"{where}, panel {panel.title!r}: positions {positions} and seeds {seeds} must be [N, 2] and [N]"
        )
    if not panel.floor.cells:
        raise ValueError(f"{where}, panel {panel.title!r}: its floor has no cells")
