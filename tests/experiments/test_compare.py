"""Runs side by side: medians, ranges and the steps at which cells were reached, from files written by hand."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from experiments import compare
from experiments.analysis import comparison, intervals, statistics
from experiments.analysis.load import columns
from experiments.runs import schedule
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.presets import preset_config
from experiments.runs.spec import RunRef, RunSpec, to_json
from tests.experiments.tiny import ROOT


def write_run(
    path: Path, method: str, seed: int, reached: list[int], steps: int = 1_000, env: str = "ant_maze"
) -> Path:
    """A finished run that sees its cells at the given steps."""
    path.mkdir()
    config = dataclasses.replace(preset_config("laptop"), method=method, seed=seed, steps=steps, env=env)
    (path / "config.json").write_text(to_json(RunSpec(config)))
    rows = []
    for _, step in schedule.rounds(config, 0):
        cells = sum(at <= step for at in reached)
        rows.append({"step": step, "seed": seed, "coverage": cells / 7, "cells": cells, "wall_time": step * 0.06})
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    """Three seeds of one method, the middle one seeing all there is, and one of another."""
    return [
        write_run(tmp_path / "a", "implicit", 0, [25, 50, 300, 400, 925]),
        write_run(tmp_path / "b", "implicit", 1, [25, 50, 75, 100, 125, 150, 700]),
        write_run(tmp_path / "c", "implicit", 2, [25, 50, 300, 400, 925, 950]),
        write_run(tmp_path / "d", "random", 0, [25, 50, 625]),
    ]


def test_table_and_files(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture):
    assert compare.main([*map(str, runs), f"--out={tmp_path / 'out'}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "| `implicit` | 3 | 6 (5 to 7) | 5, 7, 6 | 700 | 61% +- 51 | 1.0 |" in lines
    assert "| `random` | 1 | 3 (3 to 3) | 3 | - | 34% | 1.0 |" in lines
    record = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert record["methods"]["implicit"][1]["reached"] == [25, 50, 75, 100, 125, 150, 700]
    random = {"seed": 0, "cells": 3, "reached": [25, 50, 625], "minutes": 1.0, "measures": {}}
    random |= {"calibration": None, "last_return": None, "final_return": None}
    assert record["methods"]["random"][0] == random
    assert (tmp_path / "out" / "coverage.png").stat().st_size > 10_000


def test_curves_hold_the_last_value_known(runs: list[Path]):
    _, (implicit, random) = statistics.group(runs)
    assert list(implicit.steps[:2]) == [30, 40], "of a hundred points the first is after the first round"
    assert len(implicit.steps) == 98
    every_tenth = implicit.steps % 100 == 0
    assert list(implicit.coverage[0, every_tenth] * 7) == pytest.approx([2, 2, 3, 4, 4, 4, 4, 4, 4, 5])
    assert list(random.coverage[0, every_tenth] * 7) == pytest.approx([2, 2, 2, 2, 2, 2, 3, 3, 3, 3])


def test_runs_of_different_lengths_meet_at_a_step(runs: list[Path], tmp_path: Path):
    short = write_run(tmp_path / "short", "implicit", 9, [25, 400], steps=500)
    first, (implicit, random) = statistics.group([*runs, short], until=500)
    assert first.config.steps == implicit.steps[-1] == 500
    assert [outcome.cells for outcome in implicit.outcomes] == [4, 6, 4, 2]
    assert random.outcomes[0].reached == (25, 50)
    with pytest.raises(RunError, match="short stands at step 500 of 600"):
        statistics.group([short], until=600)


def test_names_tell_settings_of_one_method_apart(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture):
    again = write_run(tmp_path / "e", "implicit", 0, [25, 50])
    named = [f"cold={runs[0]}", f"hot={again}", str(runs[1])]
    assert compare.main([*named, f"--out={tmp_path / 'out'}"]) == 0
    told = [line.split("|")[1:4] for line in capsys.readouterr().out.splitlines()[2:5]]
    assert told == [
        [" `cold` ", " 1 ", " 5 (5 to 5) "],
        [" `hot` ", " 1 ", " 2 (2 to 2) "],
        [" `implicit` ", " 1 ", " 7 (7 to 7) "],
    ]
    assert list(json.loads((tmp_path / "out" / "comparison.json").read_text())["methods"]) == [
        "cold",
        "hot",
        "implicit",
    ]


def test_a_path_with_an_equals_sign_is_a_path(tmp_path: Path):
    there = tmp_path / "lr=1e-3"
    there.mkdir()
    assert compare.split_name(str(there)) == (None, there)
    assert compare.split_name("hot=runs/lr=1") == ("hot", Path("runs/lr=1"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: write_run(path, "implicit", 0, [25]), "seed 0 comes twice"),
        (lambda path: write_run(path, "implicit", 7, [25], steps=500), "over 500 steps"),
        (lambda path: path, "holds no run"),
    ],
)
def test_refuses(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture, change, message: str):
    other = change(tmp_path / "other")
    assert compare.main([*map(str, runs), str(other), f"--out={tmp_path / 'out'}"]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_against_names_the_one_that_others_are_compared_with(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture
):
    assert compare.main([*map(str, runs), f"--out={tmp_path / 'out'}", "--against=random"]) == 0
    paired = capsys.readouterr().out.split("\n\n")[1]
    assert "seeds ahead of `random`" in paired and "1 of 1" in paired
    assert compare.main([*map(str, runs), f"--out={tmp_path / 'two'}", "--against=randm"]) == 1
    told = capsys.readouterr().err
    assert "against='randm'" in told and "'random'" in told
    assert not (tmp_path / "two").exists()


def test_refuses_a_run_that_has_not_finished(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture):
    metrics = runs[0] / "metrics.jsonl"
    metrics.write_text("".join(metrics.read_text().splitlines(keepends=True)[:10]))
    assert compare.main([str(runs[0]), f"--out={tmp_path / 'out'}"]) == 1
    assert "stands at step 250 of 1000. Finish it with --resume" in capsys.readouterr().err


def add_belief(run: Path, error: float, ratio: float, told: float | None, step: int = 1_000) -> None:
    """A belief that did nothing in the first half of its run, and what it was found to know at `step`."""
    path = run / "metrics.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    for row in rows:
        late = row["step"] > 500
        row |= {"model_error": error if late else 99.0, "variance": 2.0 if late else 50.0, "variance_p95": 3.0}
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    sets = {"its data": {"error_per_variance": ratio, "rank": 0.5}, "new, its own policy": {"rank": None}}
    found = {"step": step, "seeds": [{"seed": row["seed"], "sets": sets, "unseen_told_from_data": told}]}
    (run / "calibration.json").write_text(json.dumps(found))


def test_beliefs_are_told_of_where_there_are_any(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture):
    add_belief(runs[0], 0.5, 2.0, 0.9)
    add_belief(runs[1], 1.5, 8.0, None)
    add_belief(runs[2], 1.0, 8.0, 0.5, step=500)  # asked half-way: that is not what is compared
    assert compare.main([*map(str, runs), f"--out={tmp_path / 'out'}"]) == 0
    told, _, belief, calibration, total = capsys.readouterr().out.split("\n\n")
    assert len(told.splitlines()) == 4
    assert belief.splitlines()[2:] == ["| `implicit` | 1 | -, - | -, - | 2, 3 | -, - |"]
    # two of three were asked; a ratio of 2 and one of 8 are 4 on average
    assert calibration.splitlines()[2:] == ["| `implicit` | 2 | 4 | - | - | 0.5 | - | - | 90% |"]
    assert total.startswith("4 min 00 s of wall time")
    assert (tmp_path / "out" / "variance.png").stat().st_size > 10_000
    record = json.loads((tmp_path / "out" / "comparison.json").read_text())["methods"]["implicit"]
    assert record[1]["measures"]["model_error"] == 1.5 and record[1]["calibration"]["seed"] == 1
    assert record[2]["calibration"] is None


def test_a_damaged_answer_is_told(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture):
    (runs[0] / "calibration.json").write_text("{")
    assert compare.main([*map(str, runs), f"--out={tmp_path / 'out'}"]) == 1
    assert f"What to do: python -m experiments.calibrate {runs[0]}" in capsys.readouterr().err


def test_what_is_kept_of_runs_compares_as_they_do(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture):
    add_belief(runs[0], 0.5, 2.0, 0.9)
    kept = tmp_path / "kept"
    assert compare.main([*map(str, runs), f"--out={tmp_path / 'out'}", f"--keep={kept}"]) == 0
    told = capsys.readouterr().out
    assert sorted(path.name for path in kept.iterdir()) == ["a", "b", "c", "d"]
    assert sorted(path.name for path in (kept / "a").iterdir()) == [
        "calibration.json",
        "config.json",
        "metrics.jsonl.gz",
    ]
    # compared again, and kept again where they are: the same tables, the same bytes
    before = (kept / "a" / "metrics.jsonl.gz").read_bytes()
    assert compare.main([*(str(kept / run.name) for run in runs), f"--out={tmp_path / 'two'}", f"--keep={kept}"]) == 0
    assert capsys.readouterr().out == told.replace(str(tmp_path / "out"), str(tmp_path / "two"))
    assert (kept / "a" / "metrics.jsonl.gz").read_bytes() == before
    names = ("comparison.json", "coverage.png")
    assert all((tmp_path / "out" / name).read_bytes() == (tmp_path / "two" / name).read_bytes() for name in names)


@pytest.mark.parametrize(
    ("pattern", "until", "seeds"),
    [("acro-verdict*", 1_000, 10), ("ant-verdict-*-s2[0-7]", 5_500, 8), ("chain-verdict-*", 735, 3)],
)
def test_committed_runs_are_there_and_are_what_the_readme_shows(pattern: str, until: int, seeds: int):
    _, groups = statistics.group([*(ROOT / "experiments/results/runs").glob(pattern)], until=until)
    readme = (ROOT / "experiments/results/README.md").read_text()
    assert {one.label for one in groups} >= {"implicit", "disagreement", "max", "icm"}
    for one in groups:
        assert len(one.outcomes) == seeds
        mean, half_width = intervals.interval(one.coverage.mean(axis=1))
        shown = f"{mean:.0%} +- {100 * half_width:.0f}"
        assert re.search(rf"^\| `{one.label}` \| {seeds} \| .* \| {re.escape(shown)} \|", readme, re.M)


def test_damaged_metrics_are_told(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture):
    RunDirectory(runs[0]).keep(tmp_path / "kept")
    packed = tmp_path / "kept" / "a" / "metrics.jsonl.gz"
    packed.write_bytes(packed.read_bytes()[:-20])
    assert compare.main([str(packed.parent), f"--out={tmp_path / 'out'}"]) == 1
    assert "read the metrics" in capsys.readouterr().err


def test_rows_as_columns_and_as_csv(runs: list[Path], tmp_path: Path):
    table = columns(runs, [None, "mine", None, None], until=300)
    assert list(table)[:6] == ["name", "run", "env", "method", "preset", "step"]
    assert len({len(column) for column in table.values()}) == 1
    assert sorted(set(table["name"].tolist())) == ["implicit", "mine", "random"]
    of_b = table["name"] == "mine"
    assert table["seed"][of_b].tolist() == [1] * 13
    assert table["step"][of_b].tolist() == [*range(25, 256, 25), 256, 275, 300]
    assert table["cells"][of_b][:5].tolist() == [1, 2, 3, 4, 5]
    path = tmp_path / "rows.csv"
    words = [*map(str, runs), f"--out={tmp_path / 'out'}", "--until=300", f"--csv={path}"]
    assert compare.main(words) == 0
    lines = path.read_text().splitlines()
    assert lines[0].startswith("name,run,env,method,preset,step,seed,coverage,cells")
    assert len(lines) == 1 + 13 * len(runs)
    assert lines[1].startswith(f"implicit,{runs[0]},ant_maze,implicit,laptop,25,0,")


def test_columns_have_nothing_where_a_row_has_none(runs: list[Path]):
    path = RunDirectory(runs[0]).metrics_path
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines[0]["variance"] = 0.5
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    variance = columns(runs[:1])["variance"]
    assert variance[0] == 0.5 and np.isnan(variance[1:]).all()


def write_evaluated(
    path: Path, seed: int, returns: dict[int, float], steps: int, parent: RunRef | None = None, env: str = "ant_maze"
) -> Path:
    """A finished run whose own steps have evaluations."""
    run = write_run(path, "implicit", seed, [25], steps, env)
    spec = RunSpec(RunDirectory(run).config(), parent)
    (run / "config.json").write_text(to_json(spec))
    told = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    for row in told:
        if row["step"] in returns:
            row["eval/return"] = returns[row["step"]]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in told))
    return run


def test_returns_count_the_steps_of_parents(tmp_path: Path, capsys: pytest.CaptureFixture):
    # 1,000 steps: of their own, or 600 after a parent's 300 and its parent's 100
    plain = [write_evaluated(tmp_path / f"p{i}", i, {500: 1.0 * i, 1_000: 10.0 + 4 * i}, 1_000) for i in range(2)]
    ref = RunRef("runs/explored", 300, "0123", before=100)
    moved = [write_evaluated(tmp_path / f"m{i}", i, {100: 2.0, 600: 20.0 + i}, 600, ref) for i in range(2)]
    words = [*(f"plain={run}" for run in plain), *(f"moved={run}" for run in moved)]
    assert compare.main([*words, f"--out={tmp_path / 'out'}"]) == 0
    text = capsys.readouterr().out
    # half-width: t(1, 0.975) = 12.706 times std / sqrt(2): 12.706 * 2 and 12.706 * 0.5
    assert "| `plain` | 2 | 12.0 +- 25.4 | 10.0, 14.0 | 1,000 |" in text
    assert "| `moved` | 2 | 20.5 +- 6.4 | 20.0, 21.0 | 1,000 |" in text
    # at the end 10 and 7 more; on average, both from 500 on, 11 - 5 and 11.5 - 7.5
    assert "| `moved` | 500 to 1,000 | +8.5 +- 19.1 | 2 of 2 | +5.0 +- 12.7 | 2 of 2 |" in text
    assert "| final return less `plain`, by seed: mean, 95 % | seeds ahead of `plain` |" in text
    record = json.loads((tmp_path / "out" / "comparison.json").read_text())["returns"]
    assert record["less"] == "plain" and list(record["by_name"]) == ["moved"]
    moved_by = record["by_name"]["moved"]
    assert (moved_by["first"], moved_by["last"]) == (500, 1_000)
    assert moved_by["final"] == {
        "seeds": [0, 1],
        "difference": {"mean": 8.5, "half_width": pytest.approx(1.5 * 12.7062, rel=1e-5)},
        "ahead": 2.0,
    }
    assert moved_by["mean"]["difference"]["mean"] == 5.0
    assert (tmp_path / "out" / "return.png").stat().st_size > 10_000
    _, (own, after) = statistics.group([*plain, *moved], names=["plain"] * 2 + ["moved"] * 2)
    assert own.evaluated.tolist() == [500, 1_000] and after.evaluated.tolist() == [500, 1_000]
    assert own.returns.tolist() == [[0.0, 10.0], [1.0, 14.0]]
    assert after.returns.tolist() == [[2.0, 20.0], [2.0, 21.0]]
    assert own.steps[0] >= 425, "coverage is compared where all have some"
    assert after.outcomes[0].reached == (425,)
    # up to a step, parents' counted too; one that lies before a run begins is refused
    _, (own, after) = statistics.group([*plain, *moved], 500, ["plain"] * 2 + ["moved"] * 2)
    assert own.evaluated.tolist() == after.evaluated.tolist() == [500]
    with pytest.raises(RunError, match=r"m0 begins after 400 steps of its parents\. Compare with --until=401 or more"):
        statistics.group([*plain, *moved], 400, ["plain"] * 2 + ["moved"] * 2)
    assert compare.main([*map(str, plain), f"--out={tmp_path / 'out2'}"]) == 0
    other = write_evaluated(tmp_path / "short", 5, {}, 500, ref)
    with pytest.raises(RunError, match=r"short is of ant_maze over 900 steps \(400 of them its parents'\)"):
        statistics.group([*plain, other])


def test_without_evaluations_there_is_no_picture_of_returns(runs: list[Path], tmp_path: Path, capsys):
    assert compare.main([*map(str, runs), f"--out={tmp_path / 'out'}"]) == 0
    assert "final return" not in capsys.readouterr().out
    assert not (tmp_path / "out" / "return.png").exists()


def write_peer(path: Path, seed: int, returns: dict[int, float], /, **changes) -> Path:
    """A run of another library, as `benchmarks.peers.returns` writes it; what is changed to None is left out."""
    rows = [{"env_steps": step, "return": value, "return_std": 1.0, "seconds": 9.5} for step, value in returns.items()]
    who = {"library": "sbx", "version": "0.2", "environment": "HalfCheetah-v5", "seed": seed, "warm_up_steps": 100}
    data = {name: value for name, value in {**who, "rows": rows, **changes}.items() if value is not None}
    path.write_text(json.dumps(data))
    return path


@pytest.fixture
def cheetahs(tmp_path: Path) -> list[str]:
    """Two seeds of a method of 1,000 steps on the half cheetah."""
    returns = {500: 10.0, 1_000: 20.0}
    runs = [write_evaluated(tmp_path / f"r{i}", i, returns, 1_000, env="half_cheetah_task") for i in range(2)]
    return [str(run) for run in runs]


def test_another_librarys_returns_stand_beside_ours(cheetahs: list[str], tmp_path: Path, capsys):
    # what comes after the runs' 1,000 steps is left out
    peers = [
        write_peer(tmp_path / f"p{i}.json", i, {500: 11.0 + i, 1_000: 24.0 + 2 * i, 1_500: 99.0}) for i in range(2)
    ]
    out = tmp_path / "out"
    assert (
        compare.main([*cheetahs, *map(str, peers), f"own={peers[0]}", f"--out={out}", f"--keep={tmp_path / 'k'}"]) == 0
    )
    text = capsys.readouterr().out
    # half-widths: t(1, 0.975) = 12.706 times 1, and times 0.75
    assert "| `implicit` | 2 | 20.0 +- 0.0 | 20.0, 20.0 | 1,000 |" in text
    assert "| `sbx` | 2 | 25.0 +- 12.7 | 24.0, 26.0 | 1,000 |" in text
    assert "| `own` | 1 | 24.0 | 24.0 | 1,000 |" in text
    assert "| `sbx` | 500 to 1,000 | +5.0 +- 12.7 | 2 of 2 | +3.2 +- 9.5 | 2 of 2 |" in text
    assert "| `own` | 500 to 1,000 | +4.0 | 1 of 1 | +2.5 | 1 of 1 |" in text
    assert text.count("`sbx`") == 2, "it has no coverage, and no belief"
    record = json.loads((out / "comparison.json").read_text())
    assert list(record["methods"]) == ["implicit"] and list(record["others"]) == ["sbx", "own"]
    told = {"library": "sbx", "version": "0.2", "environment": "HalfCheetah-v5", "seed": 1, "warm_up_steps": 100}
    assert record["others"]["sbx"][1] == {
        **told,
        "final_return": 26.0,
        "evaluated": [500, 1_000],
        "returns": [12.0, 26.0],
    }
    assert record["returns"]["by_name"]["sbx"]["final"]["difference"]["mean"] == 5.0
    assert (tmp_path / "k" / "p1.json").read_text() == peers[1].read_text()
    # compared with it; coverage, which it has none of, with the first run's
    named = [f"ours={cheetahs[0]}", f"theirs={peers[0]}", f"--out={out}", "--against=theirs", "--until=700"]
    assert compare.main(named) == 0
    assert "| `ours` | 500 | -1.0 | 0 of 1 | -1.0 | 0 of 1 |" in capsys.readouterr().out


def test_another_librarys_returns_are_in_the_picture(cheetahs: list[str], tmp_path: Path, monkeypatch):
    drawn = []
    monkeypatch.setattr(comparison.figures, "plot_return", lambda path, curves, title: drawn.extend(curves))
    peers = [write_peer(tmp_path / f"p{i}.json", i, {500: 11.0, 1_000: 24.0 + i}) for i in range(2)]
    assert compare.main([*cheetahs, *map(str, peers), f"--out={tmp_path / 'out'}"]) == 0
    assert [curve.label for curve in drawn] == ["implicit", "sbx"]
    assert drawn[1].steps.tolist() == [500, 1_000] and drawn[1].values.tolist() == [[11.0, 24.0], [11.0, 25.0]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": None}, "holds no run of another library (it has no 'rows'). What to do: give a file that `python -m"),
        ({"rows": []}, "holds no run of another library (it has no rows)"),
        ({"library": 7}, "(library is 7)"),
        ({"seed": "0"}, "(seed is '0')"),
        ({"rows": [{"env_steps": 500, "return": None}]}, "(return is None)"),
        ({"rows": [{"env_steps": 500, "return": float("nan")}]}, "(a return is not finite)"),
        ({"rows": [{"env_steps": n, "return": 1.0} for n in (500, 500)]}, "(env_steps do not rise from row to row)"),
        (
            {"environment": "Walker2d-v5"},
            "is of Walker2d-v5, and the runs of half_cheetah_task. Allowed: gymnasium:Walker2d-v5.",
        ),
        (
            {"rows": [{"env_steps": 900, "return": 1.0}]},
            "ends at step 900, before step 1000. Compare with --until=900 or",
        ),
        (
            {"rows": [{"env_steps": 1_100, "return": 1.0}]},
            "was first evaluated at step 1100. Compare with --until=1100",
        ),
    ],
)
def test_what_is_no_run_of_another_library_is_refused(
    change: dict, message: str, cheetahs: list[str], tmp_path: Path, capsys
):
    path = write_peer(tmp_path / "p.json", 0, {500: 1.0, 1_000: 2.0}, **change)
    assert compare.main([*cheetahs, str(path), f"--out={tmp_path / 'out'}"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {path} ") and message in line, line
    assert not (tmp_path / "out").exists()


def test_files_of_other_libraries_that_do_not_go_together_are_refused(cheetahs: list[str], tmp_path: Path, capsys):
    path, broken = write_peer(tmp_path / "p.json", 0, {500: 1.0, 1_000: 2.0}), tmp_path / "broken.json"
    broken.write_text("{")
    for words, message in (
        ([*cheetahs, str(path), str(path)], "sbx: seed 0 comes twice. Give each once, or NAME=FILE."),
        ([*cheetahs, f"implicit={path}"], "implicit: is a name of runs and of another library's."),
        ([str(path)], f"{path}: is of another library. Give at least one run to hold it beside."),
        ([*cheetahs, str(broken)], f"{broken} holds no run of another library (Expecting property name"),
    ):
        assert compare.main([*words, f"--out={tmp_path / 'out'}"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"error: {message}"), line
    assert not (tmp_path / "out").exists()
