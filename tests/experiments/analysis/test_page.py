"""The report page: files, well-formed HTML that needs nothing else, numbers that are the data, and a real browser."""

import csv
import io
import json
import math
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from envs.base import FloorPlan
from experiments.analysis import page
from experiments.analysis.pages import look, svg
from experiments.runs.errors import RunError

HOSTILE = "</script><script>alert('x')</script>|`*&\"x"
VOID = {"meta", "input", "br"}
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)

STEPS = np.arange(100, 1100, 100)
VALUES = np.array([np.linspace(0.1, 1.0, 10), np.linspace(0.0, 0.5, 10), np.linspace(0.2, 0.6, 10)])


def series(label: str = "implicit", values: np.ndarray = VALUES, steps: np.ndarray = STEPS) -> page.Series:
    return page.Series(label, steps, values, tuple(range(len(values))))


def section(name: str = "figure_5", **changes) -> page.Section:
    plan = FloorPlan(
        (0, 1), ((0.0, 2.0, 1.0, 4.0),), ((0.0, 0.0, 2.0, 2.0), (2.0, 0.0, 4.0, 2.0), (2.0, 2.0, 4.0, 4.0))
    )
    positions = np.array([[0.5, 0.5], [0.5, 0.5], [2.5, 1.0], [np.nan, 1.0], [99.0, 0.0]])
    panels = [
        page.Panel("Coverage", "share", [series(), series("random", VALUES / 2)], ceiling=1.0),
        page.FloorVisits("Where it was", positions, np.array([3, 4, 4, 3, 3]), plan),
    ]
    tables = [page.Table(("method", "cells"), [("implicit", "7")], "Outcomes")]
    facts = {"seeds": "0 to 2"}
    one = page.Section(name, "Maze", "Figure 5", "It is ahead.", "holds", "It is.", "run it", panels, tables, facts)
    return one._replace(**changes)


def report(*sections: page.Section) -> page.Report:
    return page.Report("A report", list(sections) or [section()], "made today", ["a note"])


