"""SAC's update, beside SBX's (JAX) and Stable-Baselines3's (PyTorch), with the Ant maze's sizes.

Ours is SAC's first form: a policy, two action values, a value network and its slow copy. Theirs is the second: a policy
and two action values with slow copies. FLOPs of both stand beside the times. Learning rate, discount, alpha, widths and
batch are the same; activations, initialisers and clipping are each library's own.
"""

import dataclasses
import functools
import importlib
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import flops
from benchmarks.kernels import ACTION, OBS, random_data
from benchmarks.peers.common import Line, torch_on_one_thread
from benchmarks.result import widths
from benchmarks.timing import measure_pairs
from experiments.runs.presets import preset_config
from jaxplore import SACConfig, make_sac, replay
from jaxplore.behaviours.base import AS_THEY_ARE, lesson_of, no_learner_metrics, train
from jaxplore.config import TASK_SAC

ROWS = 8192
"""Transitions in the replays."""


def shapes() -> Iterator[tuple[SACConfig, int, int]]:
    """Our settings at the laptop's and the paper's shape; updates in one timing, and in one program."""
    for preset, calls, inner in (("laptop", 20, 64), ("paper", 1, 4)):
        sac = preset_config(preset).explorer.sac
        yield sac, calls, inner
        yield learned(sac), calls, inner


def learned(config: SACConfig) -> SACConfig:
    """The settings of `--method=sac_v2`, which learns alpha as theirs do by default, at the shape of others."""
    own = {"hidden": config.hidden, "batch_size": config.batch_size}
    return dataclasses.replace(TASK_SAC, learn_alpha=True, reward_scale=1.0, **own)


def sbx_lines() -> Iterator[Line]:
    """One update on a batch that it draws; one on a batch that is given; many in one program."""
    torch_on_one_thread()
    for config, calls, inner in shapes():
        model = filled("sbx", config)
        one, given = ours_drawing(config), ours_given(config)
        yield line("SAC update", "SBX", config, one, lambda model=model: model.train(1, model.batch_size), calls=calls)
        yield line("SAC update, batch given", "SBX", config, given, sbx_given(model), calls=calls)
        many = functools.partial(model.train, inner, config.batch_size)
        yield line(f"SAC update, {inner} in one program", "SBX", config, ours_many(config, inner), many, inner=inner)


def sb3_lines() -> Iterator[Line]:
    """One update on a batch that it draws."""
    torch_on_one_thread()
    for config, calls, _ in shapes():
        model = filled("stable_baselines3", config)
        theirs = functools.partial(model.train, 1, config.batch_size)
        yield line("SAC update", "Stable-Baselines3", config, ours_drawing(config), theirs, calls=calls)


def line(
    kernel: str,
    who: str,
    config: SACConfig,
    ours: Callable[[], Any],
    theirs: Callable[[], Any],
    calls: int = 1,
    inner: int = 1,
) -> Line:
    """Time both; `calls` and `inner` are `measure_pairs`'."""
    alpha = "alpha learned" if config.learn_alpha else "alpha fixed"
    shape = f"{widths(config.hidden)}, batch {config.batch_size}, {alpha}"
    sizes = (OBS, ACTION, config.hidden, config.batch_size)
    pairs = measure_pairs(ours, theirs, calls=calls, inner=inner)
    return Line(kernel, shape, who, pairs, flops.sac_update(*sizes), flops.sac_v2_update(*sizes))


def ours_drawing(config: SACConfig) -> Callable[[], Any]:
    """One update on a batch drawn from a replay, each from where the last one ended."""
    sac = make_sac(OBS, ACTION, config)

    def update(key: jax.Array, state: Any, data: Any) -> Any:
        key, draw_key, update_key = jax.random.split(key, 3)
        return key, sac.update(update_key, state, replay.sample(draw_key, data, config.batch_size))

    return _chain(update, sac.init(jax.random.key(0)), random_data(ROWS, ROWS))


def ours_given(config: SACConfig) -> Callable[[], Any]:
    """One update on a batch that lies there."""
    sac = make_sac(OBS, ACTION, config)

    def update(key: jax.Array, state: Any, batch: Any) -> Any:
        key, update_key = jax.random.split(key)
        return key, sac.update(update_key, state, batch)

    return _chain(update, sac.init(jax.random.key(0)), random_data(config.batch_size, config.batch_size).rows)


def ours_many(config: SACConfig, num: int) -> Callable[[], Any]:
    """`num` updates in one program, as a round makes them."""
    sac = make_sac(OBS, ACTION, config)

    def update(key: jax.Array, state: Any, data: Any) -> Any:
        nothing = no_learner_metrics(sac, state, OBS, ACTION)
        key, train_key = jax.random.split(key)
        lesson = lesson_of([(data, config.batch_size)], None, AS_THEY_ARE)
        return key, train(sac, train_key, state, lesson, num, nothing)

    return _chain(update, sac.init(jax.random.key(0)), random_data(ROWS, ROWS))


def _chain(update: Callable[..., Any], state: Any, data: Any) -> Callable[[], Any]:
    """Calls that go on from one another; what they give has the metrics beside the state, as a caller gets them."""
    step, key = jax.jit(update, donate_argnums=1), jax.random.key(1)

    def call() -> Any:
        nonlocal key, state
        key, (state, metrics) = step(key, state, data)
        return state, metrics

    return call


class Spaces(gymnasium.Env):
    """An environment that is nothing but its spaces, which is what their models are made from."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """An observation of zeros."""
        super().reset(seed=seed)
        return np.zeros(OBS, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Nothing happens."""
        return np.zeros(OBS, np.float32), 0.0, False, False, {}


def filled(package: str, config: SACConfig) -> Any:
    """The model of `sbx` or `stable_baselines3` at our settings, its replay full."""
    logger = importlib.import_module("stable_baselines3.common.logger")
    model = importlib.import_module(package).SAC(
        "MlpPolicy",
        Spaces(),
        learning_rate=config.lr,
        buffer_size=ROWS,
        batch_size=config.batch_size,
        tau=config.tau,
        gamma=config.discount,
        ent_coef="auto" if config.learn_alpha else config.alpha,
        policy_kwargs={"net_arch": list(config.hidden)},
        seed=0,
        device="cpu",
    )
    model.set_logger(logger.Logger(None, []))
    random = np.random.default_rng(0)
    obs, next_obs = random.normal(size=(2, ROWS, 1, OBS)).astype(np.float32)
    action = random.uniform(-1, 1, (ROWS, 1, ACTION)).astype(np.float32)
    for i in range(ROWS):
        model.replay_buffer.add(obs[i], next_obs[i], action[i], np.ones(1), np.zeros(1), [{}])
    return model


def sbx_given(model: Any) -> Callable[[], Any]:
    """SBX's own compiled update on a batch that lies there, without what its `train` does around it."""
    samples = importlib.import_module("sbx.common.type_aliases").ReplayBufferSamplesNp
    drawn, flat = model.replay_buffer.sample(model.batch_size), (model.batch_size,)
    fields = (drawn.observations, drawn.actions, drawn.next_observations)
    batch = samples(
        *(jnp.asarray(field.numpy()) for field in fields), jnp.zeros(flat), jnp.ones(flat), jnp.full(flat, model.gamma)
    )
    # Copies: its `train` goes on from the model's own.
    state, key = (model.policy.qf_state, model.policy.actor_state, model.ent_coef_state), model.key

    def call() -> Any:
        nonlocal state, key
        *new, key, losses = model._train(model.tau, model.target_entropy, 1, batch, 1, 0, *state, key)
        state = tuple(new)
        return state, losses

    return call
