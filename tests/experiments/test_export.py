"""The rows of runs as CSV."""

import csv
import json
from pathlib import Path

import pytest

from experiments import export
from experiments.runs.rows import FIELDS
from tests.experiments.tiny import STEPS


def read(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(text.splitlines()))


def test_every_row_and_field_is_there(finished, tmp_path: Path):
    path = tmp_path / "rows.csv"
    assert export.main([str(finished.out), f"--out={path}"]) == 0
    rows, lines = read(path.read_text()), (finished.out / "metrics.jsonl").read_text().splitlines()
    assert [entry.name for entry in tmp_path.iterdir()] == ["rows.csv"]
    assert [int(row["step"]) for row in rows] == list(STEPS)
    for row, line in zip(rows, map(json.loads, lines), strict=True):
        assert {name: float(value) for name, value in row.items() if value} == line
    assert list(rows[0]) == [name for name in FIELDS if name in rows[0]], "in the order of the schema"
    assert rows[0]["policy/q"] == "" != rows[-1]["policy/q"]


def test_several_runs_are_told_apart_and_printed(finished, capsys: pytest.CaptureFixture[str]):
    assert export.main([str(finished.out), str(finished.out)]) == 0
    rows = read(capsys.readouterr().out)
    assert [row["run"] for row in rows] == [str(finished.out)] * (2 * len(STEPS))
    assert list(rows[0])[:3] == ["run", "step", "seed"]


def test_what_a_method_adds_comes_last(finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "config.json").write_text((finished.out / "config.json").read_text())
    (tmp_path / "metrics.jsonl").write_text('{"step": 25, "seed": 0, "policy/mine": 1.5, "coverage": null}\n')
    assert export.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out == "step,seed,coverage,policy/mine\n25,0,,1.5\n"


def test_what_cannot_be_done_is_said_in_a_line(finished, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert export.main([str(tmp_path)]) == 1
    assert capsys.readouterr().err.endswith("holds no run (no config.json). Give the --out of a run.\n")
    assert export.main([str(finished.out), f"--out={tmp_path / 'none' / 'rows.csv'}"]) == 1
    assert capsys.readouterr().err.startswith("error: cannot write the rows in ")
    assert list(tmp_path.iterdir()) == []