class Reader(HTMLParser):
    """Elements in their order, as `(name, attributes, text)`; unclosed and wrongly closed ones are remembered."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None], list[str]]] = []
        self.texts: list[list[str]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs), []))
        if tag not in VOID:
            self.open.append(tag)
            self.texts.append(self.elements[-1][2])

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs), []))

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)
        else:
            self.texts.pop()

    def handle_data(self, data):
        for text in self.texts:
            text.append(data)

    def all(self, tag: str) -> list[tuple[dict[str, str | None], str]]:
        return [(attributes, "".join(text)) for name, attributes, text in self.elements if name == tag]


def read(out: Path, made: page.Report, **options) -> Reader:
    return Reader(page.write(made, out, **options).read_text(encoding="utf-8"))


def points(path: str) -> list[tuple[float, float]]:
    numbers = [float(one) for one in re.findall(r"-?[\d.]+", path)]
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def test_it_writes_a_page_markdown_and_csv_and_leaves_no_drafts(tmp_path: Path):
    path = page.write(report(), tmp_path / "new" / "report")
    assert path == tmp_path / "new" / "report" / "index.html"
    names = sorted(one.relative_to(path.parent).as_posix() for one in path.parent.rglob("*") if one.is_file())
    pictures = ["pictures/figure_5-1.svg", "pictures/figure_5-2.svg"]
    assert names == ["csv/figure_5-1.csv", "csv/figure_5-2.csv", "index.html", *pictures, "report.md"]


def test_it_is_well_formed_and_needs_nothing_else(tmp_path: Path):
    reader = read(tmp_path, report(section(), section("figure 6", verdict="not run")))
    assert reader.wrong == []
    assert reader.open == []
    ids = [attributes["id"] for _, attributes, _ in reader.elements if "id" in attributes]
    assert len(ids) > 10
    assert len(set(ids)) == len(ids)
    links = [
        value or ""
        for _, attributes, _ in reader.elements
        for key, value in attributes.items()
        if key in ("href", "src", "action", "srcset")
    ]
    for link in links:
        assert link[1:] in ids if link.startswith("#") else (tmp_path / link).is_file(), link
    named = [
        name
        for _, attributes, _ in reader.elements
        for key in ("aria-labelledby", "aria-describedby")
        for name in (attributes.get(key) or "").split()
    ]
    assert named
    assert set(named) <= set(ids)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert re.findall(r"(?:https?:)?//[a-z]", text.replace("http://www.w3.org/2000/svg", "")) == []
    assert "@import" not in text


def test_pictures_and_tables_say_what_they_are(tmp_path: Path):
    reader = read(tmp_path, report())
    pictures = [attributes for attributes, _ in reader.all("svg") if attributes.get("role") == "img"]
    assert len(pictures) == 2
    assert all(attributes["tabindex"] == "0" and attributes["aria-labelledby"] for attributes in pictures)
    assert len(reader.all("title")) == 3  # The page has one, too.
    described = [text for _, text in reader.all("desc")]
    assert "implicit: 0.7 plus or minus 0.26 at 1,000" in described[0]
    heads = [attributes.get("scope") for attributes, _ in reader.all("th")]
    assert set(heads) == {"col", "row"}
    assert len(reader.all("table")) == len(reader.all("thead")) == 3


def test_curves_are_the_means_of_the_data(tmp_path: Path):
    reader = read(tmp_path, report())
    data = json.loads(next(text for attributes, text in reader.all("script") if attributes.get("type")))
    _, _, left, top, right, bottom = data["box"]
    (drawn,) = [at["d"] for at, _ in reader.all("path") if at.get("data-series") == "0"]
    line = points(drawn or "")
    assert len(line) == 10
    low, high, log = data["y"]
    assert (low, log) == (0.0, False)
    assert high >= 1.0
    for t in (0, 4, 9):
        across, up = line[t]
        assert (across - left) / (right - left) * 1000 == pytest.approx(STEPS[t], abs=0.5)
        assert (bottom - up) / (bottom - top) * high == pytest.approx(VALUES[:, t].mean(), abs=0.001)
    (band,) = [at["d"] for at, _ in reader.all("path") if at.get("class") == "band c0"]
    edge = points((band or "").replace("Z", ""))
    assert len(edge) == 20
    expected = VALUES[:, 9].mean() + VALUES[:, 9].std(ddof=1)
    assert (bottom - edge[9][1]) / (bottom - top) * high == pytest.approx(expected, abs=0.001)
    assert data["series"][0]["values"][1] == pytest.approx(VALUES[1], abs=1e-4)


def test_the_table_below_has_means_and_spreads(tmp_path: Path):
    reader = read(tmp_path, report())
    cells = [text for _, text in reader.all("td")]
    # A quarter is step 250: the value of step 200 holds.
    assert cells[:2] == ["3", f"{VALUES[:, 1].mean():.3g} ± {VALUES[:, 1].std(ddof=1):.2g}"]


def test_gaps_are_gaps_and_series_without_values_are_named(tmp_path: Path):
    values = VALUES.copy()
    values[1:, 6:] = np.nan
    values[:, 3] = [np.nan, np.inf, -np.inf]
    empty = page.Series("nothing", np.array([]), np.empty((0, 0)), ())
    lines = [series("gaps", values), series("never", np.full((2, 10), np.nan)), empty]
    reader = read(tmp_path, report(section(panels=[page.Panel("p", "m", lines)])))
    (drawn,) = [at["d"] or "" for at, _ in reader.all("path") if at.get("data-series")]
    assert [len(points(part)) for part in drawn.split("M")[1:]] == [3, 6]
    (band,) = [at["d"] or "" for at, _ in reader.all("path") if (at.get("class") or "").startswith("band")]
    # From step 700 on one seed is left, which has no spread.
    assert [len(points(part.rstrip("Z"))) for part in band.split("M")[1:]] == [6, 4]
    assert "NaN" not in (tmp_path / "index.html").read_text(encoding="utf-8").split("<script>")[0]
    assert "never (no values)" in "".join(text for _, text in reader.all("li"))
    assert (tmp_path / "report.md").read_text(encoding="utf-8").count(r"\(n = 1\)") == 2


def test_nothing_to_draw_is_said(tmp_path: Path):
    reader = read(tmp_path, report(section(panels=[page.Panel("p", "m", []), page.Panel("q", "m", [], ceiling=2.0)])))
    assert [text for at, text in reader.all("text") if at.get("class") == "none"] == ["no values"] * 2


def test_many_series_get_a_picture_each(tmp_path: Path):
    lines = [series(f"method {i}", VALUES * i) for i in range(22)]
    reader = read(tmp_path, report(section(panels=[page.Panel("p", "m", lines)])))
    shown = [at["data-series"] for at, _ in reader.all("svg") if at.get("role") == "img"]
    assert shown == [str(i) for i in range(22)]
    (shared,) = [at["id"] for at, _ in reader.all("path") if at.get("class") == "others"]
    assert [at["href"] for at, _ in reader.all("use")] == [f"#{shared}"] * 22
    assert len({svg.letter(i) for i in range(60)}) == 60


def test_letters_at_the_ends_do_not_lie_on_one_another(tmp_path: Path):
    lines = [series(f"method {i}", VALUES + 1e-3 * i) for i in range(7)]
    reader = read(tmp_path, report(section(panels=[page.Panel("p", "m", lines)])))
    heights = [float(at["y"] or "nan") for at, _ in reader.all("text") if (at.get("class") or "").startswith("key")]
    assert len(heights) == 7
    assert np.diff(np.sort(heights)).min() >= 11.9
    assert max(heights) <= svg.WHOLE.bottom


def test_values_over_many_decades_get_a_log_axis(tmp_path: Path):
    wide = page.Panel("p", "m", [series("a", np.geomspace(1e-2, 1e4, 10)[None])])
    reader = read(tmp_path, report(section(panels=[wide])))
    (drawn,) = [at["d"] or "" for at, _ in reader.all("path") if at.get("data-series")]
    # Equal factors, equal distances; the axis has a tenth of room at either end.
    height = (svg.WHOLE.bottom - svg.WHOLE.top) * np.log(1e6) / np.log(1.1**2 * 1e6)
    assert np.diff(np.array(points(drawn))[:, 1]) == pytest.approx(-height / 9, abs=0.101)
    below_zero = page.Panel("p", "m", [series("a", np.geomspace(1e-2, 1e4, 10)[None] - 1)])
    page.write(report(section(panels=[below_zero])), tmp_path)
    assert "logarithmic" not in (tmp_path / "index.html").read_text(encoding="utf-8")


def test_long_curves_are_thinned_on_the_page_and_whole_in_the_csv(tmp_path: Path):
    steps = np.arange(5000)
    reader = read(tmp_path, report(section(panels=[page.Panel("p", "m", [series("a", np.sqrt(steps)[None], steps)])])))
    (drawn,) = [at["d"] or "" for at, _ in reader.all("path") if at.get("data-series")]
    assert len(points(drawn)) == 300
    lines = list(csv.DictReader(io.StringIO((tmp_path / "csv" / "figure_5.csv").read_text(encoding="utf-8"))))
    assert len(lines) == 5000
    assert float(lines[4999]["value"]) == math.sqrt(4999)


def test_csv_round_trip(tmp_path: Path):
    values = VALUES.copy()
    values[2, 4] = np.nan
    hostile = 'a "b", c\nd'
    page.write(report(section(panels=[page.Panel("p", "m", [series(hostile, values), series()])])), tmp_path)
    with (tmp_path / "csv" / "figure_5.csv").open(encoding="utf-8", newline="") as file:
        lines = [line for line in csv.DictReader(file) if line["series"] == hostile]
    again = np.array([float(line["value"] or "nan") for line in lines]).reshape(3, 10)
    np.testing.assert_array_equal(again, values)
    assert [int(line["step"]) for line in lines[:10]] == STEPS.tolist()
    assert [line["seed"] for line in lines[::10]] == ["0", "1", "2"]


def test_the_csv_says_what_its_curves_run_over(tmp_path: Path):
    episodes = page.Panel("p", "m", [series()], "episodes")
    reader = read(tmp_path, report(section(panels=[episodes])))
    assert (tmp_path / "csv" / "figure_5.csv").read_text(encoding="utf-8").startswith("series,seed,episodes,value\n")
    data = json.loads(next(text for attributes, text in reader.all("script") if attributes.get("type")))
    assert data["column"] == "episodes"


def test_visits_are_counted_by_square_and_by_cell(tmp_path: Path):
    reader = read(tmp_path, report())
    data = json.loads([text for attributes, text in reader.all("script") if attributes.get("type")][1])
    assert sorted(square[2:] for square in data["squares"]) == [[1, 1], [2, 2]]
    left, bottom, side = data["floor"]
    ((row, column, *_),) = [square for square in data["squares"] if square[2] == 2]
    assert left + column * side <= 0.5 < left + (column + 1) * side
    assert bottom + row * side <= 0.5 < bottom + (row + 1) * side
    shades = [at for at, _ in reader.all("path") if re.fullmatch(r"v\d", at.get("class") or "")]
    assert [(at["class"], (at["d"] or "").count("M")) for at in shades if at["d"] != "M0 0h12v12h-12z"] == [
        ("v5", 1),
        ("v6", 1),
    ]
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "| 1: 0 to 2, 0 to 2 | 2 | 50.0% | 2 of 2 |" in text
    assert "| 3: 2 to 4, 2 to 4 | 0 | 0.0% | 0 of 2 |" in text


def test_a_floor_that_nobody_walked_is_drawn(tmp_path: Path):
    walked = section().panels[1]
    assert isinstance(walked, page.FloorVisits)
    nobody = walked._replace(positions=np.empty((0, 2)), seeds=np.empty(0, int))
    reader = read(tmp_path, report(section(panels=[nobody])))
    assert [at for at, _ in reader.all("path") if (at.get("class") or "").startswith("v")] == []
    assert [at for at, _ in reader.all("path") if at.get("class") == "cell"] != []


def test_hostile_text_stays_text(tmp_path: Path):
    panel = page.Panel(HOSTILE, HOSTILE, [series(HOSTILE)], HOSTILE)
    bad = section(
        title=HOSTILE,
        source=HOSTILE,
        claim=HOSTILE,
        explanation=HOSTILE,
        command=HOSTILE + "\n```\n",
        panels=[panel],
        tables=[page.Table((HOSTILE, "b"), [(HOSTILE, HOSTILE)], HOSTILE)],
        facts={HOSTILE: HOSTILE},
        reasons=(page.Reason(HOSTILE, "undecided", HOSTILE),),
    )
    reader = read(tmp_path, page.Report(HOSTILE, [bad], HOSTILE, [HOSTILE]))
    assert reader.wrong == reader.open == []
    scripts = reader.all("script")
    assert len(scripts) == 2
    assert json.loads(scripts[0][1])["series"][0]["label"] == HOSTILE
    assert [text for _, text in reader.all("h1")] == [HOSTILE]
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    outside = re.sub(r"````\n.*?\n````", "", text, flags=re.DOTALL)
    assert "<script>" not in outside
    for line in outside.splitlines():
        if line.startswith("|"):
            assert len(re.findall(r"(?<!\\)\|", line)) in (3, 4, 7), line


def test_each_reason_has_a_line_and_its_own_mark(tmp_path: Path):
    reasons = (page.Reason("a ahead of b", "holds", "by 3"), page.Reason("c at 40% or less", "does not hold", "c: 50%"))
    reader = read(tmp_path, report(section(verdict="does not hold", reasons=reasons)))
    listed = [" ".join(text.split()) for at, text in reader.all("li")]
    assert "✓ a ahead of b: holds, by 3" in listed and "✗ c at 40% or less: does not hold, c: 50%" in listed
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "\n- ✓ a ahead of b: holds \\(by 3\\)\n- ✗ c at 40% or less: does not hold" in text


def test_verdicts_are_told_apart_without_colour(tmp_path: Path):
    kinds = ("holds", "does not hold", "undecided", "not run")
    reader = read(tmp_path, report(*(section(f"f{i}", verdict=kind) for i, kind in enumerate(kinds))))
    said = [text for at, text in reader.all("span") if (at.get("class") or "").startswith("verdict")]
    assert said[:4] == ["✓ holds", "✗ does not hold", "? undecided", "o not run"]
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert all(f"| {one} |" in text for one in said[:4])


def test_markdown_has_all_of_it(tmp_path: Path):
    page.write(report(), tmp_path)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    for part in ("# A report", "It is ahead.", "✓ holds", "```\nrun it\n```", "- seeds: 0 to 2", "| implicit | 7 |"):
        assert part in text
    assert all((tmp_path / link).is_file() for link in re.findall(r"\]\(((?:csv|pictures)/[^)]+)\)", text))
    assert text.count("](csv/") == text.count("](pictures/") == 2


@pytest.mark.parametrize("count", [1, 7, 8, 11])
def test_pictures_in_files_of_their_own_need_nothing_else(tmp_path: Path, count: int):
    labels = [f"ours with a long name {i}{HOSTILE}" for i in range(count)]
    panel = page.Panel("Coverage", "share", [series(label, VALUES / (i + 1)) for i, label in enumerate(labels)])
    page.write(report(section(panels=[panel])), tmp_path)
    root = ElementTree.parse(tmp_path / "pictures" / "figure_5.svg").getroot()
    drawn = list(root.iter())
    # Each series once, with its name, inside the picture and below no other's.
    names = [one for one in drawn if one.text in labels]
    assert [one.text for one in names] == labels
    places = [(float(one.attrib["x"]), float(one.attrib["y"])) for one in names]
    assert len(set(places)) == count
    _, _, width, height = map(float, root.attrib["viewBox"].split())
    assert all(0 <= x < width and 0 < y < height for x, y in places)
    means = [one for one in drawn if "data-series" in one.attrib and one.tag.endswith("path")]
    assert [one.attrib["data-series"] for one in means] == [str(i) for i in range(count)]
    ids = {one.attrib["id"] for one in drawn if "id" in one.attrib}
    assert {one.attrib["href"][1:] for one in drawn if "href" in one.attrib} <= ids
    text = (tmp_path / "pictures" / "figure_5.svg").read_text(encoding="utf-8")
    assert "//" not in text.replace('xmlns="http://www.w3.org/2000/svg"', "") and "prefers-color-scheme:dark" in text


def test_refresh(tmp_path: Path):
    assert "data-refresh" not in (page.write(report(), tmp_path)).read_text(encoding="utf-8").split("<body>")[0]
    reader = read(tmp_path, report(), refresh=2.5)
    assert reader.all("html")[0][0]["data-refresh"] == "2.5"
    with pytest.raises(ValueError, match="refresh is 0; must be above 0"):
        page.write(report(), tmp_path, refresh=0)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (section("..."), "must have a letter or a digit"),
        (section(verdict="maybe"), "verdict is 'maybe'"),
        (section(panels=[page.Panel("p", "m", [series(steps=STEPS[:9])])]), r"steps \(9,\) and values \(3, 10\)"),
        (section(panels=[page.Panel("p", "m", [series()._replace(seeds=(1,))])]), "for S = 1 seeds"),
        (section(tables=[page.Table(("a",), [("b", "c")])]), "must have 1 entries"),
        (section(panels=[section().panels[1]._replace(seeds=np.array([1]))]), r"seeds \(1,\)"),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_anything_is_written(tmp_path: Path, wrong: page.Section, said: str):
    with pytest.raises(ValueError, match=said):
        page.write(report(wrong), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_one_name_for_two_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="figure-5 comes twice"):
        page.write(report(section("figure 5", panels=[]), section("Figure-5", panels=[])), tmp_path)


def test_a_file_in_the_way_is_said(tmp_path: Path):
    (tmp_path / "out").write_text("")
    with pytest.raises(RunError, match="write the report"):
        page.write(report(), tmp_path / "out")


def test_fifteen_figures_of_ten_seeds_stay_below_two_megabytes(tmp_path: Path):
    steps, noise = np.arange(100) * 50, np.random.default_rng(0).random((6, 10, 100))
    panels = [page.Panel("p", "m", [page.Series(f"m{i}", steps, one, tuple(range(10))) for i, one in enumerate(noise)])]
    path = page.write(report(*(section(f"f{i}", panels=list(panels)) for i in range(15))), tmp_path)
    assert path.stat().st_size < 2e6


AROUND = """<!DOCTYPE html><title>around</title><pre></pre>
<script>addEventListener("message", event => { document.querySelector("pre").textContent = event.data; });</script>
<iframe src="index.html" style="border:0;height:900px;width:"""
"""A window of the browser has a least width; a frame in it has not."""
PROBE = """
const out = {};
const svg = document.querySelector("figure.curves .plot > svg"), at = svg.getBoundingClientRect();
const box = svg.parentNode.querySelector(".box");
const rows = () => [...box.querySelectorAll("tr")].map(row => [...row.cells].map(cell => cell.textContent));
const point = {clientX: at.left + at.width * 190 / 360, clientY: at.top + 50, pointerType: "mouse", bubbles: true};
svg.dispatchEvent(new PointerEvent("pointermove", point));
out.hover = [box.hidden, box.firstChild.textContent, rows()];
out.cursor = svg.querySelectorAll(".cursor").length;
svg.dispatchEvent(new PointerEvent("pointerleave", point));
out.left = [box.hidden, svg.querySelectorAll(".cursor").length];
const press = (on, key) => on.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true, cancelable: true}));
press(svg, "End");
press(svg, "ArrowLeft");
out.keys = [box.firstChild.textContent, document.querySelector(".said").textContent];
press(svg, "Escape");
out.escaped = box.hidden;
const each = document.querySelector(".each");
each.click();
out.seeds = svg.querySelectorAll(".seed").length;
each.click();
out.without = svg.querySelectorAll(".seed").length;
const floor = document.querySelector("figure.floor .plot > svg");
press(floor, "ArrowUp");
out.floor = floor.parentNode.querySelector(".box").textContent;
out.width = innerWidth;
out.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
parent.postMessage(JSON.stringify(out), "*");
"""


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium, Chrome, or anything of that name")
@pytest.mark.parametrize("width", [360, 1280])
def test_values_can_be_read_off_in_a_browser(tmp_path: Path, width: int):
    path = page.write(report(), tmp_path)
    text = path.read_text(encoding="utf-8").replace("</body>", f"<script>{PROBE}</script></body>")
    path.write_text(text, encoding="utf-8")
    around = tmp_path / "around.html"
    around.write_text(f'{AROUND}{width}px"></iframe>', encoding="utf-8")
    command = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    command += ["--window-size=1400,1000", "--virtual-time-budget=5000", "--dump-dom", around.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    (found,) = [text for _, text in Reader(done.stdout).all("pre")]
    out = json.loads(found)
    assert out["hover"][:2] == [False, "at 500"]
    # Of step 500: 0.5, 0.2222 and 0.3778, and half of each.
    assert out["hover"][2] == [["A", "implicit", "0.367 ± 0.14"], ["B", "random", "0.183 ± 0.07"]]
    assert out["cursor"] == 1
    assert out["left"] == [True, 0]
    assert out["keys"][0] == "at 900"
    assert out["keys"][1].startswith("at 900: implicit ")
    assert out["escaped"] is True
    assert (out["seeds"], out["without"]) == (6, 0)
    assert "visits" in out["floor"]
    assert (out["width"], out["wide"]) == (width, 0)


def luminance(colour: str) -> float:
    """WCAG's relative luminance of `#rgb` or `#rrggbb`."""
    digits = colour.lstrip("#")
    digits = "".join(2 * one for one in digits) if len(digits) == 3 else digits
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    red, green, blue = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_colours_stand_out_from_their_ground(mode: str):
    light, dark = re.findall(r":root\{(.*?)\}", look.STYLE, re.DOTALL)
    colours = dict(re.findall(r"--(\w+):(#\w+)", light if mode == "light" else dark))
    ground = luminance(colours["paper"])

    def contrast(name: str) -> float:
        high, low = sorted((luminance(colours[name]), ground), reverse=True)
        return (high + 0.05) / (low + 0.05)

    # WCAG: 4.5 for text, which a curve's letter is, too, but in bold and beside its line; 3 for graphics.
    assert min(contrast(name) for name in ("ink", "soft", "link", "yes", "no", "open")) >= 4.5
    assert min(contrast(f"c{i}") for i in range(svg.COLOURS)) >= 3.0


def test_a_panel_of_nothing_but_zeros_has_an_axis(tmp_path: Path):
    # As of a share that no seed has seen any of; an axis of no length would divide by 0.
    still = page.Panel("Return", "return", [series("still", np.zeros((3, 10)))])
    text = page.write(report(section(panels=[still])), tmp_path / "out").read_text()
    path = re.findall(r'<path class="mean [^>]* d="([^"]+)"', text)[0]
    heights = {pair[1] for pair in re.findall(r"([\d.]+)[ ,]([\d.]+)", path)}
    assert len(heights) == 1, "level, where the axis says 0"
