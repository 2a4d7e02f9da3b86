"""Any Gymnasium environment: `make("gymnasium:Pendulum-v1")`, or `"gymnasium:module:Own-v0"` of an imported module.

A live Gymnasium environment cannot be saved. So a state is what leads to it: the seed of the episode's reset, drawn
from the key, and the actions since. The live environments are a cache: one that is not where a state says is reset with
the state's seed and given its actions again. A run that is resumed thus continues to the bit, provided that the
environment depends on its seed and its actions alone; one that does not is found out and refused then.

- Observations: a Box of one axis; a Dict of such, one after the other in its own order; or Discrete, which becomes
  one-hot. Pictures and everything else are refused.
- Actions: a Box with finite limits, which [-1, 1] is stretched to; or Discrete, which becomes one-hot.
- Gymnasium's own time limit is taken off: an episode is cut after the registered number of steps, or after 1,000 where
  there is none, as `truncated`. What the environment itself calls terminated or truncated stays that.
- Seeds side by side are one vector environment of Gymnasium's, without its resets.
- Coverage: see `envs.coverage.make_generic_coverage`.
"""
# pyright: reportArgumentType=false, reportReturnType=false, reportAttributeAccessIssue=false
# NumPy arrays stand where the contract says Array, and mujoco ships no stubs.

import functools
import numbers
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from flax import struct
from gymnasium import spaces
from gymnasium.envs.registration import registry
from gymnasium.vector import AutoresetMode

from envs.adapters import check_known
from envs.base import Environment, EnvSpec, EnvState, View, check_noise
from envs.coverage import make_generic_coverage
from envs.errors import EnvironmentFault, raised, shape_of
from jaxplore import validate
from jaxplore.types import Key, Transition
from jaxplore.validate import FieldError

BACKEND = "gymnasium"
EPISODE_STEPS = 1_000
"""Where an environment is registered without a time limit."""
LARGEST = 1e18
"""Size of an observation beyond which physics is taken to have diverged: its square is no float32."""


@struct.dataclass
class Past:
    """What leads to a state of a Gymnasium environment."""

    seed: np.ndarray
    """Of the episode's reset, uint32."""
    actions: np.ndarray
    """The episode's actions in [-1, 1], one-hot or not, float32 `[episode_steps, A]`; zeros from `num_steps` on."""
    obs: np.ndarray
    """The observation that they lead to, without added noise, `[O]`."""


def check_name(name: str) -> None:
    """Raise `FieldError` unless `name` is an id in Gymnasium's registry, or `module:id` of a module that has been
    imported: a name may come from a file, and importing a module runs it.
    """
    module, colon, env_id = name.rpartition(":")
    if colon and module not in sys.modules:
        problem = f"needs the module {module!r}, which has not been imported"
        raise FieldError("env", f"gymnasium:{name}", f"with --import={module}, or after `import {module}`", problem)
    check_known(f"gymnasium{colon}{module}", env_id, registry)


class Adapted(NamedTuple):
    """The fixed parts of an adapted environment."""

    spec: EnvSpec
    live: "Live"
    obs_noise: float


