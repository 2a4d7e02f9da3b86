import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from envs import views
from experiments import render
from experiments.analysis import video
from experiments.runs.errors import RunError
from tests.experiments.tiny import ROOT, make_point


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
        return views.find_renderer()
    except RuntimeError as error:
        pytest.skip(f"no video can be drawn on this machine: {error}")


def test_a_run_becomes_a_video(finished, renderer: str, tmp_path: Path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg: the extra `render`")
    before = sorted(path.name for path in finished.out.iterdir())
    path = tmp_path / "ant.mp4"
    size = ("--size", 120, 160)
    done = command(finished.out, "--steps=20", "--camera=overview", *size, f"--out={path}", MUJOCO_GL=renderer)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"implicit on ant_maze after 81 steps, 20 steps of acting: {path}\n"
    # A machine that is busy takes long enough for progress to be told.
    assert all(line.startswith("drawing") for line in done.stderr.splitlines()), done.stderr
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


def test_without_imageio_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(RunError, match=r'pip install -e "\.\[render\]"'):
        video.check_target(tmp_path / "a.mp4")


def test_what_cannot_be_written_is_said_before_anything_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for name in ("load_random", "use_renderer", "episode"):
        monkeypatch.setattr(render, name, lambda *_: pytest.fail("it has begun"))
    (tmp_path / "taken.png").mkdir()
    (tmp_path / "file").write_text("")
    said = []
    for name in ("none/a.gif", "taken.png", "file/a.mp4"):
        assert render.main(["--env=acrobot", f"--out={tmp_path / name}"]) == 1
        said.append(capsys.readouterr().err)
    assert said[0].startswith(f"error: cannot write the picture {tmp_path}/none/a.gif: {tmp_path}/none is no directory")
    assert said[1].startswith(f"error: cannot write the picture {tmp_path}/taken.png: a directory has that name")
    assert said[2].startswith(f"error: cannot write the picture {tmp_path}/file/a.mp4: {tmp_path}/file is no directory")
    assert render.main(["--env=acrobot", "--camera=top", f"--out={tmp_path}/a.gif"]) == 1
    assert capsys.readouterr().err == "error: --camera='top' is not known. Allowed: sketch.\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "taken.png"]


def test_a_disk_that_refuses_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    with pytest.raises(RunError, match=r"a\.mp4: Permission denied\. What to do: make it writable"):
        video.check_target(tmp_path / "a.mp4")


def test_what_holds_no_run_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for place in (tmp_path, tmp_path / "none"):
        assert render.main([str(place)]) == 1
        assert capsys.readouterr().err == f"error: {place} holds no run (no config.json). Give the --out of a run.\n"


def test_a_run_without_a_checkpoint_is_said(finished, tmp_path: Path):
    (tmp_path / "config.json").write_bytes((finished.out / "config.json").read_bytes())
    config = render.config_of(tmp_path)
    with pytest.raises(RunError, match="has no checkpoint yet: let it run for 20 steps"):
        render.load_actor(tmp_path, config, render.load_env(config)[0])


def test_an_environment_without_looks_is_said(point: str):
    with pytest.raises(RunError, match="point has nothing to draw"):
        render.load_env(render.random_config(point))


def test_the_agent_acts_as_it_was_saved(finished):
    config = render.config_of(finished.out)
    own_env, env = render.load_env(config)
    act, step = render.load_actor(finished.out, config, own_env)
    assert (config.env, env.compiled, step) == ("ant_maze", False, 81)

    def observed(seed: int) -> np.ndarray:
        return np.stack([state.obs for state in render.episode(env, act, seed, num_steps=5)])

    assert observed(1).shape == (6, 31)
    np.testing.assert_array_equal(observed(1), observed(1))
    assert not np.array_equal(observed(1), observed(2))


def test_the_last_state_is_of_the_episode_that_ends():
    states = render.episode(make_point(), lambda key, obs: np.ones(2, np.float32), 0, num_steps=42)
    assert [int(state.num_steps) for state in states] == [*range(21), *range(1, 21), 1, 2]
    # Pushed one way all the time: it is never further than at an episode's end.
    x = np.array([state.obs[0] for state in states])
    assert x.argmax() in (20, 40) and x[20] > x[19] and x[40] > x[39]


def test_physics_that_diverges_stands_still():
    env = make_point()

    def push(key: jax.Array, obs: np.ndarray) -> np.ndarray:
        return np.full(2, np.nan if push.calls.pop(0) else 1.0, np.float32)

    push.calls = [False, True, False]
    states = render.episode(env, push, 0, num_steps=3)
    assert len(states) == 4
    assert states[2] is states[1]


@pytest.mark.parametrize(
    ("suffix", "num", "dt", "places", "lengths"),
    [
        (".mp4", 3, 0.05, [0, 1, 2], [0.05] * 3),
        (".gif", 3, 0.05, [0, 1, 2], [0.05] * 3),
        (".gif", 3, 1 / 30, [0, 1, 2], [0.03, 0.04, 0.03]),
        (".gif", 4, 1 / 100, [1, 3], [0.02, 0.02]),
        (".gif", 1, 1 / 100, [0], [0.02]),
        (".png", 301, 0.05, [0, 100, 200, 300], [0.05] * 4),
        (".png", 2, 0.05, [0, 1], [0.05] * 2),
    ],
)
def test_when_what_is_shown(suffix: str, num: int, dt: float, places: list[int], lengths: list[float]):
    timing = video.timing(suffix, num, dt)
    assert list(timing.places) == places
    np.testing.assert_allclose(timing.lengths, lengths)


@pytest.mark.parametrize("dt", [1 / 125, 1 / 60, 1 / 30, 0.05, 0.2, 1.0])
def test_gifs_play_in_real_time(dt: float):
    timing = video.timing(".gif", 301, dt)
    assert timing.places[-1] == 300
    assert min(timing.lengths) >= 0.02
    starts = np.cumsum([0.0, *timing.lengths[:-1]]) + dt * timing.places[0]
    np.testing.assert_allclose(starts, dt * np.array(timing.places), atol=0.0101)


def test_a_gif_repeats_forever(tmp_path: Path):
    frames = [np.full((16, 16, 3), shade, np.uint8) for shade in (0, 100, 200)]
    video.write(tmp_path / "a.gif", iter(frames), [0.03, 0.04, 0.2])
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.info["loop"]) == (3, 0)
        shown = []
        for frame in range(3):
            image.seek(frame)
            shown.append((image.info["duration"], image.convert("L").getpixel((8, 8))))
    assert shown == [(30, 0), (40, 100), (200, 200)]


