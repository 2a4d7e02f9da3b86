import dataclasses
import errno
import json
import os
import re
import shlex
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.image import imread

import envs
from experiments import run
from experiments.runs import console, metrics, place
from experiments.runs.checkpoint import Checkpoints
from experiments.runs.config import PRESETS, flag
from experiments.runs.directory import RunDirectory
from experiments.runs.flags import document
from experiments.runs.presets import preset_config
from experiments.runs.spec import RunSpec, from_json, to_json
from experiments.runs.status import Status
from experiments.training import loop, record
from jaxplore import TASK, beliefs, methods
from jaxplore.methods import Method
from tests.experiments.tiny import CELLS, ROOT, STEPS, TINY, assert_same_run, leaves, make_point, rows

# Rounds that end at 25, 30, 50 and 60; checkpoints at 25, 50 and 60.
RANDOM = (
    *("--env=point", "--method=random", "--preset=smoke"),
    *("--steps=60", "--warm-up-steps=30", "--checkpoint-every=20"),
)


def parse(*words: str):
    return run.parse(words)[1].config


def everything_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


# A whole run.


def test_a_run_writes_its_metrics(finished):
    assert finished.status == 0
    told = rows(finished.out)
    assert [row["step"] for row in told] == list(STEPS)
    assert {row["seed"] for row in told} == {0}
    for row in told:
        assert row["coverage"] == pytest.approx(row["cells"] / 7)
        assert ("intrinsic_reward" in row) == ("model_error" in row) == ("fit/loss" in row) == (row["step"] >= 31)
    assert [row["cells"] for row in told] == sorted(row["cells"] for row in told)
    assert told[0]["cells"] >= 1
    assert {"fit/loss", "fit/dead_features", "policy/q_loss", "policy/imagined_reward"} <= told[-1].keys()
    assert all(np.isfinite(value) for row in told for value in row.values())
    times = [json.loads(line) for line in (finished.out / "metrics.jsonl").read_text().splitlines()]
    assert all(row["wall_time"] > 0 and row["steps_per_second"] > 0 for row in times)


def test_a_run_leaves_all_its_files_and_no_scraps(finished):
    names = {path.name for path in finished.out.iterdir()}
    pictures = {"coverage.png", "visitation.png", "intrinsic_reward.png"}
    assert names == {
        *("config.json", "versions.json", "scene.json", "metrics.jsonl", "walk.npz", "outcome.json"),
        *("checkpoints", "tensorboard"),
        *pictures,
    }
    assert Checkpoints(finished.out / "checkpoints").steps() == [75, 81]
    assert len(list((finished.out / "tensorboard").glob("events.*"))) == 1
    for picture in pictures:
        pixels = imread(finished.out / picture)[..., :3]
        assert pixels.shape[1] > 1000
        assert 0.01 < (pixels.mean(-1) < 0.95).mean() < 0.9


def test_a_run_ends_with_what_can_be_done_next(finished):
    *_, move, ask = finished.stdout.splitlines()
    assert move == f"To see it move: python -m experiments.render {finished.out}"
    assert ask == f"To ask what its models know: python -m experiments.calibrate {finished.out}"


def test_the_walk_is_where_each_step_began(finished):
    with np.load(finished.out / "walk.npz") as walk:
        positions, episode_steps = walk["positions"], walk["episode_steps"]
    assert positions.shape == (1, 81, 2)
    np.testing.assert_array_equal(episode_steps, np.arange(81)[None])
    # It begins near (0, 0) and takes no leaps: 0.05 s at the few m/s that an ant can do.
    assert np.abs(positions[0, 0]).max() <= 0.1
    assert 0 < np.abs(np.diff(positions[0], axis=0)).max() < 0.5


def test_a_run_tells_what_it_does_and_closes_with_a_table(finished):
    head, *_ = finished.stdout.splitlines()
    assert head == "implicit on ant_maze: smoke preset, seed 0, 81 steps"
    assert "physics: mujoco, learning: " in finished.stdout
    assert f"writing to {finished.out}" in finished.stdout
    assert re.search(r"^seed +maze cells \(of 7\) +last new at step +steps +time +steps/s$", finished.stdout, re.M)
    assert re.search(r"^ +0 +[1-7] +\d+ +81 +", finished.stdout, re.M)
    for name in ("metrics.jsonl", "coverage.png", "visitation.png", "intrinsic_reward.png"):
        assert str(finished.out / name) in finished.stdout
    assert f"python -m experiments.render {finished.out}" in finished.stdout
    assert finished.stderr.count("Compiling the learning step") == 1
    assert re.search(
        r"^100% \| 81/81  cells \d/7  reward [\d.e+-]+  error [\d.e+-]+  [\d.]+ steps/s$", finished.stderr, re.M
    )