def make_environment(
    name: str, backend: str = "auto", obs_noise: float = 0.0, episode_steps: int | None = None
) -> Environment:
    """The Gymnasium environment called `name`. See the module's text for what becomes of its parts.

    `step` raises `ValueError` for an action that is not finite or not of shape `[A]`, and clips it to [-1, 1].

    Args:
        name: an id in Gymnasium's registry, or `module:id`.
        backend: `auto` or `gymnasium`.
        obs_noise: standard deviation of Gaussian noise added to every observation entry, in raw units.
        episode_steps: steps after which an episode is truncated; by default the registered number, or 1,000.

    Raises:
        FieldError: no such environment, one that cannot be made here, or one whose observations or actions are of a
            kind that is not supported.
    """
    check_name(name)
    validate.one_of("backend", backend, ("auto", BACKEND))
    obs_noise = check_noise(obs_noise)
    env_id = name.rpartition(":")[2]
    probe = _make(env_id)
    spec = _make_spec(name, probe, episode_steps)
    live = Live(env_id, probe.observation_space, probe.action_space)
    adapted = Adapted(spec, live, obs_noise)
    view = None
    if "rgb_array" in (probe.metadata.get("render_modes") or ()):
        view = _make_view(live, hasattr(probe.unwrapped, "mujoco_renderer"))
    coverage = make_generic_coverage(spec)
    probe.close()
    return Environment(
        spec,
        functools.partial(reset, adapted),
        functools.partial(step, adapted),
        coverage,
        BACKEND,
        False,
        view=view,
        reset_all=functools.partial(reset_all, adapted),
        step_all=functools.partial(step_all, adapted),
    )


def reset_all(adapted: Adapted, keys: Key) -> tuple[EnvState, ...]:
    """A new episode for each of `keys` `[S]`."""
    seeds, after = _draw_seeds(keys)
    blank = np.zeros((adapted.spec.episode_steps, adapted.spec.action_size), np.float32)
    pasts = [Past(seed, blank, adapted.live.start(int(seed))) for seed in jax.device_get(seeds)]
    own, obs = _noisy(adapted, list(after), [past.obs for past in pasts])
    return tuple(EnvState(past, seen, np.int32(0), key) for past, seen, key in zip(pasts, obs, own, strict=True))


def step_all(
    adapted: Adapted, states: tuple[EnvState, ...], actions: np.ndarray
) -> tuple[tuple[EnvState, ...], Transition]:
    """A step of each of `states` `[S]` with its row of `actions` `[S, A]`."""
    spec = adapted.spec
    # Not asarray: on an array still being computed NumPy waits with Python's lock held, and can hang.
    actions = np.asarray(jax.device_get(actions), np.float32)
    if actions.shape != (len(states), spec.action_size):
        raise ValueError(f"action has shape {actions.shape[1:]}. Allowed: {(spec.action_size,)}.")
    if not np.isfinite(actions).all():
        raise ValueError(f"action is {actions}. Allowed: finite numbers.")
    actions = np.eye(spec.action_size, dtype=np.float32)[actions.argmax(-1)] if spec.discrete else actions
    actions = np.clip(actions, -1.0, 1.0)
    counts = [int(state.num_steps) for state in states]
    pasts, rewards, terminated, truncated = adapted.live.step([state.physics for state in states], counts, actions)
    keys, obs = _noisy(adapted, [state.key for state in states], [past.obs for past in pasts])
    after = tuple(
        EnvState(past, seen, np.int32(count + 1), key)
        for past, seen, count, key in zip(pasts, obs, counts, keys, strict=True)
    )
    broken = [not np.isfinite(past.obs).all() for past in pasts]
    transitions = Transition(
        obs=np.stack([state.obs for state in states]),
        action=actions,
        reward=rewards.astype(np.float32),
        next_obs=np.stack(obs),
        terminated=terminated | np.array(broken),
        truncated=truncated | (np.array(counts) + 1 >= spec.episode_steps),
    )
    return after, transitions


def reset(adapted: Adapted, key: Key) -> EnvState:
    """A new episode."""
    return reset_all(adapted, key[None])[0]


def step(adapted: Adapted, state: EnvState, action: Any) -> tuple[EnvState, Transition]:
    """A step; see `Environment.step`."""
    action = np.asarray(jax.device_get(action), np.float32)
    states, transitions = step_all(adapted, (state,), action[None])
    return states[0], jax.tree.map(lambda leaf: leaf[0], transitions)


