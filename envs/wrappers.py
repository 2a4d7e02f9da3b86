"""The intrinsic reward in other people's training: any Gymnasium environment with a belief's reward added to its own.

    env = IntrinsicReward(gymnasium.make("Pendulum-v1"), IntrinsicConfig(intrinsic_weight=10.0))

What learns from it (Stable-Baselines3, CleanRL, your own loop) need not know. The wrapper keeps the transitions, fits
the belief to them now and then, and asks it of each new transition what it is worth before it has learned from it.
"""

import functools
from dataclasses import dataclass
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium import spaces

from jaxplore import dynamics, make_generator_belief, replay, rewards
from jaxplore.beliefs import Belief, FitConfig, fit
from jaxplore.beliefs.svgd import SVGDConfig
from jaxplore.dynamics import DynamicsConfig, Normalizers
from jaxplore.replay import Replay
from jaxplore.signals import Reward
from jaxplore.types import Array, Key, Transition
from jaxplore.validate import Checks, FieldError

VARIANCE = Reward(lambda prediction, delta, normalizers: rewards.variance(prediction), "normalised delta, squared")
"""Equation 1, the paper's reward."""


@dataclass(frozen=True)
class IntrinsicConfig:
    """How rewards are mixed, and when the belief is fitted."""

    intrinsic_weight: float = 1.0
    """Factor of the belief's reward."""
    extrinsic_weight: float = 1.0
    """Factor of the environment's own reward. 0: only novelty is sought."""
    warm_up_steps: int = 256
    """Steps before the belief is first fitted; until then its reward is 0."""
    fit_every: int = 25
    """Steps between two fits."""
    data_capacity: int = 10_000
    """Latest transitions that are kept to fit to."""
    seed: int = 0
    """Of everything that is drawn."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.in_range("intrinsic_weight")
        checks.in_range("extrinsic_weight")
        checks.at_least("fit_every", 1)
        checks.at_least("warm_up_steps", 1)
        checks.at_least("data_capacity", self.fit_every)
        checks.at_least("seed", 0)


def laptop_belief(obs_size: int, action_size: int) -> Belief:
    """The paper's belief in a size that CPUs fit in a fraction of a second: 32 models of 2 x 64."""
    return make_generator_belief(
        obs_size,
        action_size,
        DynamicsConfig(hidden=(64, 64)),
        svgd_config=SVGDConfig(
            temperature=0.02, tempering="per_datum", repulsion_points="perturbed", accept_improper=True
        ),
        fit_config=FitConfig(lr=1e-3, weight_decay=0.0, batch_size=128, epochs=0, steps=60, restart=False),
    )


@struct.dataclass
class Knowledge:
    """What is known of an environment."""

    belief: Any
    models: Any
    """Drawn from the belief after its last fit."""
    data: Replay[Transition]
    normalizers: Normalizers


