"""`python -m experiments.render RUN`: a video or a picture of a run's agent acting in its environment."""

# MuJoCo chooses its GL library when it is imported, and fails to be imported where that one does not work. So what
# imports MuJoCo is imported late, by `import_mujoco` first.
# pyright: reportAttributeAccessIssue=false
# mujoco ships no stubs.
from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments import process
from experiments.analysis import video
from experiments.analysis.video import STILLS, SUFFIXES
from experiments.progress import track
from experiments.runs import modules
from experiments.runs.errors import RunError

if TYPE_CHECKING:
    from envs.base import Environment, EnvState, View
    from envs.stepper import Act
    from experiments.runs.config import RunConfig


def import_mujoco() -> None:
    """Import MuJoCo without a renderer, whatever `MUJOCO_GL` says; `use_renderer` comes later."""
    wanted = os.environ.pop("MUJOCO_GL", None)
    try:
        import mujoco  # noqa: F401
    finally:
        if wanted is not None:
            os.environ["MUJOCO_GL"] = wanted


def use_renderer(view: View) -> None:
    """Have a view drawn by the renderer that `MUJOCO_GL` names or the first that works here, if it takes one.

    Raises:
        RunError: none does; says what to install.
    """
    from envs import views

    if view.needs_renderer:
        try:
            views.use_renderer(os.environ.get("MUJOCO_GL"))
        except RuntimeError as error:
            raise RunError(str(error)) from error


def config_of(run: Path) -> RunConfig:
    """The configuration of a run.

    Raises:
        RunError: `run` holds none.
    """
    from experiments.runs.directory import RunDirectory
    from experiments.runs.status import Status

    directory = RunDirectory(run)
    if directory.status() is Status.ABSENT:
        raise RunError(f"{run} holds no run (no config.json). Give the --out of a run.")
    return directory.config()


def random_config(name: str) -> RunConfig:
    """Uniform actions in the environment called `name`. Raises `ValueError` where there is no such environment."""
    from experiments.runs.presets import preset_config

    return dataclasses.replace(preset_config("laptop", name), method="random")


def load_env(config: RunConfig, camera: str | None = None) -> tuple[Environment, Environment]:
    """The environment of a configuration, and the same with its physics on the host where it has the choice.

    Raises:
        RunError: it cannot be drawn.
        ValueError: it cannot be made, or its view has no such camera.
    """
    from experiments.training import build
    from jaxplore import validate

    own_env = build.make_env(config)
    env = build.on_host(config, own_env)
    if env.view is None:
        raise RunError(f"{config.env} has nothing to draw: its environment has no view.")
    if camera is not None:
        validate.one_of("--camera", camera, env.view.cameras)
    return own_env, env


def load_actor(run: Path, config: RunConfig, own_env: Environment) -> tuple[Act, int]:
    """The agent of a run's latest checkpoint: an `act(key, obs) -> action`, and the checkpoint's step.

    Raises:
        RunError: there is no checkpoint.
    """
    import jax

    from experiments.runs.directory import RunDirectory
    from experiments.training import build, loop

    explorer = build.make_agent(config, own_env)
    state, step = loop.last_state(RunDirectory(run), own_env, explorer)
    actor = explorer.actor(jax.tree.map(lambda leaf: leaf[0], state.explorer))
    return jax.jit(lambda key, obs: explorer.act(key, actor, obs)), step


def load_random(config: RunConfig, own_env: Environment) -> Act:
    """Uniform actions: an `act(key, obs) -> action`."""
    import jax

    from experiments.training import build

    return jax.jit(build.make_agent(config, own_env).act_uniformly)


