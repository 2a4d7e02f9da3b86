"""The policy in a run's checkpoint, for loops of anybody's: Gymnasium's, JAX's, Stable-Baselines3's."""

import functools
import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from gymnasium import spaces

from envs.base import Environment
from experiments.runs.errors import RunError
from experiments.runs.seeds import one as find_run
from experiments.runs.status import Status
from experiments.training import build, loop
from jaxplore import validate
from jaxplore.exploration import Actor, Explorer
from jaxplore.types import Array, Key
from jaxplore.validate import FieldError


class Origin(NamedTuple):
    """Where a policy comes from."""

    method: str
    env: str
    step: int
    """Environment steps that it has learned from."""
    seed: int


class Policy:
    """A policy that does not learn any more.

    Args:
        explorer: the agent.
        actor: what it acts by.
        origin: where it comes from.
        obs_space: what Gymnasium's form of its environment shows.
        action_space: what that takes.
    """

    def __init__(
        self, explorer: Explorer, actor: Actor, origin: Origin, obs_space: spaces.Space, action_space: spaces.Space
    ) -> None:
        self.origin, self.observation_space, self.action_space = origin, obs_space, action_space
        self._explorer, self._actor, self._count = explorer, actor, 0
        self._act = jax.jit(self._draw, static_argnums=2)

    def __repr__(self) -> str:
        """What it is, in a line."""
        origin = self.origin
        return f"Policy of {origin.method} on {origin.env}, seed {origin.seed}, after {origin.step:,} steps"

    def act(self, obs: Any, deterministic: bool = True) -> Any:
        """Actions in NumPy, as Gymnasium's form of the environment takes them.

        Args:
            obs: one observation or a batch of them, as that environment shows them: `[O]` or `[N, O]`; whole numbers
                where they are Discrete, a dictionary of arrays where they are a Dict.
            deterministic: whether to take what the policy holds for the best, or what it does in its run, where it
                may explore. A method that searches or acts at random does so in both.

        Returns:
            `[A]` or `[N, A]` within the environment's own limits; where actions are choices, an int or `[N]`.

        Raises:
            ValueError: observations of another shape.
        """
        self._count += 1
        return _decode(self.action_space, jax.device_get(self._act(self._count, self._encode(obs), deterministic)))

    def act_jax(self, key: Key, obs: Array, deterministic: bool = True) -> Array:
        """Actions in JAX, as `jaxplore.envs` and Brax take them; pure.

        Args:
            key: for what is drawn; consumed.
            obs: `[..., O]`, one-hot where the environment's are.
            deterministic: as in `act`.

        Returns:
            `[..., A]` in [-1, 1]; where actions are choices, one-hot.

        Raises:
            ValueError: observations of another shape.
        """
        act = self._explorer.act_greedily if deterministic else self._explorer.act
        return act(key, self._actor, obs)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """What `act` gives, as Stable-Baselines3 asks its models for it: `(actions, state)`; there is no state."""
        return self.act(observation, deterministic), state

    def _draw(self, count: Any, obs: Array, deterministic: bool) -> Array:
        return self.act_jax(jax.random.fold_in(jax.random.key(self.origin.seed), count), obs, deterministic)

    def _encode(self, obs: Any) -> np.ndarray:
        """Observations as the policy sees them, float32 `[..., O]`."""
        space = self.observation_space
        if isinstance(space, spaces.Discrete):
            choices = np.asarray(obs) - space.start
            if choices.dtype.kind not in "iu" or np.any((choices < 0) | (choices >= space.n)):
                raise FieldError("obs", obs, f"whole numbers from {space.start} to {space.start + space.n - 1}")
            return np.eye(int(space.n), dtype=np.float32)[choices]
        if isinstance(space, spaces.Dict):
            if not isinstance(obs, Mapping) or set(obs) != set(space):
                raise FieldError("obs", obs, f"a dictionary with {', '.join(space)}")
            obs = np.concatenate([np.asarray(obs[name], np.float32) for name in space], axis=-1)
        rows = np.asarray(obs, np.float32)
        size = spaces.flatdim(space)
        if rows.ndim not in (1, 2):
            raise FieldError("obs", rows.shape, f"shape [{size}] or [N, {size}]", "is its shape")
        validate.shape("obs", rows, *(["N"] if rows.ndim == 2 else []), size)
        return rows


def _decode(space: spaces.Space, actions: np.ndarray) -> Any:
    """Actions in [-1, 1] or one-hot, `[..., A]`, as the environment takes them."""
    if isinstance(space, spaces.Discrete):
        choices = space.start + np.argmax(actions, axis=-1)
        return choices if np.ndim(choices) else int(choices)
    assert isinstance(space, spaces.Box)
    low, high = space.low.astype(float), space.high.astype(float)
    # In this form actions of limits -1 and 1 stay as they are, to the bit.
    stretched = (low + high) / 2 + (high - low) / 2 * actions.reshape(actions.shape[:-1] + space.shape)
    return np.clip(stretched, low, high).astype(space.dtype)


def load(run: str | os.PathLike[str], *, step: int | None = None, seed: int | None = None) -> Policy:
    """See `jaxplore.load_policy`."""
    directory = find_run(run, seed)
    if directory.status() is Status.ABSENT:
        raise RunError(f"{directory} holds no run (no config.json). Give the --out of a run.")
    config = directory.config()
    seeds = range(config.seed, config.seed + config.num_seeds)
    seed = config.seed if seed is None else seed
    if seed not in seeds:
        raise FieldError("seed", seed, f"the run's seeds, {', '.join(map(str, seeds))}", "is none of the run's")
    env = build.make_env(config)
    explorer = build.make_agent(config, env)
    state, found = loop.last_state(directory, env, explorer, step)
    own = jax.tree.map(lambda leaf: leaf[seed - config.seed], state.explorer)
    actor = explorer.actor(own)
    return Policy(explorer, actor, Origin(config.method, config.env, found, seed), *gymnasium_spaces(config.env, env))


def gymnasium_spaces(name: str, env: Environment) -> tuple[spaces.Space, spaces.Space]:
    """The spaces of observations and actions of an environment in Gymnasium's form: its own, where it is Gymnasium's.

    Args:
        name: of the environment, as `envs.make` takes it.
        env: the environment.
    """
    package, colon, own_name = name.partition(":")
    if colon and package == "gymnasium":
        live = gymnasium.make(own_name.rpartition(":")[2], disable_env_checker=True)
        live.close()
        return live.observation_space, live.action_space
    spec = env.spec
    box, choice = functools.partial(spaces.Box, dtype=np.float32), spaces.Discrete
    obs = choice(spec.obs_size) if spec.one_hot_obs else box(-np.inf, np.inf, (spec.obs_size,))
    return obs, choice(spec.action_size) if spec.discrete else box(-1.0, 1.0, (spec.action_size,))
