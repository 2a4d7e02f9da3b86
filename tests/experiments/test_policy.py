"""A run's policy in loops of anybody's."""

import itertools
import shutil
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import envs
import jaxplore
from experiments import run
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.training import build, loop
from experiments.training.policy import Origin, Policy, gymnasium_spaces
from jaxplore.exploration import Explorer
from jaxplore.methods import METHODS
from tests.experiments.tiny import STEPS, make_point, tiny_flags


@pytest.fixture(scope="module")
def policy(finished) -> Policy:
    return jaxplore.load_policy(finished.out)


def test_it_acts_as_the_run_would(finished, policy: Policy):
    assert repr(policy) == "Policy of implicit on ant_maze, seed 0, after 81 steps"
    directory = RunDirectory(finished.out)
    env = build.make_env(directory.config())
    explorer = build.make_agent(directory.config(), env)
    state = jax.tree.map(lambda leaf: leaf[0], loop.last_state(directory, env, explorer)[0].explorer)
    obs = np.random.default_rng(0).normal(size=(3, 31)).astype(np.float32)
    expected = jax.device_get(jax.jit(explorer.act_greedily)(jax.random.key(0), explorer.actor(state), obs))
    assert np.ptp(expected) > 0
    np.testing.assert_allclose(policy.act(obs), expected, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(jax.jit(policy.act_jax)(jax.random.key(1), obs), expected, rtol=1e-6, atol=1e-7)
    one = policy.act(obs[0].astype(float))
    assert (type(one), one.dtype, one.shape) == (np.ndarray, np.float32, (8,))
    np.testing.assert_allclose(one, expected[0], rtol=1e-5, atol=1e-6)


def test_in_a_gymnasium_loop(policy: Policy):
    env = gymnasium.make("jaxplore/AntMaze-v0", backend="mujoco")
    assert (policy.observation_space, policy.action_space) == (env.observation_space, env.action_space)
    obs, _ = env.reset(seed=0)
    for _ in range(5):
        obs, *_ = env.step(policy.act(obs))
    assert env.observation_space.contains(obs)


def test_what_it_cannot_see_is_refused_in_a_line(policy: Policy):
    for shape in ((30,), (31, 1), (2, 2, 31), ()):
        with pytest.raises(ValueError, match=r"^obs=\(.*\) is its shape\. Allowed: shape \["):
            policy.act(np.zeros(shape))


def test_what_cannot_be_loaded_says_so_in_a_line(finished, tmp_path: Path):
    with pytest.raises(RunError, match=r"none holds no run \(no config.json\)\. Give the --out of a run\.$"):
        jaxplore.load_policy(tmp_path / "none")
    with pytest.raises(ValueError, match=r"^seed=1 is none of the run's\. Allowed: the run's seeds, 0\.$"):
        jaxplore.load_policy(finished.out, seed=1)
    with pytest.raises(RunError, match=r"has no checkpoint up to step 3, only of \[75, 81\]\.$"):
        jaxplore.load_policy(finished.out, step=3)
    shutil.copytree(finished.out, tmp_path / "run", ignore=shutil.ignore_patterns("checkpoints"))
    with pytest.raises(RunError, match=r"has no checkpoint yet: let it run for 20 steps\.$"):
        jaxplore.load_policy(tmp_path / "run")


def made(obs_space: spaces.Space, action_space: spaces.Space, act) -> Policy:
    """A policy that acts by `act(obs)`."""
    parts = dict.fromkeys(Explorer._fields) | {
        "act": lambda key, actor, obs: act(jnp.asarray(obs)),
        "act_greedily": lambda key, actor, obs: act(jnp.asarray(obs)),
    }
    return Policy(Explorer(**parts), None, Origin("mine", "own", 0, 0), obs_space, action_space)  # pyright: ignore


def test_actions_fill_the_environments_own_limits():
    box = spaces.Box(np.float32([-2, 0]), np.float32([2, 10]))
    policy = made(spaces.Box(-1, 1, (2,)), box, lambda obs: obs)
    np.testing.assert_array_equal(policy.act([[-1, -1], [0, 0], [1, 1]]), [[-2, 0], [0, 5], [2, 10]])
    assert policy.act([0.5, 0.5]).tolist() == [1.0, 7.5]


def test_choices_are_whole_numbers_from_where_they_start():
    policy = made(spaces.Discrete(3, start=5), spaces.Discrete(3, start=-1), lambda obs: obs)
    assert [policy.act(choice) for choice in (5, np.int64(6), 7)] == [-1, 0, 1]
    assert isinstance(policy.act(5), int)
    assert policy.act(np.array([7, 5])).tolist() == [1, -1]
    for wrong in (4, 8, 5.0):
        with pytest.raises(ValueError, match=r"^obs=.* Allowed: whole numbers from 5 to 7\.$"):
            policy.act(wrong)


def test_dictionaries_are_seen_in_their_own_order():
    space = spaces.Dict({"b": spaces.Box(-1, 1, (1,)), "a": spaces.Box(-1, 1, (1,))})
    policy = made(space, spaces.Box(-1, 1, (2,)), lambda obs: obs)
    order = list(space)
    obs = {"a": [0.25], "b": [0.5]}
    assert policy.act(obs).tolist() == [obs[name][0] for name in order]
    assert policy.predict({name: [value] for name, value in obs.items()})[0].shape == (1, 2)


def test_spaces_are_gymnasiums_own_where_there_are_some():
    for name in ("gymnasium:Pendulum-v1", "gymnasium:FrozenLake-v1"):
        live = gymnasium.make(name.partition(":")[2])
        found = gymnasium_spaces(name, envs.make(name))
        assert found == (live.observation_space, live.action_space)
    chain = envs.make("nchain")
    assert gymnasium_spaces("nchain", chain) == (spaces.Discrete(40), spaces.Discrete(2))


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_every_method_can_be_loaded(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    discrete = METHODS[name].actions == "discrete"
    monkeypatch.setitem(
        envs.FACTORIES, "point", lambda backend="auto", obs_noise=0.0: make_point(has_reward=True, discrete=discrete)
    )
    out = tmp_path / "run"
    assert run.main(["--env=point", f"--method={name}", f"--out={out}", "--num-seeds=2", *tiny_flags(name)]) == 0
    actions = []
    for seed, deterministic in itertools.product((0, 1), (True, False)):
        policy = jaxplore.load_policy(out, seed=seed)
        assert policy.origin == (name, "point", STEPS[-1], seed)
        action, state = policy.predict(np.zeros((3, 4)), None, np.ones(3, bool), deterministic)
        assert state is None
        assert all(map(policy.action_space.contains, action))
        actions.append(policy.act(np.ones(4)))
    assert discrete or not np.array_equal(actions[0], actions[2]), "each seed has its own"


def test_stable_baselines3_takes_it_for_a_model(policy: Policy):
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    env = gymnasium.wrappers.TimeLimit(gymnasium.make("jaxplore/AntMaze-v0", backend="mujoco"), 10)
    rewards, lengths = evaluation.evaluate_policy(policy, env, 2, return_episode_rewards=True, warn=False)
    assert (rewards, lengths) == ([0.0, 0.0], [10, 10])