class IntrinsicReward(gymnasium.Wrapper):
    """An environment whose reward is `extrinsic_weight * its own + intrinsic_weight * the belief's`.

    `info` has the belief's as `intrinsic_reward` and the environment's own as `extrinsic_reward`, both without their
    weights. A transition that is not finite is no data, and worth 0. The belief lives as long as the wrapper; each of
    several environments side by side has its own. The first fit compiles for some seconds, within a step.

    Args:
        env: observations are a Box of one axis, actions a Box with finite limits or Discrete.
        config: weights and times.
        belief: what is known of the dynamics, of `O` observation entries and `A` action entries or choices; by default
            `laptop_belief`.
        reward: what a transition is worth; by default equation 1.

    Raises:
        FieldError: spaces of another kind, or a belief that predicts nothing.

    Example:
        >>> import gymnasium
        >>> env = IntrinsicReward(gymnasium.make("Pendulum-v1"), IntrinsicConfig(extrinsic_weight=0.0))
        >>> obs, info = env.reset(seed=0)
        >>> obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> reward, info["intrinsic_reward"], info["extrinsic_reward"] < 0
        (0.0, 0.0, True)
    """

    def __init__(
        self,
        env: gymnasium.Env,
        config: IntrinsicConfig | None = None,
        belief: Belief | None = None,
        reward: Reward | None = None,
    ) -> None:
        super().__init__(env)
        self._sizes = check_spaces(env)
        self._config, self._reward = config or IntrinsicConfig(), reward or VARIANCE
        self._belief = belief or laptop_belief(*self._sizes)
        if self._belief.predict is None:
            raise FieldError("belief", "make_no_belief()", "a belief with `predict`", "predicts nothing")
        self._key = jax.random.key(self._config.seed)
        self._knowledge: Knowledge | None = None
        self._rows: list[Transition] = []
        self._obs: np.ndarray | None = None
        self._steps = 0
        self._score = jax.jit(self._score_one)
        self._absorb = jax.jit(absorb, donate_argnums=0)
        self._learn = jax.jit(functools.partial(learn, self._belief), donate_argnums=1)

    @property
    def unit(self) -> str:
        """Of `info["intrinsic_reward"]`."""
        return self._reward.unit

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; what is known stays."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._obs = np.array(obs, np.float32)
        return obs, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step.

        Raises:
            ValueError: `reset` has not been called.
        """
        if self._obs is None:
            raise ValueError("step was called before reset. Allowed: reset first.")
        obs, own, terminated, truncated, info = self.env.step(action)
        own, after = float(own), np.array(obs, np.float32)
        row = Transition(
            *(self._obs, unit_action(self.env.action_space, action), np.float32(own)),
            *(after, np.bool_(terminated), np.bool_(truncated)),
        )  # pyright: ignore[reportArgumentType]
        self._obs, bonus = after, self._take(row)
        reward = self._config.extrinsic_weight * own + self._config.intrinsic_weight * bonus
        return obs, reward, terminated, truncated, {**info, "intrinsic_reward": bonus, "extrinsic_reward": own}

    def _take(self, row: Transition) -> float:
        """What a transition is worth; it is learned from later."""
        config, bonus = self._config, 0.0
        if self._steps >= config.warm_up_steps and self._knowledge is not None:
            bonus = float(jax.device_get(self._score(self._knowledge.models, self._knowledge.normalizers, row)))
        self._rows.append(row)
        self._steps += 1
        fits = self._steps >= config.warm_up_steps and (self._steps - config.warm_up_steps) % config.fit_every == 0
        if fits or len(self._rows) == config.fit_every:
            self._keep(fits)
        return bonus if np.isfinite(bonus) else 0.0

    def _keep(self, fits: bool) -> None:
        """Take the latest transitions in, and learn if it is time to."""
        if self._knowledge is None:
            self._knowledge = jax.jit(functools.partial(begin, self._belief, self._sizes, self._config.data_capacity))(
                self._key
            )
        # As many rows each time, so that one program takes them all.
        num, rows = len(self._rows), [*self._rows, *[self._rows[0]] * (self._config.fit_every - len(self._rows))]
        batch = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        finite = (
            np.isfinite(batch.obs).all(-1) & np.isfinite(batch.next_obs).all(-1) & np.isfinite(batch.action).all(-1)
        )
        self._knowledge = self._absorb(self._knowledge, batch, finite & (np.arange(len(rows)) < num))
        self._rows = []
        if fits:
            key = jax.random.fold_in(self._key, self._steps)
            self._knowledge = self._learn(key, self._knowledge, np.int32(self._steps))

    def _score_one(self, models: Any, normalizers: Normalizers, row: Transition) -> Array:
        batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], row)
        return self._reward.score(*self._belief.judge(models, normalizers, batch), normalizers)[0]


def begin(belief: Belief, sizes: tuple[int, int], capacity: int, key: Key) -> Knowledge:
    """Nothing is known yet."""
    obs_size, action_size = sizes
    obs, flag = jnp.zeros(obs_size), jnp.zeros((), bool)
    example = Transition(obs, jnp.zeros(action_size), jnp.zeros(()), obs, flag, flag)
    belief_key, models_key = jax.random.split(key)
    state = belief.init(belief_key)
    return Knowledge(
        belief=state,
        models=belief.sample(models_key, state, belief.num_models),
        data=replay.init(example, capacity),
        normalizers=dynamics.init_normalizers(obs_size, action_size),
    )


def absorb(known: Knowledge, batch: Transition, valid: Array) -> Knowledge:
    """Take transitions `[T, ...]` in where `valid [T]` is set; nothing is learned yet."""
    return known.replace(  # pyright: ignore[reportAttributeAccessIssue]
        data=replay.add(known.data, batch, valid),
        normalizers=dynamics.update_normalizers(known.normalizers, batch, jnp.asarray(valid)),
    )


def learn(belief: Belief, key: Key, known: Knowledge, num_data: Array) -> Knowledge:
    """Fit the belief, and draw new models from it."""
    fit_key, models_key = jax.random.split(key)
    state, _ = fit(belief, fit_key, known.belief, known.data, known.normalizers, num_data)
    models = belief.sample(models_key, state, belief.num_models)
    return known.replace(belief=state, models=models)  # pyright: ignore[reportAttributeAccessIssue]


def check_spaces(env: gymnasium.Env) -> tuple[int, int]:
    """Entries of an observation, and of an action or choices.

    Raises:
        FieldError: spaces of another kind.
    """
    seen, taken = env.observation_space, env.action_space
    if not isinstance(seen, spaces.Box) or len(seen.shape) != 1:
        problem = "has observations of another kind"
        raise FieldError("observation_space", seen, "a Box of one axis, as FlattenObservation makes", problem)
    if isinstance(taken, spaces.Discrete):
        return seen.shape[0], int(taken.n)
    if isinstance(taken, spaces.Box) and np.isfinite(taken.low).all() and np.isfinite(taken.high).all():
        return seen.shape[0], taken.low.size
    raise FieldError("action_space", taken, "a Box with finite limits, or Discrete", "has actions of another kind")


def unit_action(space: spaces.Space, action: Any) -> np.ndarray:
    """An action as the library has it, float32 `[A]`: in [-1, 1], or a one-hot choice."""
    if isinstance(space, spaces.Discrete):
        return np.eye(int(space.n), dtype=np.float32)[int(action) - int(space.start)]
    assert isinstance(space, spaces.Box)
    low, high = space.low.astype(float), space.high.astype(float)
    inside = (np.asarray(action, float) - (low + high) / 2) / np.maximum((high - low) / 2, 1e-12)
    return np.clip(inside, -1.0, 1.0).astype(np.float32).ravel()
