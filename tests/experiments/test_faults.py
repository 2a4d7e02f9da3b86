"""Environments of anybody's that do wrong: a run says what, in a line, and keeps its last checkpoint."""

import dataclasses
from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import envs
from experiments.runs.checkpoint import Checkpoints
from tests.experiments import tiny
from tests.experiments.tiny import rows

RANDOM = ("--method=random", *tiny.RUN)


class Late(gymnasium.Env):
    """Does wrong at the 60th step of its life."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1.0, 1.0, (1,))
    life, how = 0, ""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([np.nan if Late.how == "reset" else 0.0, 0.0], np.float32), {}

    def step(self, action):
        Late.life += 1
        bad = Late.life >= 60
        if bad and Late.how == "raises":
            raise RuntimeError("the motor is on fire")
        obs = np.array([np.nan if Late.how == "always nan" else Late.life, 0.0], np.float32)
        return obs, np.nan if bad and Late.how == "reward" else 0.0, False, False, {}


gymnasium.register("jaxplore_test/Late-v0", Late, max_episode_steps=10)


@pytest.mark.parametrize(
    ("how", "message", "kept"),
    [
        ("raises", "raised RuntimeError: the motor is on fire at step 10 of an episode", [25, 50]),
        ("reward", "returned the reward nan at step 10 of an episode", [25, 50]),
        ("reset", "returned an observation with numbers that are not finite at reset", []),
        (
            "always nan",
            "returned numbers that are not finite, or beyond float32, in the last 25 steps at every step",
            [],
        ),
    ],
)
def test_a_faulty_environment(how: str, message: str, kept: list[int], tell, tmp_path, monkeypatch):
    monkeypatch.setattr(Late, "how", how)
    monkeypatch.setattr(Late, "life", 0)
    out = tmp_path / "run"
    told = tell(out, "--env=gymnasium:jaxplore_test/Late-v0", *RANDOM)
    assert told.status == 1
    (error,) = [line for line in told.stderr.splitlines() if line.startswith("error: ")]
    assert f"the environment gymnasium:jaxplore_test/Late-v0 {message}" in error and "Expected: " in error
    assert "continue with --resume" in error
    assert "Traceback" not in told.stderr
    assert Checkpoints(out / "checkpoints").steps() == kept


def test_debug_shows_where(tell, tmp_path, monkeypatch):
    monkeypatch.setattr(Late, "how", "raises")
    monkeypatch.setattr(Late, "life", 50)
    told = tell(tmp_path / "run", "--env=gymnasium:jaxplore_test/Late-v0", "--debug", *RANDOM)
    assert "Traceback" in told.stderr and 'raise RuntimeError("the motor is on fire")' in told.stderr


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("raises", "raised KeyError: 'wind' at step. Expected: an EnvState and a Transition"),
        ("shape", "returned an observation of shape (5,) at step. Expected: shape (4,), an entry for each"),
        ("three values", "returned 3 values at step. Expected: an EnvState and a Transition"),
        ("reset", "returned an observation of shape (3,) at reset. Expected: shape (4,)"),
    ],
)
def test_a_faulty_environment_in_jax(how: str, message: str, tell, tmp_path, monkeypatch):
    def make(backend: str = "auto", obs_noise: float = 0.0):
        env = tiny.make_point()

        def reset(key):
            state = env.reset(key)
            return state.replace(obs=state.obs[:3]) if how == "reset" else state

        def step(state, action) -> Any:
            after, transition = env.step(state, action)
            match how:
                case "raises":
                    raise KeyError("wind")
                case "shape":
                    return after, transition._replace(next_obs=jnp.zeros(5))
                case "three values":
                    return after, transition, {}
            return after, transition

        return dataclasses.replace(env, reset=reset, step=step)

    monkeypatch.setitem(envs.FACTORIES, "faulty", make)
    told = tell(tmp_path / "run", "--env=faulty", *RANDOM)
    assert told.status == 1
    assert f"error: the environment point {message}" in told.stderr
    assert "Traceback" not in told.stderr


def test_a_reward_that_is_not_a_number_is_no_data(tell, tmp_path, monkeypatch):
    def make(backend: str = "auto", obs_noise: float = 0.0):
        env = tiny.make_point(has_reward=True)

        def step(state, action):
            after, transition = env.step(state, action)
            return after, transition._replace(reward=jnp.where(after.num_steps == 7, jnp.nan, transition.reward))

        return dataclasses.replace(env, step=step)

    monkeypatch.setitem(envs.FACTORIES, "point", make)
    told = tell(tmp_path / "run", "--env=point", *RANDOM)
    assert told.status == 0, told.stderr
    assert [row["dropped"] for row in rows(told.out)] == [1, 1, 1, 1, 0]
