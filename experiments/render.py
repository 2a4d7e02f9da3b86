"""`python -m experiments.render RUN`: a video or a picture of a run's agent acting in its environment."""

# MuJoCo loads its GL library when it is imported, and fails to be imported where that one does not work. So what
# imports MuJoCo is imported late, once a renderer has been found.
# pyright: reportAttributeAccessIssue=false
# mujoco and imageio ship no stubs.
from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import replacing

if TYPE_CHECKING:
    from envs.base import Environment, EnvState
    from envs.stepper import Act
    from experiments.runs.config import RunConfig

RENDERERS = ("egl", "osmesa", "cgl", "glfw")
"""MuJoCo's, tried in this order unless `MUJOCO_GL` names one: a GPU, no GPU, a Mac, a screen."""

SUFFIXES = (".mp4", ".gif", ".png")
STILLS = 4
"""Moments in one picture."""

INSTALL_RENDERER = (
    "What to do: install a renderer that needs no screen, such as Mesa's (Debian and Ubuntu: apt-get install "
    "libosmesa6; Fedora: dnf install mesa-libOSMesa; with a GPU: its driver and libegl1), or set MUJOCO_GL to one that "
    "this machine has: egl, osmesa or glfw."
)
INSTALL_WRITER = 'A video needs imageio and its ffmpeg. What to do: pip install -e ".[render]".'

PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
mujoco.Renderer(model, 8, 8).render()
"""


def find_renderer() -> str:
    """The first of `RENDERERS` that draws here, or the one that `MUJOCO_GL` names.

    Raises:
        RunError: none does; says what to install.
    """
    wanted = os.environ.get("MUJOCO_GL")
    for name in (wanted,) if wanted else RENDERERS:
        # In a process of its own: MuJoCo cannot change its mind, and a driver may crash.
        command = [sys.executable, "-c", PROBE]
        if not subprocess.run(command, env={**os.environ, "MUJOCO_GL": name}, capture_output=True).returncode:
            return name
    failed = f"MUJOCO_GL={wanted} does not work here." if wanted else "No renderer works here."
    raise RunError(f"{failed} {INSTALL_RENDERER}")


def load_actor(run: Path) -> tuple[RunConfig, Environment, Act, int]:
    """The agent of a run's latest checkpoint.

    Returns:
        The run's configuration, its environment with physics on the host where it has the choice, an
        `act(key, obs) -> action`, and the checkpoint's step.

    Raises:
        RunError: `run` holds no run or no checkpoint, or its environment cannot be drawn.
    """
    import jax

    from experiments.runs.directory import RunDirectory
    from experiments.runs.status import Status
    from experiments.training import build, loop

    directory = RunDirectory(run)
    if directory.status() is Status.ABSENT:
        raise RunError(f"{run} holds no run (no config.json). Give the --out of a run.")
    config = directory.config()
    own_env = build.make_env(config)
    env = build.on_host(config, own_env)
    _check_view(env, config.env)
    explorer = build.make_agent(config, own_env)
    state, step = loop.last_state(directory, own_env, explorer)
    actor = explorer.actor(jax.tree.map(lambda leaf: leaf[0], state.explorer))
    act = jax.jit(lambda key, obs: explorer.act(key, actor, obs))
    return config, env, act, step


def load_random(name: str) -> tuple[RunConfig, Environment, Act]:
    """An environment by its name, and uniform actions.

    Raises:
        ValueError: there is no such environment.
        RunError: it cannot be drawn.
    """
    import jax

    from experiments.runs.presets import preset_config
    from experiments.training import build

    config = dataclasses.replace(preset_config("laptop", name), method="random")
    env = build.make_env(config)
    env = build.on_host(config, env)
    _check_view(env, name)
    return config, env, jax.jit(build.make_agent(config, env).act_uniformly)


def _check_view(env: Environment, name: str) -> None:
    if env.view is None:
        raise RunError(f"{name} has nothing to draw: its environment has no view.")


def episode(env: Environment, act: Act, seed: int, num_steps: int) -> list[EnvState]:
    """The states of `num_steps` of acting, `num_steps + 1` of them, episode after episode."""
    import jax

    from envs.stepper import make_walk

    walk = make_walk(env, 1)
    key = jax.random.key(seed)
    states = [env.reset(jax.random.fold_in(key, 0))]
    for step in range(num_steps):
        states.append(walk(jax.random.fold_in(key, step + 1), states[-1], act, 1)[0])
    return states


def draw(
    path: Path, env: Environment, states: Sequence[EnvState], *, camera: str | None, height: int, width: int
) -> None:
    """Draw states and write them, whole or not at all.

    Args:
        path: a video in real time (`.mp4`, `.gif`), or one picture (`.png`) of `STILLS` states, evenly spaced.
        env: whose states they are; it has a view.
        states: what to draw.
        camera: one of the view's; its first by default.
        height: of a frame, pixels.
        width: of a frame, pixels.

    Raises:
        RunError: no video writer, or the file cannot be written.
        ValueError: the view has no such camera, or nothing is known that ends like `path`.
    """
    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise RunError(INSTALL_WRITER) from error
    from jaxplore import validate

    assert env.view is not None
    camera = camera or env.view.cameras[0]
    validate.one_of("--camera", camera, env.view.cameras)
    validate.one_of("the ending of --out", path.suffix, SUFFIXES)
    try:
        with replacing(path) as draft:
            if path.suffix == ".png":
                places = np.linspace(0, len(states) - 1, min(STILLS, len(states))).round().astype(int)
                stills = list(env.view.frames([states[i] for i in places], height, width, camera))
                imageio.imwrite(draft, np.concatenate(stills, axis=1))
                return
            options: dict[str, Any] = (
                {"fps": round(1 / env.spec.dt), "macro_block_size": 2} if path.suffix == ".mp4" else {}
            )
            # JAX warns of the fork that starts ffmpeg; nothing but ffmpeg runs in it.
            with (
                warnings.catch_warnings(action="ignore", category=RuntimeWarning),
                imageio.get_writer(draft, **options) as writer,
            ):
                for frame in env.view.frames(states, height, width, camera):
                    writer.append_data(frame)
    except OSError as error:
        raise disk_error("write the picture", path, error) from error


def main(argv: Sequence[str] | None = None) -> int:
    """Draw a video; the exit status is 0, 1 with a message, or 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m experiments.render", description=__doc__)
    parser.add_argument("run", type=Path, nargs="?", help="directory of a run")
    parser.add_argument("--env", help="instead of a run: an environment, to see it under uniform actions")
    parser.add_argument("--seed", type=int, default=0, help="of the start and of what the agent draws (default: 0)")
    parser.add_argument("--steps", type=int, help="steps to act (default: one episode)")
    parser.add_argument("--camera", help="where to look from; the ant's: track, overview (default: the usual one)")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(480, 640), metavar=("HEIGHT", "WIDTH"), help="(default: 480 640)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        help=f"the video to write: .mp4, .gif, or a .png of {STILLS} moments (default: RUN/CAMERA.mp4, ENV.mp4)",
    )
    arguments = parser.parse_args(argv)
    if arguments.seed < 0:
        parser.error(f"--seed={arguments.seed}. Allowed: 0 or more.")
    if arguments.steps is not None and arguments.steps < 1:
        parser.error(f"--steps={arguments.steps}. Allowed: 1 or more.")
    if any(not 16 <= size <= 1280 or size % 2 for size in arguments.size):
        parser.error(f"--size={' '.join(map(str, arguments.size))}. Allowed: even numbers from 16 to 1280.")
    if (arguments.run is None) == (arguments.env is None):
        parser.error("give the directory of a run, or --env to see an environment under uniform actions.")
    try:
        # MuJoCo is about to be imported, and takes its renderer then; whether one is needed is known only later.
        failed = None
        try:
            os.environ["MUJOCO_GL"] = find_renderer()
        except RunError as error:
            os.environ.pop("MUJOCO_GL", None)
            failed = error

        from experiments import runtime

        runtime.use_compilation_cache()
        run: Path | None = arguments.run
        if run is None:
            (config, env, act), after = load_random(arguments.env), ""
        else:
            config, env, act, step = load_actor(run)
            after = f" after {step:,} steps"
        assert env.view is not None
        if env.view.needs_renderer and failed:
            raise failed
        if run is None:
            default = Path(arguments.env.replace(":", "-").replace("/", "-") + ".mp4")
        else:
            default = run / f"{arguments.camera or env.view.cameras[0]}.mp4"
        path = arguments.out or default
        states = episode(env, act, arguments.seed, arguments.steps or env.spec.episode_steps)
        height, width = arguments.size
        draw(path, env, states, camera=arguments.camera, height=height, width=width)
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{config.method} on {config.env}{after}, {len(states) - 1:,} steps of acting: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
