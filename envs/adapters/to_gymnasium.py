"""Our environments as Gymnasium environments: `import envs`, then `gymnasium.make("jaxplore/AntMaze-v0")`.

Where jaxplore is installed from its wheel, without the import.

Every one in `envs.FACTORIES` is registered, under its name in camel case. Keyword arguments of `gymnasium.make` go to
the factory: `gymnasium.make("jaxplore/AntMaze-v0", backend="mujoco", obs_noise=0.02)`.

Several in processes of their own, which have to be spawned, as a fork has none of JAX's threads:

    gymnasium.make_vec(
        "jaxplore/AntMaze-v0", num_envs=4, vectorization_mode="async", vector_kwargs={"context": "spawn"}
    )

Spawning imports the script again, so its own work goes below `if __name__ == "__main__":`. Without the context, where
Python forks by default, the first `reset` raises an error that says so.
"""

import functools
import os
from collections.abc import Iterable, Iterator
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import spaces

from envs.base import Environment, EnvState
from envs.stepper import prepared
from jaxplore import validate

NAMESPACE, VERSION = "jaxplore", 0
SPELLINGS = {"nchain": "NChain"}
"""Names whose camel case is not that of their words."""
FORKED = (
    "this process was forked from one that runs JAX, whose threads it lacks: it could wait forever. Allowed: processes "
    "that are spawned, such as gymnasium.make_vec's with vector_kwargs={'context': 'spawn'}."
)


class GymnasiumEnv(gymnasium.Env):
    """An environment of this package, for code that knows Gymnasium.

    Observations are a float32 Box without limits, or Discrete where they are one-hot; actions a Box from -1 to 1, or
    Discrete. The time limit is the environment's own. `info["coverage_cell"]` is the coverage cell that the observation
    lies in, -1 for none. An episode follows from `reset(seed=...)` alone.

    Args:
        name: as `envs.make` takes it.
        render_mode: None, or `rgb_array` for an environment that has a view.
        height: of a picture, pixels.
        width: of a picture, pixels.
        **options: the factory's own, such as `backend` and `obs_noise`.

    Raises:
        FieldError: an unknown name, option or render mode, or a value that the factory refuses.
        RuntimeError: in a process that was forked from one with environments: from `reset`, so that Gymnasium's vector
            environments hand it on, or at once where there is none like it over there.

    Example:
        >>> env = GymnasiumEnv("acrobot")
        >>> obs, info = env.reset(seed=0)
        >>> obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (as Gymnasium has it)
    _latest: tuple[str, Environment] | None = None

    def __init__(
        self, name: str, *, render_mode: str | None = None, height: int = 480, width: int = 480, **options: Any
    ) -> None:
        self._env = self._make(name, options)
        spec, view = self._env.spec, self._env.view
        modes = ["rgb_array"] if view else []
        if render_mode is not None:
            validate.one_of("render_mode", render_mode, modes)
        self.metadata = {"render_modes": modes, "render_fps": max(1, round(1 / spec.dt))}
        self.render_mode, self._size = render_mode, (height, width)
        self.observation_space = (
            spaces.Discrete(spec.obs_size)
            if spec.one_hot_obs
            else spaces.Box(-np.inf, np.inf, (spec.obs_size,), np.float32)
        )
        self.action_space = (
            spaces.Discrete(spec.action_size)
            if spec.discrete
            else spaces.Box(-1.0, 1.0, (spec.action_size,), np.float32)
        )
        self._cell = jax.jit(self._env.coverage.cell)
        self._state: EnvState | None = None
        self._frames: Iterator[np.ndarray] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see `gymnasium.Env.reset`. There are no `options`."""
        if _is_forked():
            raise RuntimeError(FORKED)
        super().reset(seed=seed)
        state = self._env.reset(jax.random.key(int(self.np_random.integers(2**31))))
        self._state = state
        return self._seen(state.obs)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step; see `gymnasium.Env.step`.

        Raises:
            ValueError: `reset` has not been called, or the action does not lie in the action space.
        """
        if self._state is None:
            raise ValueError("step was called before reset. Allowed: reset first.")
        if self._env.spec.discrete:
            if not self.action_space.contains(action):
                raise ValueError(f"action is {action!r}. Allowed: {self.action_space}.")
            action = np.eye(self._env.spec.action_size, dtype=np.float32)[int(action)]
        entries: Any = np.asarray(action, np.float32)
        self._state, transition = self._env.step(self._state, entries)
        obs, info = self._seen(transition.next_obs)
        reward, terminated, truncated = jax.device_get((transition.reward, transition.terminated, transition.truncated))
        return obs, float(reward), bool(terminated), bool(truncated), info

    def render(self) -> np.ndarray | None:
        """A picture of the state, uint8 `[height, width, 3]`, where `render_mode` is `rgb_array`.

        Raises:
            ValueError: `reset` has not been called.
        """
        view = self._env.view
        if self.render_mode is None or view is None:
            return None
        if self._state is None:
            raise ValueError("render was called before reset. Allowed: reset first.")
        if self._frames is None:
            # One renderer for all pictures: it draws what it is given next, which is always the present state.
            self._frames = view.frames(self._present(), *self._size, view.cameras[0])
        return next(self._frames)

    def close(self) -> None:
        """Lets the renderer go."""
        if self._frames is not None:
            self._frames.close()  # pyright: ignore[reportAttributeAccessIssue]
            self._frames = None

    @staticmethod
    def _make(name: str, options: dict[str, Any]) -> Environment:
        """The environment, or in a fork, where nothing can be made, the latest one of before, to read its spec."""
        import envs

        call = repr((name, sorted(options.items())))
        if not _is_forked():
            GymnasiumEnv._latest = call, prepared(envs.make(name, **options))
        elif GymnasiumEnv._latest is None or GymnasiumEnv._latest[0] != call:
            raise RuntimeError(FORKED)
        return GymnasiumEnv._latest[1]

    def _present(self) -> Iterable[EnvState]:
        while True:
            assert self._state is not None
            yield self._state

    def _seen(self, obs: Any) -> tuple[Any, dict[str, Any]]:
        obs, cell = jax.device_get((obs, self._cell(obs)))
        info = {"coverage_cell": int(cell)}
        return (np.int64(np.argmax(obs)) if self._env.spec.one_hot_obs else np.array(obs, np.float32)), info


@functools.cache
def _first_process() -> int:
    """The process that made the first environment; a fork inherits the answer."""
    return os.getpid()


def _is_forked() -> bool:
    return _first_process() != os.getpid()


def gymnasium_id(name: str) -> str:
    """The id of one of `envs.FACTORIES`: `jaxplore/AntMaze-v0` for `ant_maze`."""
    spelling = SPELLINGS.get(name) or "".join(word.capitalize() for word in name.split("_"))
    return f"{NAMESPACE}/{spelling}-v{VERSION}"


def register(names: Iterable[str]) -> None:
    """Register environments with Gymnasium, as `gymnasium_id` spells them; one that it knows stays as it is."""
    for name in names:
        if gymnasium_id(name) not in gymnasium.registry:
            gymnasium.register(gymnasium_id(name), f"{__name__}:GymnasiumEnv", kwargs={"name": name})
