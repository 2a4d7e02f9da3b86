"""`python -m experiments.render RUN`: a video of a run's agent acting in its environment."""

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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.errors import RunError, disk_error

if TYPE_CHECKING:
    from envs.base import Environment
    from experiments.config import RunConfig
    from jaxplore.types import Array, Key

RENDERERS = ("egl", "osmesa", "cgl", "glfw")
"""MuJoCo's, tried in this order unless `MUJOCO_GL` names one: a GPU, no GPU, a Mac, a screen."""

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


def load_actor(run: Path) -> tuple[RunConfig, Environment, Callable[[Key, Array], Array], int]:
    """The agent of a run's latest checkpoint.

    Returns:
        The run's configuration, its environment with physics on the host, an `act(key, obs) -> action`, and the
        checkpoint's step.

    Raises:
        RunError: `run` holds no run or no checkpoint, or its environment cannot be drawn.
    """
    import jax

    from experiments import loop
    from experiments.checkpoint import Checkpoints
    from experiments.config import from_json

    try:
        config = from_json((run / "config.json").read_text(), str(run / "config.json"))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RunError(f"{run} holds no run: cannot read {run / 'config.json'} ({reason}).") from error
    own_env = loop.make_environment(config)
    env = own_env if not own_env.compiled else loop.make_environment(dataclasses.replace(config, backend="mujoco"))
    if env.view is None:
        raise RunError(f"{config.env} has nothing to draw: it has no MuJoCo model.")
    explorer = loop.make_run_explorer(config, own_env)
    init = loop.make_programs(config, own_env, explorer).init
    restored = Checkpoints(run / "checkpoints").restore_latest(jax.eval_shape(init) if own_env.compiled else init())
    if restored is None:
        raise RunError(f"{run} has no checkpoint yet: let the run go on for {config.checkpoint_every:,} steps.")
    actor = explorer.actor(jax.tree.map(lambda leaf: leaf[0], restored.state.explorer))
    act = jax.jit(lambda key, obs: explorer.act(key, actor, obs))
    return config, env, act, restored.step


def episode(env: Environment, act: Callable[[Key, Array], Array], seed: int, num_steps: int) -> np.ndarray:
    """Generalised positions of `num_steps` of acting, `[num_steps + 1, nq]`, episode after episode."""
    import jax

    from envs.wrappers import make_collect

    assert env.view is not None
    collect = make_collect(env, 1)
    key = jax.random.key(seed)
    state = env.reset(jax.random.fold_in(key, 0))
    positions = [np.array(env.view.qpos(state))]
    for step in range(num_steps):
        state, _, _ = collect(jax.random.fold_in(key, step + 1), state, act, 1)
        positions.append(np.array(env.view.qpos(state)))
    return np.stack(positions)


def write_video(path: Path, env: Environment, positions: np.ndarray, *, camera: str, height: int, width: int) -> None:
    """Draw the positions and write them as a video in real time, whole or not at all.

    Raises:
        RunError: no video writer, or the file cannot be written.
    """
    import mujoco

    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise RunError(INSTALL_WRITER) from error
    assert env.view is not None
    data = mujoco.MjData(env.view.model)
    draft = path.with_suffix(f".tmp{path.suffix}")
    try:
        with (
            # JAX warns of the fork that starts ffmpeg; nothing but ffmpeg runs in it.
            warnings.catch_warnings(action="ignore", category=RuntimeWarning),
            mujoco.Renderer(env.view.model, height, width) as renderer,
            imageio.get_writer(draft, fps=round(1 / env.spec.dt), macro_block_size=2) as writer,
        ):
            for qpos in positions:
                data.qpos[:] = qpos
                mujoco.mj_forward(env.view.model, data)
                renderer.update_scene(data, camera=camera)
                writer.append_data(renderer.render())
        draft.replace(path)
    except OSError as error:
        raise disk_error("write the video", path, error) from error
    finally:
        draft.unlink(missing_ok=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Draw a video; the exit status is 0, 1 with a message, or 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m experiments.render", description=__doc__)
    parser.add_argument("run", type=Path, help="directory of a run")
    parser.add_argument("--seed", type=int, default=0, help="of the start and of what the agent draws (default: 0)")
    parser.add_argument("--steps", type=int, help="steps to act (default: one episode)")
    parser.add_argument(
        "--camera", choices=("track", "overview"), default="track", help="follow the agent, or see all (default: track)"
    )
    parser.add_argument(
        "--size", type=int, nargs=2, default=(480, 640), metavar=("HEIGHT", "WIDTH"), help="(default: 480 640)"
    )
    parser.add_argument("--out", type=Path, help="the video to write (default: RUN/CAMERA.mp4)")
    arguments = parser.parse_args(argv)
    if arguments.seed < 0:
        parser.error(f"--seed={arguments.seed}. Allowed: 0 or more.")
    if arguments.steps is not None and arguments.steps < 1:
        parser.error(f"--steps={arguments.steps}. Allowed: 1 or more.")
    if any(not 16 <= size <= 1280 or size % 2 for size in arguments.size):
        parser.error(f"--size={' '.join(map(str, arguments.size))}. Allowed: even numbers from 16 to 1280.")
    path = arguments.out or arguments.run / f"{arguments.camera}.mp4"
    try:
        if not (arguments.run / "config.json").is_file():
            raise RunError(f"{arguments.run} holds no run (no config.json). Give the --out of a run.")
        os.environ["MUJOCO_GL"] = find_renderer()

        from experiments.run import use_compilation_cache

        use_compilation_cache()
        config, env, act, step = load_actor(arguments.run)
        positions = episode(env, act, arguments.seed, arguments.steps or env.spec.episode_steps)
        height, width = arguments.size
        write_video(path, env, positions, camera=arguments.camera, height=height, width=width)
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{config.method} on {config.env} after {step:,} steps, {len(positions) - 1:,} steps of acting: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