def test_stills_stand_side_by_side(tmp_path: Path):
    frames = [np.full((16, 20, 3), shade, np.uint8) for shade in (0, 100, 200)]
    video.write(tmp_path / "a.png", iter(frames), [0.05] * 3)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (60, 16)
        assert [image.getpixel((x, 8)) for x in (0, 30, 59)] == [(0, 0, 0), (100, 100, 100), (200, 200, 200)]


@pytest.mark.skipif(os.name != "posix", reason="signals to a group of processes")
def test_ctrl_c_gives_a_line_and_leaves_nothing(tmp_path: Path):
    words = ("--env=acrobot", "--steps=1000", "--size", "480", "640", f"--out={tmp_path}/a.mp4")
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.render", *words],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not any(path.stat().st_size for path in tmp_path.iterdir()):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    # As a terminal does it: also to ffmpeg.
    os.killpg(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert (process.returncode, stdout) == (130, "")
    assert stderr.strip().splitlines()[-1] == "Stopped."
    assert "Traceback" not in stderr and "error" not in stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--steps=0",), "--steps=0. Allowed: 1 or more"),
        (("--seed=-1",), "--seed=-1. Allowed: 0 or more"),
        (("--size", "4000", "640"), "--size=4000 640. Allowed: even numbers from 16 to 1280"),
        (("--env=ant_maze",), "give the directory of a run, or --env"),
        (("--out=a.avi",), "--out=a.avi. Allowed: a name that ends in .mp4, .gif, .png"),
    ],
)
def test_bad_flags_are_refused(words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        render.main(["run", *words])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