def test_the_saved_configuration_gives_the_same_run(finished, tell, tmp_path: Path):
    config = from_json((finished.out / "config.json").read_text(), "config.json").config
    assert config == dataclasses.replace(parse(*TINY), backend="mujoco")
    again = tell(tmp_path / "again", f"--config={finished.out / 'config.json'}")
    assert again.status == 0
    assert_same_run(finished.out, again.out)
    assert (again.out / "config.json").read_bytes() == (finished.out / "config.json").read_bytes()


def test_flags_come_on_top_of_a_configuration(tmp_path: Path):
    path = tmp_path / "mine.json"
    path.write_text('{"preset": "smoke", "explorer": {"sac": {"lr": 0.5, "alpha": 0.25}}}')
    config = parse(f"--config={path}", "--sac.lr=0.125", "--seed", "4")
    assert (config.preset, config.seed) == ("smoke", 4)
    assert (config.explorer.sac.lr, config.explorer.sac.alpha) == (0.125, 0.25)


@pytest.mark.slow
def test_two_seeds_are_two_runs(tell, tmp_path: Path):
    # policies on imagined transitions, which magnify rounding less than real ones do
    words = (*TINY, "--imagination.real-fraction=0", "--imagination.keep-imagined")
    zero = tell(tmp_path / "zero", *words)
    one = tell(tmp_path / "one", "--seed=1", *words)
    both = tell(tmp_path / "both", "--num-seeds=2", *words)
    assert (zero.status, one.status, both.status) == (0, 0, 0)
    assert [(row["step"], row["seed"]) for row in rows(both.out)] == [(step, seed) for step in STEPS for seed in (0, 1)]
    for alone in (zero, one):
        for row in rows(alone.out):
            (twin,) = [
                other for other in rows(both.out) if (other["step"], other["seed"]) == (row["step"], row["seed"])
            ]
            assert row.keys() == twin.keys()
            # Each round magnifies the rounding of those before it, by how much hangs on the CPU: one seed and two are
            # two programs.
            rel = {75: 2e-1, 81: 3e-1}.get(row["step"], 2e-3)
            for name in row:
                assert twin[name] == pytest.approx(row[name], rel=rel, abs=1e-4), (name, row["step"])
    assert rows(zero.out)[-1]["intrinsic_reward"] != rows(one.out)[-1]["intrinsic_reward"]
    assert "seeds 0 to 1" in both.stdout
    assert re.search(r"^ *range  ", both.stdout, re.M)


def test_a_method_without_a_belief(tell, point: str, tmp_path: Path):
    told = tell(tmp_path / "run", *RANDOM)
    assert told.status == 0
    assert "random on point" in told.stdout
    assert "physics: jax" in told.stdout
    assert "experiments.render" not in told.stdout, "a point has no looks"
    last = rows(told.out)[-1]
    assert set(last) == {"step", "seed", "coverage", "cells", "dropped"}
    with np.load(told.out / "walk.npz") as walk:
        positions = walk["positions"][0]
        np.testing.assert_array_equal(walk["episode_steps"][0], np.arange(60) % 20)
    seen = sum(
        bool(np.any(np.all((positions >= (x0, y0)) & (positions < (x1, y1)), axis=-1))) for x0, y0, x1, y1 in CELLS
    )
    assert last["cells"] == seen


def test_a_run_shorter_than_its_pictures_have_panels(tell, point: str, tmp_path: Path):
    told = tell(tmp_path / "run", "--env=point", "--method=random", "--warm-up-steps=1", "--steps=2")
    assert told.status == 0
    assert (told.out / "visitation.png").exists()