@jax.jit
def _draw_seeds(keys: Key) -> tuple[Any, Key]:
    """A seed for each reset, uint32 `[S]`, and keys `[S]` to continue with."""

    def one(key: Key) -> tuple[Any, Key]:
        start_key, key = jax.random.split(key)
        return jax.random.bits(start_key, (), "uint32") >> 1, key

    return jax.vmap(one)(keys)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _draw_noise(obs_noise: float, obs_size: int, keys: Key) -> tuple[Key, Any]:
    def one(key: Key) -> tuple[Key, Any]:
        key, noise_key = jax.random.split(key)
        return key, obs_noise * jax.random.normal(noise_key, (obs_size,), "float32")

    return jax.vmap(one)(keys)


def _noisy(adapted: Adapted, keys: list[Key], obs: list[np.ndarray]) -> tuple[list[Key], list[np.ndarray]]:
    if adapted.obs_noise == 0:
        return keys, obs
    after, noise = _draw_noise(adapted.obs_noise, adapted.spec.obs_size, jax.numpy.stack(keys))
    return list(after), [clean + extra for clean, extra in zip(obs, jax.device_get(noise), strict=True)]


class Live:
    """Live environments, and where in which episode each is. Not for two threads at once.

    Args:
        env_id: in Gymnasium's registry.
        obs_space: what it shows.
        action_space: what it takes.
    """

    def __init__(self, env_id: str, obs_space: spaces.Space, action_space: spaces.Space) -> None:
        self._id, self._obs_space, self._action_space = env_id, obs_space, action_space
        self._vectors: dict[int, tuple[gymnasium.vector.SyncVectorEnv, list[tuple[Past, int] | None]]] = {}
        self._beginner: gymnasium.Env | None = None

    def start(self, seed: int) -> np.ndarray:
        """The first observation of the episode with this seed, `[O]`."""
        # In an environment of its own: the others stay where they are until they are stepped.
        self._beginner = self._beginner or _make(self._id)
        return _flat(self._obs_space, self._beginner.reset(seed=seed)[0])

    def step(
        self, pasts: list[Past], counts: list[int], actions: np.ndarray
    ) -> tuple[list[Past], np.ndarray, np.ndarray, np.ndarray]:
        """A step of each `[S]`: what leads to the states after it, rewards, terminated, truncated."""
        size = len(pasts)
        if size not in self._vectors:
            self._vectors[size] = self._make_vector(size), [None] * size
        vector, at = self._vectors[size]
        stray = np.array([not _same(*pair) for pair in zip(at, zip(pasts, counts, strict=True), strict=True)])
        first = None
        if stray.any():
            seeds = [int(past.seed) if lost else None for past, lost in zip(pasts, stray, strict=True)]
            first, _ = vector.reset(seed=seeds, options={"reset_mask": stray})
        for i in np.flatnonzero(stray):
            at[i] = None
            obs = _flat(self._obs_space, _own(first, i))
            for action in pasts[i].actions[: counts[i]]:
                obs = _flat(self._obs_space, vector.envs[i].step(_native(self._action_space, action))[0])
            self._check(obs, pasts[i])
        natives = np.stack([_native(self._action_space, action) for action in actions])
        obs, rewards, terminated, truncated, _ = vector.step(natives)
        after = []
        for i, (past, count) in enumerate(zip(pasts, counts, strict=True)):
            done = past.actions.copy()
            # Steps beyond the time limit are nobody's business, but an array has an end.
            done[min(count, len(done) - 1)] = actions[i]
            after.append(Past(past.seed, done, _flat(self._obs_space, _own(obs, i))))
            # One that has ended is not stepped on; anyone who wants to is led there again.
            at[i] = None if terminated[i] or truncated[i] else (after[i], count + 1)
        return after, rewards, terminated, truncated

    def frames(self, size: dict[str, int], states: Iterable[EnvState]) -> Iterator[np.ndarray]:
        """A picture of each state, in an environment that is led there."""
        env = _make(self._id, render_mode="rgb_array", **size)
        at: tuple[Past, int] | None = None
        try:
            for state in states:
                past, count = state.physics, int(state.num_steps)
                if at is None or at[1] > count or not _same(at, (past, at[1])):
                    at = past, 0
                    env.reset(seed=int(past.seed))
                for action in past.actions[at[1] : count]:
                    env.step(_native(self._action_space, action))
                at = past, count
                yield env.render()
        finally:
            env.close()

    def _check(self, obs: np.ndarray, past: Past) -> None:
        if not np.array_equal(obs, past.obs, equal_nan=True):
            problem = "went elsewhere from the same seed under the same actions, so it cannot be resumed,"
            expected = "an environment that depends on its seed and actions alone"
            raise EnvironmentFault(f"gymnasium:{self._id}", "its second time there", problem, expected)

    def _make_vector(self, size: int) -> gymnasium.vector.SyncVectorEnv:
        vector = gymnasium.make_vec(
            self._id,
            size,
            vectorization_mode="sync",
            vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED},
            wrappers=[functools.partial(Checked, env_id=self._id)],
            **OPTIONS,
        )
        assert isinstance(vector, gymnasium.vector.SyncVectorEnv)
        for env in vector.envs:
            _keep_divergence(env)
        return vector


