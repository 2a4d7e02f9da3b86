"""Ways to draw an environment: MuJoCo's own renderer, and sketches of what has no MuJoCo model."""
# pyright: reportAttributeAccessIssue=false
# mujoco ships no stubs.

import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import numpy as np

from envs.base import EnvState, View

SKETCH_DPI = 100
FREE = "free"

RENDERERS = ("egl", "osmesa", "cgl", "glfw")
"""MuJoCo's, tried in this order unless `MUJOCO_GL` names one: a GPU, no GPU, a Mac, a screen."""

INSTALL_RENDERER = (
    "What to do: install a renderer that needs no screen, such as Mesa's (Debian and Ubuntu: apt-get install "
    "libosmesa6; Fedora: dnf install mesa-libOSMesa; with a GPU: its driver and libegl1), or set MUJOCO_GL to one that "
    "this machine has: egl, osmesa or glfw."
)

PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
mujoco.Renderer(model, 8, 8).render()
"""


def find_renderer(wanted: str | None = None) -> str:
    """The first of `RENDERERS` that draws here, or the one that is wanted.

    Raises:
        RuntimeError: none does; says what to install or to set.
    """
    for name in (wanted,) if wanted else RENDERERS:
        # In a process of its own: a driver may crash, and one that has failed cannot be followed by another.
        command = [sys.executable, "-c", PROBE]
        if not subprocess.run(command, env={**os.environ, "MUJOCO_GL": name}, capture_output=True).returncode:
            return name
    failed = f"MUJOCO_GL={wanted} does not work here." if wanted else "No renderer works here."
    raise RuntimeError(f"{failed} {INSTALL_RENDERER}")


def use_renderer(wanted: str | None = None) -> None:
    """Have MuJoCo, which may have been imported already, draw with what `find_renderer` finds, in this process and in
    those that it starts. Before the first picture: MuJoCo stays with what has drawn one. Raises as `find_renderer`.
    """
    import mujoco

    os.environ["MUJOCO_GL"] = find_renderer(wanted)
    # It reads the variable when it is imported.
    importlib.reload(sys.modules[mujoco.Renderer.__module__].gl_context)


def _has_screen() -> bool:
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def make_mujoco_view(model: Any, qpos: Callable[[EnvState], Any], cameras: tuple[str, ...]) -> View:
    """MuJoCo's renderer. It takes an OpenGL library: the one that `MUJOCO_GL` names or, where that is not set and there
    is no screen, the first that works without. Drawing raises `RuntimeError` where none does.

    Args:
        model: a `mujoco.MjModel`.
        qpos: `qpos(state) -> [nq]`, the model's positions in a state.
        cameras: names of the model's cameras, the usual one first. With none, `"free"`: one that sees all of the model.
    """
    usual = cameras or (FREE,)

    def frames(states: Iterable[EnvState], height: int, width: int, camera: str) -> Iterator[np.ndarray]:
        import mujoco

        if not os.environ.get("MUJOCO_GL") and not _has_screen():
            use_renderer()
        data = mujoco.MjData(model)
        with _open(model, height, width) as renderer:
            for state in states:
                data.qpos[:] = jax.device_get(qpos(state))
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, camera=camera if cameras else -1)
                yield renderer.render()

    return View(frames, usual, True)


def _open(model: Any, height: int, width: int) -> Any:
    """MuJoCo's renderer, or one line that says why there is none."""
    import mujoco

    try:
        return mujoco.Renderer(model, height, width)
    except ValueError:  # A picture larger than the model allows.
        raise
    except Exception as error:  # Each library raises its own.
        named = os.environ.get("MUJOCO_GL")
        failed = f"MUJOCO_GL={named} does not work here" if named else "no renderer works here"
        raise RuntimeError(f"{failed}: {str(error).splitlines()[0]}. {INSTALL_RENDERER}") from error


def light_gymnasium_floor(spec: Any) -> None:
    """Softer light, and a pale floor of 1 m squares, for a `mujoco.MjSpec` made from one of Gymnasium's files. For
    pictures only: physics does not see it.
    """
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 1280
    spec.visual.headlight.ambient = (0.35, 0.35, 0.35)
    spec.visual.headlight.diffuse = (0.25, 0.25, 0.25)
    for light in spec.lights:
        light.diffuse = (0.45, 0.45, 0.45)
    checker, floor = spec.texture("texplane"), spec.material("MatPlane")
    checker.rgb1, checker.rgb2 = (0.93, 0.94, 0.95), (0.82, 0.84, 0.86)
    floor.texrepeat, floor.reflectance, floor.specular = (40, 40), 0.0, 0.0
    spec.geom("floor").rgba = (1.0, 1.0, 1.0, 1.0)


def make_sketch_view(limits: tuple[float, float, float, float], draw: Callable[[Any, EnvState], None]) -> View:
    """Drawn with matplotlib, on empty axes of equal scale.

    Args:
        limits: `(x_min, x_max, y_min, y_max)` of what is seen; the rest of the picture's shape is filled.
        draw: `draw(axes, state)` draws one state, of NumPy arrays, onto matplotlib axes.
    """

    def frames(states: Iterable[EnvState], height: int, width: int, camera: str) -> Iterator[np.ndarray]:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width / SKETCH_DPI, height / SKETCH_DPI), dpi=SKETCH_DPI)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        x_min, x_max, y_min, y_max = limits
        # Not matplotlib's own equal aspect: it may cut one axis instead of widening the other.
        pixel = max((x_max - x_min) / width, (y_max - y_min) / height)
        x_centre, y_centre = (x_min + x_max) / 2, (y_min + y_max) / 2
        for state in states:
            axes.clear()
            axes.set_axis_off()
            axes.set_xlim(x_centre - pixel * width / 2, x_centre + pixel * width / 2)
            axes.set_ylim(y_centre - pixel * height / 2, y_centre + pixel * height / 2)
            # Keys are no NumPy arrays, and no picture needs one.
            draw(axes, jax.device_get(state.replace(key=())))
            canvas.draw()
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()

    return View(frames, ("sketch",), False)
