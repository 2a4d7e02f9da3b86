import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from envs import views

SCREEN = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
ROOT = Path(__file__).parent.parent.parent
PICTURE = """
import os, gymnasium, envs
env = gymnasium.make("jaxplore/AntMaze-v0", render_mode="rgb_array", backend="mujoco", height=64, width=64)
env.reset(seed=0)
picture = env.render()
print(os.environ["MUJOCO_GL"], picture.shape, picture.std() > 10)
"""


@pytest.fixture
def nothing_works(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """No renderer draws, and there is no screen; which ones have been tried."""
    tried = []

    def fail(command, env, **_):
        tried.append(env["MUJOCO_GL"])
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(subprocess, "run", fail)
    for name in SCREEN:
        monkeypatch.delenv(name, raising=False)
    return tried


def first_frame() -> np.ndarray:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    view = views.make_mujoco_view(model, lambda state: [], ())
    return next(iter(view.frames([None], 8, 8, views.FREE)))  # type: ignore[list-item]


def test_without_any_renderer_all_are_tried(nothing_works: list[str]):
    with pytest.raises(RuntimeError, match=r"No renderer works here\. What to do: install a renderer.*libosmesa6"):
        views.find_renderer()
    assert nothing_works == list(views.RENDERERS)


def test_one_that_is_wanted_is_the_only_one_tried(nothing_works: list[str]):
    with pytest.raises(RuntimeError, match=r"MUJOCO_GL=egl does not work here\..*or set MUJOCO_GL to one that"):
        views.find_renderer("egl")
    assert nothing_works == ["egl"]


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a screen")
def test_without_a_screen_a_picture_says_in_a_line_what_to_set(nothing_works: list[str]):
    with pytest.raises(RuntimeError, match="set MUJOCO_GL to one that this machine has: egl, osmesa or glfw") as error:
        first_frame()
    assert nothing_works == list(views.RENDERERS)
    assert len(str(error.value).splitlines()) == 1
    assert "MUJOCO_GL" not in os.environ


def test_a_renderer_that_fails_says_in_a_line_what_to_set(monkeypatch: pytest.MonkeyPatch):
    def broken(*_):
        raise mujoco.FatalError("no platform library\nand more")  # type: ignore[attr-defined]

    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(mujoco, "Renderer", broken)
    with pytest.raises(RuntimeError, match=r"^MUJOCO_GL=glfw does not work here: no platform library\. What to do"):
        first_frame()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a screen")
def test_gymnasium_finds_a_renderer_without_a_screen():
    try:
        found = views.find_renderer()
    except RuntimeError as error:
        pytest.skip(str(error))
    no_screen = {name: value for name, value in os.environ.items() if name not in SCREEN}
    command = [sys.executable, "-c", PICTURE]
    done = subprocess.run(command, cwd=ROOT, env=no_screen, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"{found} (64, 64, 3) True\n"