def test_without_out_a_run_makes_its_own_place(point: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    command, spec = run.parse(["--env=point", "--method=random", "--seed=3"])
    assert place.choose(command.out, spec, resume=False).path == Path("runs/point-random-laptop-seed3")
    (tmp_path / "runs/point-random-laptop-seed3").mkdir(parents=True)
    assert place.choose(command.out, spec, resume=False).path == Path("runs/point-random-laptop-seed3-2")


# Flags.


@pytest.mark.parametrize(
    "words",
    [
        ("--env=ant_maze", "--num-seeds=2", "--sac.batch-size=64"),
        ("--env", "ant_maze", "--num_seeds", "2", "--sac.batch_size", "64"),
    ],
)
def test_flags_with_hyphens_and_underscores_and_spaces(words: tuple[str, ...]):
    config = parse(*words)
    assert (config.env, config.num_seeds, config.explorer.sac.batch_size) == ("ant_maze", 2, 64)


def test_flags_of_every_type():
    config = parse(
        *("--preset", "paper", "--sac.lr", "1e-2", "--svgd.self-weight", "0.5", "--svgd.kernel", "imq"),
        *("--dynamics.hidden", "16", "8", "--fit.no-restart", "--imagination.normalize-reward", "--backend=mjx"),
    )
    explorer = config.explorer
    assert (config.preset, config.backend, config.obs_noise) == ("paper", "mjx", 0.02)
    assert (explorer.sac.lr, explorer.svgd.self_weight, explorer.svgd.kernel) == (0.01, 0.5, "imq")
    assert (explorer.dynamics.hidden, explorer.fit.restart) == ((16, 8), False)
    assert explorer.imagination.normalize_reward
    assert explorer.sac.batch_size == 4096


def leaf_fields(config: Any, prefix: str = ""):
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from leaf_fields(value, f"{prefix}{item.name}.")
        else:
            yield f"{prefix}{item.name}", value, document(type(config))[item.name]


@pytest.mark.parametrize("preset", PRESETS)
def test_help_shows_every_setting_with_its_default(
    preset: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit) as stop:
        run.main([f"--preset={preset}", "--help=all"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 100
    plain = " ".join(re.sub(r"[│╭╮╰╯─]", " ", text).split())
    for path, value, help_text in leaf_fields(preset_config(preset)):
        name = flag(path)
        shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
        entry = plain[re.search(rf"{re.escape(name)}[ ,]", plain).start() :].split("(default: ")
        assert " ".join(help_text.split()) in entry[0], name
        assert entry[1].startswith(f"{shown})"), name
    for name in ("--out PATH", "--resume ", "--config PATH", "--version "):
        assert name in plain
    assert "--env {acrobot,ant_maze," in plain
    assert "--method {implicit," in plain
    assert "--svgd.kernel {rbf,imq}" in plain
    assert not re.search(r"\bexplorer", plain)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--env=ant_mase", r"env='ant_mase' is not known\. Did you mean 'ant_maze'\? Allowed: acrobot, ant_maze"),
        (
            "--method=implict",
            r"--method='implict' is not known\. Did you mean 'implicit'\? Allowed: .*implicit, .*random",
        ),
        ("--preset=papre", r"preset='papre' is not known\. Did you mean 'paper'\? Allowed: laptop, paper, smoke"),
        ("--backend=mjy", r"backend='mjy' .*Did you mean 'mjx'\? Allowed: auto, mjx, mujoco"),
        ("--svgd.kernel=rbff", r"--svgd\.kernel='rbff' is not known\. Did you mean 'rbf'\? Allowed: imq, rbf"),
        ("--sac.activation=rleu", r"--sac\.activation='rleu' is not known\. Did you mean 'relu'\? Allowed: leaky_relu"),
        ("--num-seeds=0", r"--num-seeds=0 is out of range\. Allowed: a whole number, 1 or more"),
        ("--obs-noise=-1", r"--obs-noise=-1\.0 is out of range\. Allowed: a finite number in \[0, inf\)"),
        ("--sac.lr=-1", r"--sac\.lr=-1\.0 is out of range\. Allowed: a finite number in \(0, inf\)"),
        ("--sac.discount=nan", r"--sac\.discount=nan is out of range"),
        ("--imagination.real-fraction=2", r"--imagination\.real-fraction=2\.0 is out of range"),
        ("--steps=9", r"--steps=9 ends within the random steps at the start\. Allowed: at least warm_up_steps=256"),
        ("--resume", r"--resume needs --out"),
        ("--resume --out=none", r"--out=none is not there"),
        ("--config=none.json", r"cannot read the configuration none\.json: .*No such file"),
        ("--sead=1", r"--sead=1 is not known\. Did you mean --seed\? Allowed: what python -m .* --help lists"),
        ("--sac.batchsize 8", r"--sac\.batchsize is not known\. Did you mean --sac\.batch-size\?"),
        ("--numseeds=8", r"--numseeds=8 is not known\. Did you mean --num-seeds\?"),
        ("ant_maze", r"ant_maze is not known\. Allowed: what"),
        ("--seed=one", r"--seed='one' is not a number\. Allowed: a whole number"),
        ("--sac.lr", r"--sac\.lr"),
    ],
)
def test_bad_flags_are_refused_and_nothing_is_written(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    try:
        status = run.main(words.split())
    except SystemExit as stop:
        status = stop.code
    assert status == 2
    told = capsys.readouterr()
    assert re.search(message, told.err)
    assert told.out == ""
    assert everything_in(tmp_path) == []


def test_preset_and_configuration_must_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "c.json"
    path.write_text(to_json(RunSpec(preset_config("smoke"))))
    assert run.main([f"--config={path}", "--preset=paper", f"--out={tmp_path / 'run'}"]) == 2
    assert re.search(r"--preset=paper disagrees with .*c\.json, which has 'smoke'", capsys.readouterr().err)
    path.write_bytes(b"\xff")
    assert run.main([f"--config={path}"]) == 2
    assert str(path) in capsys.readouterr().err
    assert everything_in(tmp_path) == ["c.json"]


def test_a_method_brings_its_own_settings_and_flags_come_on_top(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    # nnaisense/max's TVAX has alpha 0.2 and swish where all others share 0.05 and ReLU; a file that names a method has
    # settled them, one that names none has not
    shared, config = parse("--preset=smoke"), parse("--preset=smoke", "--method=max_trajectory")
    assert (shared.explorer.sac.alpha, shared.explorer.dynamics.activation) == (0.05, "relu")
    assert (config.explorer.sac.alpha, config.explorer.dynamics.activation) == (0.2, "swish")
    assert parse("--preset=smoke", "--method", "max_trajectory", "--sac.alpha=0.5").explorer.sac.alpha == 0.5
    path = tmp_path / "c.json"
    path.write_text('{"preset": "smoke", "seed": 3}')
    assert parse(f"--config={path}", "--method=max_trajectory") == dataclasses.replace(config, seed=3)
    path.write_text('{"preset": "smoke", "method": "max_trajectory", "explorer": {"sac": {"alpha": 0.5}}}')
    assert parse(f"--config={path}").explorer.sac.alpha == 0.5
    assert run.main([f"--config={path}", "--method=random", f"--out={tmp_path / 'run'}"]) == 2
    assert re.search(r"--method=random disagrees with .*c\.json, which has 'max_trajectory'", capsys.readouterr().err)
    assert everything_in(tmp_path) == ["c.json"]


def test_versions_are_told(capsys: pytest.CaptureFixture[str]):
    assert run.main(["--version"]) == 0
    told = dict(line.split(" ", 1) for line in capsys.readouterr().out.splitlines())
    assert told["python"] == ".".join(map(str, sys.version_info[:3]))
    assert {"jaxplore", "jax", "mujoco", "mujoco-mjx"} <= told.keys()
    assert "not installed" not in told.values()


def test_the_module_is_a_program_with_an_exit_status(tmp_path: Path):
    command = [sys.executable, "-m", "experiments.run", "--method=implict", f"--out={tmp_path / 'run'}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: --method='implict' is not known. Did you mean 'implicit'?")
    assert len(done.stderr.splitlines()) == 1, "and nothing else: no warnings, no traceback"
    assert everything_in(tmp_path) == []


# The place of a run.


@pytest.fixture
def small(tell, point: str, tmp_path: Path):
    """A finished run of random actions that may be written to."""
    told = tell(tmp_path / "run", *RANDOM)
    assert told.status == 0
    return told


def test_another_run_is_not_overwritten(small, tell):
    before = {path: path.read_bytes() for path in small.out.rglob("*") if path.is_file()}
    told = tell(small.out, *RANDOM)
    assert told.status == 2
    assert f"--out={small.out} holds another run. Give another directory, or --resume" in told.stderr
    assert {path: path.read_bytes() for path in small.out.rglob("*") if path.is_file()} == before


def test_other_files_are_not_mixed_with_a_run(tell, point: str, tmp_path: Path):
    (tmp_path / "thesis.txt").write_text("")
    assert "holds other files" in tell(tmp_path, *RANDOM).stderr
    told = tell(tmp_path, "--resume", *RANDOM)
    assert told.status == 2
    assert "holds no run (no config.json)" in told.stderr
    assert everything_in(tmp_path) == ["thesis.txt"]


def test_an_empty_directory_is_taken(tell, point: str, tmp_path: Path):
    assert tell(tmp_path, *RANDOM).status == 0


def test_a_run_killed_while_it_started_can_be_resumed(small, tell, tmp_path: Path):
    out = tmp_path / "killed"
    out.mkdir()
    (out / "versions.json").write_text("{}")
    (out / "config.json.tmp").write_text("{")
    told = tell(out, "--resume", *RANDOM)
    assert told.status == 0
    assert "There is no checkpoint yet: starting over" in told.stderr
    assert rows(out) == rows(small.out)


def test_resume_with_another_configuration_names_the_differences(small, tell):
    told = tell(small.out, "--resume", "--seed=4", "--sac.lr=0.5", "--method=implicit")
    assert told.status == 2
    assert (
        f"--resume: the configuration disagrees with the one saved in {small.out} in method: 'random' -> 'implicit'; "
        "seed: 0 -> 4; sac.lr: 0.001 -> 0.5. Resume with the saved values (or more steps), or start a run in another "
        "--out."
    ) in told.stderr


def test_resume_of_a_finished_run_draws_it_again(small, tell):
    (small.out / "coverage.png").unlink()
    before = {path: path.read_bytes() for path in small.out.rglob("*") if path.is_file() and path.suffix != ".png"}
    told = tell(small.out, "--resume")
    assert told.status == 0
    assert f"The run in {small.out} is finished: drawing it again." in told.stdout
    assert told.stdout.split("\n\n", 1)[1] == small.stdout.split("\n\n", 1)[1], "the same table"
    assert (small.out / "coverage.png").exists()
    after = {path: path.read_bytes() for path in small.out.rglob("*") if path.is_file() and path.suffix != ".png"}
    assert after == before


def test_resume_says_when_versions_have_changed(small, tell):
    found = json.loads((small.out / "versions.json").read_text())
    (small.out / "versions.json").write_text(json.dumps({**found, "jax": "0.1"}))
    told = tell(small.out, "--resume")
    assert told.status == 0
    assert f"Versions have changed, so not to the bit: jax: 0.1 -> {found['jax']}" in told.stderr


def test_a_damaged_walk_is_named(small, tell):
    (small.out / "walk.npz").write_bytes(b"PK")
    told = tell(small.out, "--resume")
    assert told.status == 1
    assert str(small.out / "walk.npz") in told.stderr
    assert "remove it, and finish with --resume" in told.stderr
    (small.out / "walk.npz").unlink()
    assert tell(small.out, "--resume").status == 0


# A run that fails.


def test_a_place_that_cannot_be_written_is_named(tell, point: str, tmp_path: Path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "run"):
        told = tell(out, *RANDOM)
        assert told.status == 1
        assert f"error: cannot start the run in {out}: " in told.stderr
        assert "a file stands where a directory is needed" in told.stderr
    assert everything_in(tmp_path) == ["file"]


def test_a_place_that_cannot_be_read_is_named(tell, point: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(self: Path):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    told = tell(tmp_path, *RANDOM)
    assert told.status == 2
    assert f"error: cannot look for a run in {tmp_path}: Permission denied" in told.stderr


def full_disk(*_: Any, **__: Any):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(("what", "last"), [("metrics", 50), ("checkpoint", 50), ("walk", 60), ("picture", 60)])
def test_a_full_disk_ends_the_run_and_spares_the_last_checkpoint(
    what: str, last: int, small, tell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out = tmp_path / "full"
    append, save = metrics.MetricsLog.append, Checkpoints.save
    with monkeypatch.context() as patch:

        def append_until_full(self, told):
            if told[0]["step"] == 60:
                patch.setattr(os, "write", full_disk)
            append(self, told)

        def save_until_full(self, step, *rest):
            if step == 60:
                patch.setattr(os, "fsync", full_disk)
            save(self, step, *rest)

        if what == "metrics":
            patch.setattr(metrics.MetricsLog, "append", append_until_full)
        elif what == "checkpoint":
            patch.setattr(Checkpoints, "save", save_until_full)
        elif what == "walk":
            patch.setattr(np, "savez_compressed", full_disk)
        else:
            patch.setattr("matplotlib.figure.Figure.savefig", full_disk)
        told = tell(out, *RANDOM)
    assert told.status == 1
    (line,) = [line for line in told.stderr.splitlines() if line.startswith("error: ")]
    assert re.search(rf"cannot .* in {re.escape(str(out))}.*: No space left on device\. What to do: free some", line)
    assert "Traceback" not in told.stderr
    assert Checkpoints(out / "checkpoints").steps()[-1] == last
    leaves(out, last)
    assert (out / "walk.npz").exists() == (what == "picture")
    assert tell(out, "--resume").status == 0
    assert_same_run(small.out, out, 60)
    assert not list(out.rglob("*.tmp*"))


def test_ctrl_c_says_how_to_go_on(tell, point: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    out = tmp_path / "a run"

    def interrupt(*_: Any):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(console.Progress, "update", interrupt)
        told = tell(out, *RANDOM)
    assert told.status == 130
    (line,) = [line for line in told.stderr.splitlines() if line.startswith("Stopped.")]
    words = shlex.split(line.partition("experiments.run ")[2])
    assert words == [f"--out={out}", "--resume"]
    assert "Traceback" not in told.stderr
    assert tell(out, *words[1:]).status == 0


def test_an_error_in_the_program_is_not_taken_for_bad_input(
    tell, point: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def broken(*_: Any):
        raise ValueError("a bug")

    monkeypatch.setattr(record, "rows", broken)
    with pytest.raises(ValueError, match="a bug"):
        tell(tmp_path / "run", *RANDOM)


@pytest.fixture
def fragile(monkeypatch: pytest.MonkeyPatch):
    """`fragile(breaks, *seeds)`: a method whose numbers break at step 50, in those seeds of a run of two."""

    def make(breaks: str, *seeds: int) -> None:
        def signal(sizes, config):
            def update(key, state, data, normalizers):
                bad = jnp.where((data.size >= 50) & state["breaks"], jnp.inf, 0.0)
                report = {"loss": 1.0 + (bad if breaks == "metric" else 0.0)}
                return {**state, "value": state["value"] + 1.0 + (bad if breaks == "state" else 0.0)}, report

            def init(key):
                return {"value": jnp.zeros(()), "breaks": jnp.zeros((), bool)}

            belief = beliefs.Belief(init, update, lambda key, state, num: (), None, fit_config=config.fit)
            return TASK._replace(belief=belief)

        row = Method("breaks", signal, methods.uniform_actions)
        monkeypatch.setitem(methods.METHODS, "fragile", row)
        original = run.make_programs

        def make_programs(config, env, explorer):
            programs = original(config, env, explorer)

            def init():
                state = programs.init()
                broken = jnp.array([seed in seeds for seed in range(config.seed, config.seed + config.num_seeds)])
                own = {**state.explorer.belief, "breaks": broken}
                return dataclasses.replace(state, explorer=dataclasses.replace(state.explorer, belief=own))

            return programs._replace(init=init)

        monkeypatch.setattr(run, "make_programs", make_programs)

    return make


FRAGILE = ("--env=point", "--method=fragile")
QUANTITIES = {"metric": "fit/loss", "state": "the state of the belief"}


@pytest.mark.parametrize("breaks", QUANTITIES)
def test_numbers_that_are_not_finite_end_the_run(breaks: str, fragile, tell, point: str, tmp_path: Path):
    fragile(breaks, 0, 1)
    out = tmp_path / "run"
    told = tell(out, *FRAGILE, "--num-seeds=2", *TINY)
    assert told.status == 1
    assert (
        f"error: the round of steps 31 to 50 came out with numbers that are not finite: {QUANTITIES[breaks]} "
        f"(seed 0, 1). The state before it is saved in {out / 'checkpoints'}. What to do: "
    ) in told.stderr
    assert "smaller learning rate, such as --fit.lr" in told.stderr
    assert [row["step"] for row in rows(out)] == [25, 25, 31, 31, 50, 50]
    assert [row.get("diverged") for row in rows(out)] == [None] * 4 + [QUANTITIES[breaks]] * 2
    assert RunDirectory(out).status() is Status.DIVERGED
    assert Checkpoints(out / "checkpoints").steps()[-1] == 31
    saved = leaves(out, 31)
    sizes, values = (
        np.frombuffer(saved[name][3], dtype)
        for name, dtype in (("explorer.data.size", np.int32), ("explorer.belief.value", np.float32))
    )
    np.testing.assert_array_equal(sizes, [31, 31])
    np.testing.assert_array_equal(values, [2.0, 2.0])
    again = tell(out, "--resume")
    assert again.status == 2
    assert "every seed came out with numbers that are not finite" in again.stderr


def test_a_seed_that_diverges_stops_alone(fragile, tell, point: str, tmp_path: Path):
    # seed 1 breaks at step 50: its last row says so, and seed 0 ends as if it had not been there, to the bit
    fragile("metric", 1)
    alone, both = tmp_path / "alone", tmp_path / "both"
    assert tell(alone, *FRAGILE, *TINY).status == 0
    told = tell(both, *FRAGILE, "--num-seeds=2", *TINY)
    assert told.status == 0
    assert "Seed 1 stops at step 50: numbers that are not finite (fit/loss). The others continue." in told.stderr
    assert "seed 1 diverged at step 50: not finite was fit/loss" in told.stdout
    assert [row["step"] for row in rows(both) if row["seed"] == 1] == [25, 31, 50]
    assert [row["step"] for row in rows(both) if "diverged" in row] == [50]
    assert [row for row in rows(both) if row["seed"] == 0] == rows(alone)
    assert RunDirectory(both).status() is Status.FINISHED
    outcome = json.loads((both / "outcome.json").read_text())
    assert outcome == {"status": "finished", "diverged": {"1": {"step": 50, "what": "fit/loss"}}}
    # and so it is when the run is resumed after that
    (both / "walk.npz").unlink()
    assert tell(both, "--resume").status == 0
    assert json.loads((both / "outcome.json").read_text()) == outcome


def test_numbers_are_looked_at_by_name():
    finite = {"a": np.array([True, False]), "b": np.array([True, True]), "c": np.array([True, False])}
    assert record.broken(finite, np.array([True, True])) == [[], ["a", "c"]]
    assert record.broken(finite, np.array([True, False])) == [[], []]
    error = record.diverged_error(RunDirectory("run"), ["a", "c"], [6], (50, 75))
    assert re.search(r"steps 50 to 75 came out with numbers that are not finite: a, c \(seed 6\)", str(error))


def test_a_dying_generator_is_warned_of_once():
    rows = [{"fit/dead_features": 0.2}, {"fit/dead_features": 0.94}]
    assert re.match(r"warning: 94% of .*--generator\.activation=tanh", record.dying(rows))
    assert record.dying(rows[:1]) == record.dying([{}]) == record.dying([]) == ""
    one = {"variance": 4.0, "variance_within": 0.1}
    assert re.match(r"warning: .* make 2\.5% of the variance .*--svgd\.batches=shared", record.dying([one]))
    assert " make 0.0% of the variance " in record.dying([one | {"variance_within": 0.0}])
    assert record.dying([one | {"variance_within": 1.0}]) == record.dying([{"variance": 4.0}]) == ""
    said: list[str] = []
    session: Any = loop.Session.__new__(loop.Session)
    session._announced, session.progress = set(), types.SimpleNamespace(say=said.append)
    for found in (rows[:1], rows, rows):
        session._say_once("dying", record.dying(found))
    assert len(said) == 1


def test_steps_that_diverged_are_dropped_counted_and_told(tell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A point whose 5th step of each episode of 5 leads nowhere: 60 steps of two seeds have 12 such each."""

    def make_broken(backend: str = "auto", obs_noise: float = 0.0):
        env = make_point()

        def step(state, action):
            after, transition = env.step(state, action)
            broken = after.num_steps >= 5
            next_obs = jnp.where(broken, jnp.nan, transition.next_obs)
            return after, transition._replace(next_obs=next_obs, terminated=broken)

        return dataclasses.replace(env, step=step)

    monkeypatch.setitem(envs.FACTORIES, "point", make_broken)
    told = tell(tmp_path / "run", *RANDOM, "--num-seeds=2")
    assert told.status == 0
    assert [row["dropped"] for row in rows(told.out)] == [5, 5, 1, 1, 4, 4, 2, 2]
    assert "24 steps dropped: physics that diverged" in told.stdout
