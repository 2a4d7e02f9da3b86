import io
import json
import os
import re
import struct
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.analysis.report import summary
from experiments.analysis.tables import duration
from experiments.runs.console import Progress
from experiments.runs.errors import RunError
from experiments.runs.metrics import MetricsLog, read_metrics
from experiments.runs.scene import Cells
from experiments.runs.tensorboard import TensorBoardLog


def make_rows(step: int, num_seeds: int = 2) -> list[dict]:
    return [
        {
            "step": step,
            "seed": seed,
            "coverage": min(7, 1 + step // 300 + seed) / 7,
            "cells": min(7, 1 + step // 300 + seed),
            "intrinsic_reward": 0.5,
            "model_error": 0.01,
            "wall_time": step / 10,
            "steps_per_second": 10.0,
        }
        for seed in range(num_seeds)
    ]


def write(path: Path, steps: range, num_seeds: int = 2) -> None:
    log = MetricsLog(path)
    for step in steps:
        log.append(make_rows(step, num_seeds))
    log.close()


def test_rows_are_on_disk_after_each_append_in_their_order(tmp_path: Path):
    path = tmp_path / "run" / "metrics.jsonl"
    log = MetricsLog(path)
    log.append([{"step": 25, "seed": 0, "z": 1, "a": 2}])
    assert path.read_text() == '{"step": 25, "seed": 0, "z": 1, "a": 2}\n'
    log.append([{"step": 50, "seed": 0}, {"step": 50, "seed": 1}])
    log.sync()
    assert read_metrics(path)[1:] == [{"step": 50, "seed": 0}, {"step": 50, "seed": 1}]


def test_scalars_of_all_kinds(tmp_path: Path):
    row = {
        "step": np.int64(3),
        "seed": jnp.int32(1),
        "float32": jnp.float32(0.1),
        "float64": np.float64(1 / 3),
        "python": 0.1,
        "flag": np.bool_(True),
        "text": "ant",
        "none": None,
        "nan": float("nan"),
        "inf": jnp.array(jnp.inf),
        "tiny": np.float32(1e-45),
    }
    MetricsLog(tmp_path / "m").append([row])
    (line,) = (tmp_path / "m").read_text().splitlines()
    read = json.loads(line, parse_constant=pytest.fail)
    assert '"float32": 0.1,' in line
    assert read["float64"] == 1 / 3
    assert np.float32(read["tiny"]) == np.float32(1e-45)
    assert read | {"float64": 0, "tiny": 0} == {
        "step": 3,
        "seed": 1,
        "float32": 0.1,
        "float64": 0,
        "python": 0.1,
        "flag": True,
        "text": "ant",
        "none": None,
        "nan": None,
        "inf": None,
        "tiny": 0,
    }


@pytest.mark.parametrize("value", [np.zeros(2), jnp.zeros((1,)), [1], {"a": 1}, 1j])
def test_what_is_not_a_scalar_is_named(tmp_path: Path, value: object):
    with pytest.raises(ValueError, match="wrong"):
        MetricsLog(tmp_path / "m").append([{"step": 1, "seed": 0, "wrong": value}])
    assert not (tmp_path / "m").exists()


def test_step_and_seed_are_required(tmp_path: Path):
    with pytest.raises(ValueError, match="step and seed"):
        MetricsLog(tmp_path / "m").append([{"step": 1}])


@pytest.mark.parametrize("torn", [b"", b'{"step": 125, "se', b"\x00\x00\x00", b'{"step": 50, "seed": 0}'])
@pytest.mark.parametrize("step", [-1, 0, 25, 60, 75, 100, 500])
def test_cut_back_to_a_checkpoint_then_the_same_file(tmp_path: Path, torn: bytes, step: int):
    whole, path = tmp_path / "whole", tmp_path / "metrics.jsonl"
    write(whole, range(25, 126, 25))
    write(path, range(25, 101, 25))
    with path.open("ab") as file:
        file.write(torn)
    log = MetricsLog(path)
    kept = 2 * min(4, max(0, step // 25))
    assert log.truncate_after(step) == kept
    assert path.read_bytes().splitlines() == whole.read_bytes().splitlines()[:kept]
    for later in range(25 * (kept // 2 + 1), 126, 25):
        log.append(make_rows(later))
    log.close()
    assert path.read_bytes() == whole.read_bytes()
    assert [entry.name for entry in tmp_path.glob("*.tmp")] == []


def test_cutting_back_nothing_is_fine(tmp_path: Path):
    assert MetricsLog(tmp_path / "none").truncate_after(100) == 0


def test_a_line_that_is_read_while_it_is_written_is_left_out(tmp_path: Path):
    write(tmp_path / "m", range(25, 51, 25), num_seeds=1)
    with (tmp_path / "m").open("a") as file:
        file.write('{"step": 75')
    assert [row["step"] for row in read_metrics(tmp_path / "m")] == [25, 50]


@pytest.mark.parametrize("line", ["{garbage", "3", "{}", "\x00"])
def test_a_damaged_line_is_named(tmp_path: Path, line: str):
    path = tmp_path / "m"
    path.write_text(f'{{"step": 1}}\n{line}\n{{"step": 2}}\n')
    for read in (lambda: read_metrics(path), lambda: MetricsLog(path).truncate_after(5)):
        with pytest.raises(RunError, match=r"line 2 of .* is damaged") as caught:
            read()
        assert str(path) in str(caught.value)
    assert MetricsLog(path).truncate_after(-1) == 0


def test_unwritable_places_are_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    path = tmp_path / "file" / "metrics.jsonl"
    with pytest.raises(RunError) as caught:
        MetricsLog(path).append(make_rows(1))
    assert str(path) in str(caught.value)
    with pytest.raises(RunError, match="tensorboard"):
        TensorBoardLog(tmp_path / "file" / "tensorboard")
    with pytest.raises(RunError, match="none"):
        read_metrics(tmp_path / "none")


def test_a_full_disk_keeps_the_rows_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "metrics.jsonl"
    write(path, range(25, 51, 25))
    before = path.read_bytes()
    log = MetricsLog(path)
    with monkeypatch.context() as patch:
        original = os.write

        def fill_up(file: int, data: bytes) -> int:
            if len(data) < 100:
                raise OSError(28, "No space left on device")
            return original(file, data[:100])

        patch.setattr(os, "write", fill_up)
        with pytest.raises(RunError, match=r"No space left on device.*free some space"):
            log.append(make_rows(75))
    log.close()
    assert MetricsLog(path).truncate_after(50) == 4
    assert path.read_bytes() == before


def read_events(directory: Path) -> list[tuple[int, str, float]]:
    """Step, tag and value of every scalar, read by the published format of TFRecord files."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted(directory.glob("events.*")):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            event = Event.FromString(data[12 : 12 + length])
            found += [(event.step, value.tag, value.simple_value) for value in event.summary.value]
            if event.HasField("session_log"):
                found.append((event.step, "purge", event.session_log.status))
            data = data[16 + length :]
    return found


def test_tensorboard_events_are_grouped_and_flushed(tmp_path: Path):
    log = TensorBoardLog(tmp_path)
    assert log.available
    row = {"step": 25, "seed": 3, "coverage": 0.5, "model_error": None, "policy/entropy": np.float32(0.1), "a/b": 2}
    log.append([row | {"intrinsic_reward": float("nan"), "wall_time": 1.5, "steps_per_second": 2.5, "note": "x"}])
    events = {tag: (step, pytest.approx(value)) for step, tag, value in read_events(tmp_path)}
    assert events == {
        "exploration/coverage": (25, 0.5),
        "policy/entropy": (25, 0.1),
        "a/b": (25, 2.0),
        "time/wall_time": (25, 1.5),
        "time/steps_per_second": (25, 2.5),
    }
    log.close()


def test_tensorboard_names_seeds_and_purges_on_resume(tmp_path: Path):
    log = TensorBoardLog(tmp_path / "a", num_seeds=2)
    log.append(make_rows(25))
    tags = {tag for _, tag, _ in read_events(tmp_path / "a")}
    assert {"exploration/coverage/seed_0", "exploration/coverage/seed_1", "model/error/seed_0"} <= tags
    log.close()
    log = TensorBoardLog(tmp_path / "b", after_step=25)
    log.append([{"step": 50, "seed": 0, "coverage": 1.0}])
    assert (26, "purge", 1) in read_events(tmp_path / "b")
    log.close()


def test_a_full_disk_is_told_by_tensorboard_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    log = TensorBoardLog(tmp_path)

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(RunError, match=r"TensorBoard events in .*No space left"):
        patch.setattr(os, "fsync", fail)
        log.append(make_rows(25))
    log.close()


def test_without_tensorboardx_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "tensorboardX", None)
    log = TensorBoardLog(tmp_path / "t")
    assert not log.available
    log.append(make_rows(1))
    log.close()
    assert not (tmp_path / "t").exists()


def test_progress_in_a_file_is_one_line_per_tenth():
    stream = io.StringIO()
    progress = Progress(1000, num_cells=7, stream=stream)
    progress.say("compiling the improve step")
    for step in range(25, 1001, 25):
        progress.update(step, make_rows(step))
    progress.close()
    first, *lines = stream.getvalue().splitlines()
    assert first == "compiling the improve step"
    assert len(lines) == 10
    assert re.match(r" 50% \|   500/1,000  cells 2-3/7  reward 0.5  error 0.01  [\d.]+ steps/s  \d+ s left$", lines[4])
    assert lines[-1].startswith("100% | 1,000/1,000  cells 4-5/7")
    assert "left" not in lines[-1]


def test_progress_on_a_terminal_is_one_bar():
    stream = io.StringIO()
    progress = Progress(1000, start_step=500, stream=stream, live=True)
    progress.update(750, [{"step": 750, "seed": 0, "coverage": 3 / 7, "intrinsic_reward": None}])
    progress.say("saved")
    progress.update(1000, [{"step": 1000, "seed": 0, "coverage": 5 / 7, "intrinsic_reward": 0.25}])
    progress.close()
    progress.close()
    text = stream.getvalue()
    assert " 50% |" in text
    assert "saved\n" in text
    last = text.replace("\n", "\r").rstrip("\r").split("\r")[-1]
    assert last.startswith("100% |")
    assert "1,000/1,000  coverage 71%  reward 0.25  " in last
    assert text.count("\n") == 2


def test_speed_begins_anew_with_learning_and_what_is_left_is_told_from_then_on(monkeypatch: pytest.MonkeyPatch):
    clock = iter([0.0, 1.0, 61.0, 71.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    stream = io.StringIO()
    progress = Progress(1000, stream=stream, warm_up=100)
    for step in (100, 200, 300):
        progress.update(step, [{"step": step, "seed": 0}])
    warm_up, compiled, learned = stream.getvalue().splitlines()
    assert warm_up.endswith("100 steps/s"), "what is left is slower"
    assert "steps/s" not in compiled
    assert learned.endswith("10 steps/s  1 min left")


def test_durations():
    assert [duration(s) for s in (0, 59.4, 60, 832, 3599.6, 7500)] == [
        "0 s",
        "59 s",
        "1 min 00 s",
        "13 min 52 s",
        "1 h 00 min",
        "2 h 05 min",
    ]


def test_summary_of_one_seed():
    rows = [row for step in range(100, 1001, 100) for row in make_rows(step, 1)]
    assert summary(rows, Cells(7, "maze cells"), files={"metrics": "runs/a/metrics.jsonl", "video": Path("x")}) == (
        "seed   maze cells (of 7)   last new at step   steps         time   steps/s\n"
        "--------------------------------------------------------------------------\n"
        "   0                   4                900   1,000   1 min 40 s      10.0\n"
        "\n"
        "metrics   runs/a/metrics.jsonl\n"
        "video     x"
    )


def test_summary_of_several_seeds():
    rows = [row for step in range(100, 1001, 100) for row in make_rows(step, 3)]
    head, _, *seeds, _, median, spread = summary(rows, Cells(7, "cells")).splitlines()
    assert head.startswith("  seed   cells (of 7)")
    assert [line.split()[:3] for line in seeds] == [["0", "4", "900"], ["1", "5", "900"], ["2", "6", "900"]]
    assert median.split()[:3] == ["median", "5", "900"]
    assert spread.split()[:4] == ["range", "4", "to", "6"]


def test_where_nothing_was_found_there_is_no_last_new_step():
    rows = [row | {"cells": row["cells"] * (row["seed"] == 2)} for step in (100, 200) for row in make_rows(step, 3)]
    head, _, *seeds, _, median, spread = summary(rows, Cells(2, "horizontal poses")).splitlines()
    assert "last new at step" in head
    assert [line.split()[:3] for line in seeds] == [["0", "0", "-"], ["1", "0", "-"], ["2", "3", "100"]]
    assert median.split()[:3] == ["median", "0", "100"]
    rows = [row for row in rows if row["seed"] < 2]
    *_, one, _, median, spread = summary(rows, Cells(2, "horizontal poses")).splitlines()
    assert one.split()[:3] == ["1", "0", "-"]
    assert median.split()[:3] == ["median", "0", "-"]
    assert spread.split()[:3] == ["range", "0", "-"]


def test_summary_of_nothing():
    with pytest.raises(ValueError, match="rows"):
        summary([], Cells(7, "cells"))