def episode(env: Environment, act: Act, seed: int, num_steps: int) -> list[EnvState]:
    """The first state of `num_steps` of acting and the one after each step, episode after episode.

    Where an episode ends that is its own last state: the first of the next one is not among them. Physics that diverges
    stands still for that step.
    """
    import jax

    from envs.stepper import prepared

    env = prepared(env)
    key = jax.random.key(seed)
    state = env.reset(jax.random.fold_in(key, 0))
    states = [state]
    for step in track("acting", range(num_steps), num_steps):
        _, act_key, reset_key = jax.random.split(jax.random.fold_in(key, step + 1), 3)
        state, transition = env.step(state, jax.device_get(act(act_key, state.obs)))
        states.append(state if np.isfinite(state.obs).all() else states[-1])
        if transition.terminated or transition.truncated:
            state = env.reset(reset_key)
    return states


def draw(
    path: Path, env: Environment, states: Sequence[EnvState], *, camera: str | None, height: int, width: int
) -> None:
    """Draw states and write them, whole or not at all.

    Args:
        path: a video or a GIF in real time (`.mp4`, `.gif`), or one picture (`.png`) of `STILLS` states, evenly spaced.
        env: whose states they are; it has a view.
        states: what to draw.
        camera: one of the view's; its first by default.
        height: of a frame, pixels.
        width: of a frame, pixels.

    Raises:
        RunError: the file cannot be written.
    """
    assert env.view is not None
    places, lengths = video.timing(path.suffix, len(states), env.spec.dt)
    chosen = [states[place] for place in places]
    frames = env.view.frames(chosen, height, width, camera or env.view.cameras[0])
    video.write(path, track("drawing", frames, len(chosen)), lengths)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """What a command line asks for. Raises `SystemExit` for bad input."""
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
    modules.add_flag(parser)
    process.add_flag(parser)
    arguments = parser.parse_args(argv)
    if arguments.seed < 0:
        parser.error(f"--seed={arguments.seed}. Allowed: 0 or more.")
    if arguments.steps is not None and arguments.steps < 1:
        parser.error(f"--steps={arguments.steps}. Allowed: 1 or more.")
    if any(not 16 <= size <= 1280 or size % 2 for size in arguments.size):
        parser.error(f"--size={' '.join(map(str, arguments.size))}. Allowed: even numbers from 16 to 1280.")
    if (arguments.run is None) == (arguments.env is None):
        parser.error("give the directory of a run, or --env to see an environment under uniform actions.")
    if arguments.out is not None and arguments.out.suffix not in SUFFIXES:
        parser.error(f"--out={arguments.out}. Allowed: a name that ends in {', '.join(SUFFIXES)}.")
    return arguments


def render(arguments: argparse.Namespace) -> str:
    """What a command line asks for: checks, then acts, then draws; gives the closing line."""
    from experiments.runs.seeds import one

    run: Path | None = arguments.run and one(arguments.run).path
    config = random_config(arguments.env) if run is None else config_of(run)
    own_env, env = load_env(config, arguments.camera)
    assert env.view is not None
    if run is None:
        default = Path(arguments.env.replace(":", "-").replace("/", "-") + ".mp4")
    else:
        default = run / f"{arguments.camera or env.view.cameras[0]}.mp4"
    path = arguments.out or default
    video.check_target(path)
    use_renderer(env.view)

    from experiments import runtime

    runtime.use_compilation_cache()
    if run is None:
        act, after = load_random(config, own_env), ""
    else:
        act, step = load_actor(run, config, own_env)
        after = f" after {step:,} steps"
    states = episode(env, act, arguments.seed, arguments.steps or env.spec.episode_steps)
    height, width = arguments.size
    draw(path, env, states, camera=arguments.camera, height=height, width=width)
    return f"{config.method} on {config.env}{after}, {len(states) - 1:,} steps of acting: {path}"


def main(argv: Sequence[str] | None = None) -> int:
    """Draw a video; the exit status is 0, 1 with a message, or 2 for bad input."""
    arguments = parse(argv)
    import_mujoco()
    from envs.errors import EnvironmentFault

    try:
        modules.load([*arguments.imports, *modules.of_env(arguments.env)])
        print(render(arguments))
    except (RunError, ValueError, EnvironmentFault) as error:
        print(f"error: {error}", file=sys.stderr)
        process.show_cause(error, debug=arguments.debug)
        return 1
    return 0


if __name__ == "__main__":
    process.carry_out(main)
