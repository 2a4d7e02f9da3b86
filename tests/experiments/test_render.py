import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments import render
from experiments.runs.errors import RunError
from tests.experiments.tiny import ROOT


def command(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "experiments.render", *map(str, words)],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=280,
    )


@pytest.fixture(scope="module")
def renderer() -> str:
    try:
        return render.find_renderer()
    except RunError as error:
        pytest.skip(f"no video can be drawn on this machine: {error}")


def test_a_run_becomes_a_video(finished, renderer: str, tmp_path: Path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg: the extra `render`")
    before = sorted(path.name for path in finished.out.iterdir())
    path = tmp_path / "ant.mp4"
    size = ("--size", 120, 160)
    done = command(finished.out, "--steps=20", "--camera=overview", *size, f"--out={path}", MUJOCO_GL=renderer)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"implicit on ant_maze after 81 steps, 20 steps of acting: {path}\n"
    assert done.stderr == ""
    assert [entry.name for entry in tmp_path.iterdir()] == ["ant.mp4"]
    assert sorted(path.name for path in finished.out.iterdir()) == before, "the run is as it was"
    assert ffmpeg.count_frames_and_secs(path) == (21, pytest.approx(21 / 20)), "in real time"
    decode = [ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    pixels = subprocess.run(decode, stdout=subprocess.PIPE, check=True).stdout
    frames = np.frombuffer(pixels, np.uint8).reshape(21, 120, 160, 3)
    # Seen from above: blue walls around a pale floor, and something that moves on it.
    assert frames[0, :, 60:100].astype(int)[..., 2].mean() > 100
    red, _, blue = np.moveaxis(frames[0].astype(int), -1, 0)
    assert 0.2 < np.mean(blue > red + 25) < 0.8
    assert np.abs(frames[-1].astype(int) - frames[0]).max() > 60


def test_a_renderer_that_does_not_work_is_said_with_what_to_install(finished):
    for name in ("nonsense", "off"):
        done = command(finished.out, MUJOCO_GL=name)
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr.startswith(f"error: MUJOCO_GL={name} does not work here. What to do: install a renderer")
        assert "apt-get install libosmesa6" in done.stderr
        assert len(done.stderr.splitlines()) == 1


def test_without_any_renderer_all_are_tried(monkeypatch: pytest.MonkeyPatch):
    tried = []

    def fail(command, env, **_):
        tried.append(env["MUJOCO_GL"])
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(subprocess, "run", fail)
    with pytest.raises(RunError, match=r"No renderer works here\. What to do: install a renderer.*libosmesa6"):
        render.find_renderer()
    assert tried == list(render.RENDERERS)


def test_without_imageio_it_is_named(finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(RunError, match=r'pip install -e "\.\[render\]"'):
        render.draw(tmp_path / "a.mp4", None, [], camera="track", height=16, width=16)  # type: ignore[arg-type]


def test_what_holds_no_run_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for place in (tmp_path, tmp_path / "none"):
        assert render.main([str(place)]) == 1
        assert capsys.readouterr().err == f"error: {place} holds no run (no config.json). Give the --out of a run.\n"


def test_a_run_without_a_checkpoint_is_said(finished, tmp_path: Path):
    (tmp_path / "config.json").write_bytes((finished.out / "config.json").read_bytes())
    with pytest.raises(RunError, match="has no checkpoint yet: let it run for 20 steps"):
        render.load_actor(tmp_path)


def test_an_environment_without_looks_is_said(point: str, tmp_path: Path):
    (tmp_path / "config.json").write_text('{"env": "point"}')
    with pytest.raises(RunError, match="point has nothing to draw"):
        render.load_actor(tmp_path)


def test_the_agent_acts_as_it_was_saved(finished):
    config, env, act, step = render.load_actor(finished.out)
    assert (config.env, env.compiled, step) == ("ant_maze", False, 81)

    def observed(seed: int) -> np.ndarray:
        return np.stack([state.obs for state in render.episode(env, act, seed, num_steps=5)])

    assert observed(1).shape == (6, 31)
    np.testing.assert_array_equal(observed(1), observed(1))
    assert not np.array_equal(observed(1), observed(2))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--steps=0",), "--steps=0. Allowed: 1 or more"),
        (("--seed=-1",), "--seed=-1. Allowed: 0 or more"),
        (("--size", "4000", "640"), "--size=4000 640. Allowed: even numbers from 16 to 1280"),
        (("--env=ant_maze",), "give the directory of a run, or --env"),
    ],
)
def test_bad_flags_are_refused(words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        render.main(["run", *words])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
