"""`python -m experiments.render RUN`: a video of a run's agent acting in its environment."""

import argparse
import dataclasses
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from envs.base import Environment
from envs.wrappers import make_collect
from experiments import loop
from experiments.checkpoint import Checkpoints
from experiments.config import RunConfig, from_json
from experiments.errors import RunError, disk_error
from experiments.run import use_compilation_cache
from jaxplore.types import Array

RENDERERS = ("egl", "osmesa")
"""Off-screen renderers, tried in this order; `MUJOCO_GL` overrides."""

INSTALL_RENDERER = (
    "No off-screen renderer works here. What to do: install one, such as Mesa's software renderer "
    "(Debian and Ubuntu: apt-get install libosmesa6, or libegl1 with a GPU's driver), or set MUJOCO_GL to egl, osmesa "
    "or glfw, whichever this machine has."
)
INSTALL_WRITER = 'Writing a video needs imageio and its ffmpeg: pip install "imageio" "imageio-ffmpeg".'


def load_actor(run: Path) -> tuple[RunConfig, Environment, Any, int]:
    """The agent of a run's latest checkpoint.

    Returns:
        The run's configuration, its environment with physics on the host, an `act(key, obs) -> action`, and the
        checkpoint's step.

    Raises:
        RunError: `run` holds no run or no checkpoint.
    """
    try:
        config = from_json((run / "config.json").read_text(), str(run / "config.json"))
    except OSError as error:
        raise RunError(f"{run} holds no run: cannot read {run / 'config.json'} ({error.strerror}).") from error
    own_env = loop.make_environment(config)
    explorer = loop.make_run_explorer(config, own_env)
    restored = Checkpoints(run / "checkpoints").restore_latest(loop.make_programs(config, own_env, explorer).init())
    if restored is None:
        raise RunError(f"{run} has no checkpoint yet: let the run go on for {config.checkpoint_every} steps.")
    first = jax.tree.map(lambda leaf: leaf[0], restored.state.explorer)
    actor = explorer.actor(first)
    act = jax.jit(lambda key, obs: explorer.act(key, actor, obs))
    env = own_env if not own_env.compiled else loop.make_environment(dataclasses.replace(config, backend="mujoco"))
    return config, env, act, restored.step


def episode(env: Environment, act: Any, seed: int, num_steps: int) -> Array:
    """Generalised positions of an episode, `[num_steps + 1, nq]`."""
    if env.view is None:
        raise RunError(f"{env.spec.name} has nothing to draw: it has no MuJoCo model.")
    collect = make_collect(env, 1)
    key = jax.random.key(seed)
    state = env.reset(jax.random.fold_in(key, 0))
    positions = [np.array(env.view.qpos(state))]
    for step in range(num_steps):
        state, _, _ = collect(jax.random.fold_in(key, step + 1), state, act, 1)
        positions.append(np.array(env.view.qpos(state)))
    return np.stack(positions)


def make_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """An off-screen renderer.

    Raises:
        RunError: none works; says what to install.
    """
    wanted = os.environ.get("MUJOCO_GL")
    # MuJoCo picks its GL library once per process, when the first renderer is made.
    for name in (wanted,) if wanted else RENDERERS:
        os.environ["MUJOCO_GL"] = name
        try:
            return mujoco.Renderer(model, height, width)
        except Exception as error:  # Each GL library fails in its own way: ImportError, AttributeError, RuntimeError.
            reason = error
            _forget_gl()
    raise RunError(f"{INSTALL_RENDERER} (The last one said: {reason})")


def _forget_gl() -> None:
    """Let the next renderer choose its GL library anew."""
    libraries = ("mujoco.gl_context", "mujoco.egl", "mujoco.osmesa", "OpenGL")
    for name in [name for name in sys.modules if name.startswith(libraries)]:
        del sys.modules[name]


def write_video(path: Path, env: Environment, positions: Array, *, camera: str, height: int, width: int) -> None:
    """Draw the positions and write them as a video in real time.

    Raises:
        RunError: no renderer, no video writer, or the file cannot be written.
    """
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise RunError(INSTALL_WRITER) from error
    assert env.view is not None
    model = env.view.model
    data = mujoco.MjData(model)
    renderer = make_renderer(model, height, width)
    try:
        with imageio.get_writer(path, fps=round(1 / env.spec.dt), macro_block_size=8) as writer:
            for qpos in positions:
                data.qpos[:] = qpos
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, camera=camera)
                writer.append_data(renderer.render())
    except (ImportError, ValueError) as error:
        raise RunError(f"{INSTALL_WRITER} ({error})") from error
    except OSError as error:
        raise disk_error("write the video", path, error) from error
    finally:
        renderer.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Draw a video; the exit status is 0, or 1 with a message."""
    parser = argparse.ArgumentParser(prog="python -m experiments.render", description=__doc__)
    parser.add_argument("run", type=Path, help="directory of a run")
    parser.add_argument("--seed", type=int, default=0, help="where the episode starts (default: 0)")
    parser.add_argument("--steps", type=int, help="steps to act (default: one episode)")
    parser.add_argument("--camera", choices=("track", "overview"), default="track", help="follow, or see it all")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 640), metavar=("HEIGHT", "WIDTH"))
    arguments = parser.parse_args(argv)
    try:
        use_compilation_cache()
        config, env, act, step = load_actor(arguments.run)
        num_steps = arguments.steps or env.spec.episode_steps
        if num_steps < 1:
            raise RunError(f"--steps={num_steps}. Allowed: 1 or more.")
        positions = episode(env, act, arguments.seed, num_steps)
        path = arguments.run / f"{arguments.camera}.mp4"
        np.savez_compressed(arguments.run / "episode.npz", qpos=positions, dt=env.spec.dt)
        height, width = arguments.size
        write_video(path, env, positions, camera=arguments.camera, height=height, width=width)
    except (RunError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{config.method} after {step:,} steps, {num_steps} steps of acting: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