OPTIONS: dict[str, Any] = {"max_episode_steps": -1, "disable_env_checker": True}
"""For Gymnasium: no time limit of its own."""


def _make(env_id: str, **options: Any) -> gymnasium.Env:
    try:
        env = gymnasium.make(env_id, **OPTIONS, **options)
    except Exception as error:  # An environment of anybody's raises anything.
        known = isinstance(error, gymnasium.error.Error | ImportError)
        problem = f"cannot be made here: {str(error).rstrip('.') if known else raised(error)}"
        raise FieldError("env", f"gymnasium:{env_id}", "environments that `gymnasium.make` makes", problem) from error
    _keep_divergence(env)
    return Checked(env, env_id)


class Checked(gymnasium.Wrapper):
    """An environment of anybody's: what it raises, and what it may not give back, is said in a line.

    Args:
        env: the environment.
        env_id: in Gymnasium's registry.

    Raises:
        EnvironmentFault: from `reset`, `step` and `render`.
    """

    def __init__(self, env: gymnasium.Env, env_id: str) -> None:
        super().__init__(env)
        self._name, self._steps = f"gymnasium:{env_id}", 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._steps = 0
        expected = "an observation and a dictionary"
        found = self._call(expected, functools.partial(self.env.reset, seed=seed, options=options))
        self._check_count(found, 2, expected)
        largest = self._check_obs(found[0])
        if not largest <= LARGEST:
            what = f"as large as {largest:g}" if np.isfinite(largest) else "that are not finite"
            expected = f"numbers between -{LARGEST:g} and {LARGEST:g}"
            raise self._fault(f"returned an observation with numbers {what}", expected)
        return found

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        self._steps += 1
        expected = "an observation, a reward, terminated, truncated and a dictionary"
        found = self._call(expected, functools.partial(self.env.step, action))
        self._check_count(found, 5, expected)
        obs, reward, terminated, truncated, info = found
        usable = self._check_obs(obs) <= LARGEST
        try:
            reward = float(np.asarray(reward).item())
        except (TypeError, ValueError) as error:
            raise self._fault(f"returned a reward of {shape_of(reward)}", "one number") from error
        # Physics that diverges is dropped, the reward with it; without that, somebody would learn from it.
        if usable and not abs(reward) <= LARGEST:
            raise self._fault(f"returned the reward {reward}", f"a number between -{LARGEST:g} and {LARGEST:g}")
        try:
            return obs, reward, bool(terminated), bool(truncated), info
        except ValueError as error:
            what = f"returned terminated and truncated of {shape_of(terminated)} and {shape_of(truncated)}"
            raise self._fault(what, "True or False") from error

    def render(self) -> np.ndarray:
        """A picture."""
        expected = "a picture, [height, width, 3]"
        picture = self._call(expected, self.env.render)
        if np.ndim(picture) != 3:
            raise self._fault(f"returned a picture of {shape_of(picture)}", expected)
        return np.asarray(picture)

    def _call(self, expected: str, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except Exception as error:
            raise self._fault(raised(error), expected) from error

    def _check_count(self, found: Any, count: int, expected: str) -> None:
        if not isinstance(found, tuple) or len(found) != count:
            what = f"{len(found)} values" if isinstance(found, tuple) else type(found).__name__
            raise self._fault(f"returned {what}", expected)
        if not isinstance(found[-1], dict):
            raise self._fault(f"returned {type(found[-1]).__name__} for the dictionary", expected)

    def _check_obs(self, obs: Any) -> float:
        """The size of an observation's largest entry, NaN if there is one. It has its space's shape."""
        space = self.env.observation_space
        if isinstance(space, spaces.Discrete):
            if not space.contains(obs):
                raise self._fault(f"returned the observation {obs!r}", f"one of {space}")
            return 1.0
        parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {"": space}
        if isinstance(space, spaces.Dict) and (not isinstance(obs, dict) or set(obs) != set(parts)):
            names = ", ".join(map(str, obs)) if isinstance(obs, dict) else type(obs).__name__
            raise self._fault(f"returned the observation {names}", f"a dictionary with {', '.join(parts)}")
        sizes = [self._check_part(name, part, obs[name] if name else obs) for name, part in parts.items()]
        return float(np.max(sizes, initial=0.0))

    def _check_part(self, name: str, space: spaces.Space, part: Any) -> float:
        expected, own = f"shape {space.shape}, as its space says", f"{name} " if name else ""
        try:
            entries = np.asarray(part, float)
        except (TypeError, ValueError) as error:
            raise self._fault(f"returned an observation {own}that is no array of numbers", expected) from error
        if entries.shape != space.shape:
            raise self._fault(f"returned an observation {own}of {shape_of(entries)}", expected)
        return np.abs(entries).max(initial=0.0)

    def _fault(self, found: str, expected: str) -> EnvironmentFault:
        return EnvironmentFault(
            self._name, f"step {self._steps} of an episode" if self._steps else "reset", found, expected
        )


def _keep_divergence(env: gymnasium.Env) -> None:
    """Has MuJoCo leave a diverged state as it is, reported by `terminated`, and not reset it within an episode."""
    model: Any = getattr(env.unwrapped, "model", None)
    if type(model).__name__ == "MjModel":
        import mujoco

        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _same(there: tuple[Past, int] | None, wanted: tuple[Past, int]) -> bool:
    """Whether a live environment is where a state says."""
    if there is None or there[1] != wanted[1] or there[0].seed != wanted[0].seed:
        return False
    return there[0] is wanted[0] or np.array_equal(there[0].actions[: there[1]], wanted[0].actions[: wanted[1]])


def _make_spec(name: str, probe: gymnasium.Env, episode_steps: int | None) -> EnvSpec:
    """What becomes of `probe`'s spaces and time limit. Raises `FieldError` for what is not supported."""
    limit = registry[name.rpartition(":")[2]].max_episode_steps
    limit = episode_steps if episode_steps is not None else limit if limit and limit > 0 else EPISODE_STEPS
    validate.at_least("episode_steps", limit, 1)
    obs_names, obs_limits = _observations(name, probe.observation_space)
    return EnvSpec(
        name=f"gymnasium:{name}",
        obs_names=obs_names,
        action_names=_actions(name, probe.action_space),
        episode_steps=limit,
        dt=_seconds(probe),
        discrete=isinstance(probe.action_space, spaces.Discrete),
        one_hot_obs=isinstance(probe.observation_space, spaces.Discrete),
        has_reward=True,
        obs_limits=obs_limits,
    )


def _observations(name: str, space: spaces.Space) -> tuple[tuple[str, ...], tuple[tuple[float, float], ...]]:
    """Names and limits of the observation entries. Raises `FieldError` for a space that is not supported."""
    if isinstance(space, spaces.Discrete):
        return tuple(f"obs={space.start + i}" for i in range(space.n)), ((0.0, 1.0),) * int(space.n)
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {"obs": space}
    names, limits = [], []
    for part_name, part in parts.items():
        if not isinstance(part, spaces.Box) or len(part.shape) != 1:
            picture = isinstance(part, spaces.Box) and len(part.shape) in (2, 3)
            problem = f"has observations {space}{': pictures' if picture else ''}"
            allowed = "a Box of one axis, a Dict of such, or Discrete"
            raise FieldError("env", f"gymnasium:{name}", allowed, problem)
        names += [f"{part_name}[{i}]" for i in range(part.shape[0])]
        limits += zip(part.low.astype(float).tolist(), part.high.astype(float).tolist(), strict=True)
    return tuple(names), tuple(limits)


def _actions(name: str, space: spaces.Space) -> tuple[str, ...]:
    """Names of the action entries or choices. Raises `FieldError` for a space that is not supported."""
    if isinstance(space, spaces.Discrete):
        return tuple(f"action={space.start + i}" for i in range(space.n))
    if isinstance(space, spaces.Box) and np.isfinite(space.low).all() and np.isfinite(space.high).all():
        return tuple(f"action[{i}]" for i in range(space.low.size))
    allowed = "a Box with finite limits, or Discrete"
    raise FieldError("env", f"gymnasium:{name}", allowed, f"has actions {space}")


def _own(obs: Any, i: int) -> Any:
    """One environment's part of what a vector environment shows."""
    return {name: part[i] for name, part in obs.items()} if isinstance(obs, dict) else obs[i]


def _flat(space: spaces.Space, obs: Any) -> np.ndarray:
    """An observation as the contract has it, float32 `[O]`."""
    if isinstance(space, spaces.Discrete):
        return np.eye(int(space.n), dtype=np.float32)[int(obs) - int(space.start)]
    parts = [obs[name] for name in space.spaces] if isinstance(space, spaces.Dict) else [obs]
    flat = np.concatenate([np.asarray(part, float) for part in parts])
    return np.where(np.abs(flat) <= LARGEST, flat, np.nan).astype(np.float32)


def _native(space: spaces.Space, action: np.ndarray) -> Any:
    """An action in [-1, 1] `[A]`, or a one-hot choice, as the environment takes it."""
    if isinstance(space, spaces.Discrete):
        return space.start + np.argmax(action)
    assert isinstance(space, spaces.Box)
    low, high = space.low.astype(float), space.high.astype(float)
    # In this form actions of limits -1 and 1 stay as they are, to the bit.
    stretched = (low + high) / 2 + (high - low) / 2 * action.reshape(space.shape)
    return np.clip(stretched, low, high).astype(space.dtype)


def _seconds(env: gymnasium.Env) -> float:
    """Seconds of a step: the environment's own `dt`, or one frame, or 1."""
    try:
        dt = getattr(env.unwrapped, "dt", None)
    except Exception:  # A property of anybody's.
        dt = None
    if not (isinstance(dt, numbers.Real) and 0 < float(dt) < np.inf):
        dt = 1.0 / (env.metadata.get("render_fps") or 1)
    return float(dt)


def _make_view(live: Live, uses_mujoco: bool) -> View:
    """The environment's own pictures, stretched to the size that is asked for."""

    def frames(states: Iterable[EnvState], height: int, width: int, camera: str) -> Iterator[np.ndarray]:
        for picture in live.frames({"width": width, "height": height} if uses_mujoco else {}, states):
            rows = np.arange(height) * picture.shape[0] // height
            columns = np.arange(width) * picture.shape[1] // width
            yield picture[rows[:, None], columns, :3]

    return View(frames, ("own",), uses_mujoco)
