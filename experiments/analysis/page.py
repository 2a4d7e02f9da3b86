"""One report of many runs: a page to read, `index.html`; the same as Markdown, with pictures; every curve as CSV."""

from pathlib import Path

from experiments.analysis.pages import csv, html, markdown, picture
from experiments.analysis.pages.contents import (
    FloorVisits,
    Panel,
    Reason,
    Report,
    Section,
    Series,
    Table,
    Verdict,
    check,
    panel_names,
)
from experiments.runs.errors import disk_error
from experiments.runs.files import replacing

__all__ = ["FloorVisits", "Panel", "Reason", "Report", "Section", "Series", "Table", "Verdict", "write"]


def write(report: Report, out: Path, refresh: float | None = None) -> Path:
    """Writes `index.html`, `report.md`, `pictures/NAME.svg` and `csv/NAME.csv` in `out`, each replaced as a whole, the
    page last.

    The page needs no network and no other file: it shows and saves the values that it holds, at most 300 points of a
    curve with four digits. The CSV files, which it links to, have every point with all digits.

    Args:
        report: what to show.
        out: a directory, made where there is none.
        refresh: seconds after which an open page loads itself again, where it was scrolled to; None: never.

    Returns:
        The path of `index.html`.

    Raises:
        ValueError: the report cannot be drawn: see `contents.check`; or `refresh` is not above 0.
        RunError: a file cannot be written.
    """
    check(report)
    if refresh is not None and not refresh > 0:
        raise ValueError(f"refresh is {refresh}; must be above 0, in seconds, or None")
    page = out / "index.html"
    files: dict[Path, str] = {}
    for section in report.sections:
        for panel, name in zip(section.panels, panel_names(section), strict=True):
            files[out / "csv" / f"{name}.csv"] = csv.text(panel)
            files[out / "pictures" / f"{name}.svg"] = picture.text(panel)
    files |= {out / "report.md": markdown.text(report), page: html.text(report, refresh)}
    for path, text in files.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as draft:
                draft.write_text(text, encoding="utf-8", newline="\n")
        except OSError as error:
            raise disk_error("write the report", path, error) from error
    return page
