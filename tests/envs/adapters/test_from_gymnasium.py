import importlib
import sys

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces

import envs
from envs.base import EnvState
from envs.errors import EnvironmentFault
from envs.stepper import make_collect, make_collect_all

# Of different shape: bounded torque, choices, MuJoCo, sparse reward, and one of ours with a bit of everything.
IDS = ("Pendulum-v1", "CartPole-v1", "HalfCheetah-v5", "MountainCarContinuous-v0", "jaxplore_test/Toy-v0")


class Toy(gymnasium.Env):
    """Two counts, a drawn number and the last action; terminated after 5 ups, truncated by itself after 4 downs."""

    observation_space = spaces.Dict(
        {"counts": spaces.Box(0.0, 5.0, (2,)), "others": spaces.Box(-np.inf, np.inf, (2,), np.float64)}
    )
    action_space = spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([3.0, 0.5], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.ups, self.downs, self.action = 0, 0, 0.0
        return self._obs(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.ups, self.downs, self.action = self.ups + (action[0] > 1), self.downs + (action[0] <= 1), action[0]
        return self._obs(), float(action[1]), self.ups >= 5, self.downs >= 4, {}

    def _obs(self):
        return {
            "counts": np.array([self.ups, self.downs], np.float32),
            "others": np.array([self.np_random.normal(), self.action]),
        }


class Forgetful(Toy):
    """Does not depend on its seed alone."""

    total = 0.0

    def _obs(self):
        Forgetful.total += 1.0
        return {"counts": np.zeros(2, np.float32), "others": np.full(2, Forgetful.total)}


gymnasium.register("jaxplore_test/Toy-v0", Toy)
gymnasium.register("jaxplore_test/Forgetful-v0", Forgetful)


def actions_for(env, count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, env.spec.action_size)).astype(np.float32)


def walk(env, state, actions):
    states, transitions = [state], []
    for action in actions:
        state, transition = env.step(state, action)
        states.append(state)
        transitions.append(transition)
    return states, transitions


def assert_same_state(a: EnvState, b: EnvState):
    strip = lambda state: jax.tree.leaves(state.replace(key=jax.random.key_data(state.key)))  # noqa: E731
    for left, right in zip(strip(a), strip(b), strict=True):
        np.testing.assert_array_equal(left, right)


@pytest.mark.parametrize("env_id", IDS)
def test_the_same_as_gymnasium_itself(env_id):
    env, raw = envs.make(f"gymnasium:{env_id}"), gymnasium.make(env_id)
    state = env.reset(jax.random.key(3))
    flat = lambda obs: np.concatenate(list(obs.values()) if isinstance(obs, dict) else [obs]).astype(np.float32)  # noqa: E731
    obs, _ = raw.reset(seed=int(state.physics.seed))
    np.testing.assert_array_equal(state.obs, flat(obs))
    space = raw.action_space
    for action in actions_for(env, 30):
        if isinstance(space, spaces.Discrete):
            native = int(np.argmax(action))
        elif np.all(space.high == 1) and np.all(space.low == -1):  # nothing to stretch, so the same to the bit
            native = action
        else:
            native = (space.low + (action + 1) / 2 * (space.high - space.low)).astype(np.float32)
        obs, reward, terminated, truncated, _ = raw.step(native)
        state, transition = env.step(state, action)
        np.testing.assert_allclose(transition.next_obs, flat(obs), rtol=1e-4, atol=1e-5)
        assert transition.reward == pytest.approx(reward, rel=1e-4, abs=1e-5)
        assert (transition.terminated, transition.truncated) == (terminated, truncated)
        if terminated or truncated:
            break


def test_what_a_space_becomes():
    specs = {env_id: envs.make(f"gymnasium:{env_id}").spec for env_id in (*IDS, "FrozenLake-v1")}
    assert [specs[env_id].episode_steps for env_id in IDS] == [200, 500, 1000, 999, 1000]
    assert [specs[env_id].discrete for env_id in IDS] == [False, True, False, False, False]
    toy = specs["jaxplore_test/Toy-v0"]
    assert toy.obs_names == ("counts[0]", "counts[1]", "others[0]", "others[1]")
    assert toy.obs_limits == ((0, 5), (0, 5), (-np.inf, np.inf), (-np.inf, np.inf))
    assert specs["Pendulum-v1"].dt == 0.05
    lake = specs["FrozenLake-v1"]
    assert (lake.obs_size, lake.action_size, lake.one_hot_obs, lake.discrete) == (16, 4, True, True)


def test_choices_and_states_are_one_hot():
    env = envs.make("gymnasium:FrozenLake-v1")
    state, transition = env.step(env.reset(jax.random.key(0)), np.array([0.1, 0.9, 0.3, 0.0]))
    np.testing.assert_array_equal(transition.action, [0, 1, 0, 0])
    np.testing.assert_array_equal(transition.obs, np.eye(16)[0])
    assert state.obs.sum() == state.obs.max() == 1


@pytest.mark.parametrize("env_id", ("HalfCheetah-v5", "CartPole-v1", "jaxplore_test/Toy-v0"))
def test_a_saved_state_continues_to_the_bit_in_another_process_and_in_this_one(env_id):
    """What another process has of a state are copies of its numbers, and no live environment."""
    env = envs.make(f"gymnasium:{env_id}", obs_noise=0.1)
    actions = actions_for(env, 8)
    states, transitions = walk(env, env.reset(jax.random.key(1)), actions)
    copies = [
        jax.tree.map(lambda leaf: leaf if isinstance(leaf, jax.Array) else leaf.copy(), state) for state in states
    ]
    other = envs.make(f"gymnasium:{env_id}", obs_noise=0.1)
    for begin in (5, 2, 0):  # backwards: the live environment is never where it should be
        for from_states, follower in ((copies, other), (states, env)):
            again, transitions_again = walk(follower, from_states[begin], actions[begin:])
            assert_same_state(again[-1], states[-1])
            for a, b in zip(transitions_again, transitions[begin:], strict=True):
                for left, right in zip(a, b, strict=True):
                    np.testing.assert_array_equal(left, right)


def test_terminated_and_truncated_stay_apart():
    env = envs.make("gymnasium:jaxplore_test/Toy-v0")
    up, down = np.array([1.0, 0.0]), np.array([-1.0, 0.0])
    _, ups = walk(env, env.reset(jax.random.key(0)), [up] * 5)
    assert [(bool(t.terminated), bool(t.truncated)) for t in ups] == [(False, False)] * 4 + [(True, False)]
    _, downs = walk(env, env.reset(jax.random.key(0)), [down] * 4)
    assert [(bool(t.terminated), bool(t.truncated)) for t in downs] == [(False, False)] * 3 + [(False, True)]
    short = envs.make("gymnasium:jaxplore_test/Toy-v0", episode_steps=2)
    _, cut = walk(short, short.reset(jax.random.key(0)), [up] * 2)
    assert [(bool(t.terminated), bool(t.truncated)) for t in cut] == [(False, False), (False, True)]


def test_actions_are_stretched_to_the_limits_and_clipped():
    env = envs.make("gymnasium:jaxplore_test/Toy-v0")
    state = env.reset(jax.random.key(0))
    for action, native in ((-1.0, -1.0), (0.0, 1.0), (1.0, 3.0), (0.5, 2.0), (7.0, 3.0)):
        _, transition = env.step(state, np.array([action, -action]))
        assert transition.next_obs[3] == native
        assert transition.reward == pytest.approx(0.25 - 0.25 * np.clip(action, -1, 1))
        assert abs(transition.action[0]) <= 1


def act(key, obs):
    return jax.random.uniform(key, (2,), minval=-1.0) + 0.01 * obs[0]


def test_seeds_side_by_side_are_each_alone_and_no_reset_is_a_successor():
    """Through episodes of 4 to 8 steps, which end at different times."""
    env, alone = (envs.make("gymnasium:jaxplore_test/Toy-v0", obs_noise=0.01) for _ in range(2))
    keys, reset_keys = jax.random.split(jax.random.key(5), (2, 3))

    @jax.jit
    def act_all(keys, obs):
        keys, act_keys, reset_keys = jax.vmap(lambda key: jax.random.split(key, 3))(keys).T
        return keys, jax.vmap(act)(act_keys, obs), reset_keys

    assert env.reset_all is not None
    states, rows, valid = make_collect_all(env, 25)(keys, env.reset_all(reset_keys), act_all, 20)
    assert rows.obs.shape == (3, 25, 4)
    ends = rows.terminated | rows.truncated
    assert len({tuple(row) for row in ends}) == 3
    assert ends.sum() > 6
    for i in range(3):
        state, own, own_valid = make_collect(alone, 25)(keys[i], alone.reset(reset_keys[i]), jax.jit(act), 20)
        assert_same_state(states[i], state)
        np.testing.assert_array_equal(valid[i], own_valid)
        for left, right in zip(rows, own, strict=True):
            np.testing.assert_array_equal(left[i], right)
        for t in range(19):
            counts = rows.next_obs[i, t, :2].sum()
            if ends[i, t]:  # the last successor has counted this step, the next episode has not
                assert counts == pytest.approx(np.round(counts), abs=0.1)
                assert np.round(counts) >= 4
                assert np.round(rows.obs[i, t + 1, :2].sum()) == 0
            else:
                np.testing.assert_array_equal(rows.next_obs[i, t], rows.obs[i, t + 1])


def test_an_environment_that_does_not_repeat_itself_is_found_out():
    env = envs.make("gymnasium:jaxplore_test/Forgetful-v0")
    with pytest.raises(EnvironmentFault, match=r"went elsewhere from the same seed.*Expected: an environment that"):
        walk(env, env.reset(jax.random.key(0)), actions_for(env, 3))


class Drifting(Toy):
    """Begins as its seed says, and goes on as it likes."""

    def step(self, action):
        obs, *rest = super().step(action)
        return {**obs, "others": obs["others"] + np.random.default_rng().uniform()}, *rest


gymnasium.register("jaxplore_test/Drifting-v0", Drifting)


def test_a_state_of_chance_is_not_taken_up_by_another_process():
    first, second = (envs.make("gymnasium:jaxplore_test/Drifting-v0") for _ in range(2))
    states, _ = walk(first, first.reset(jax.random.key(0)), actions_for(first, 4))
    with pytest.raises(EnvironmentFault, match=r"so it cannot be resumed, at its second time there\. Expected: an env"):
        second.step(states[3], np.zeros(2))


class Faulty(Toy):
    """Does as told at its third step, or at its reset."""

    how = ""

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        self.count = 0
        if self.how == "reset raises":
            raise KeyError("lost")
        if self.how == "three values from reset":
            return obs, info, None  # pyright: ignore[reportReturnType]
        scale = {"reset is nan": np.nan, "reset is huge": 3e38}.get(self.how, 1.0)
        return {**obs, "others": np.ones(2) * scale}, info

    def step(self, action):
        found = super().step(action)
        self.count += 1
        obs, reward, *rest = found
        if self.count < 3:
            return found
        match self.how:
            case "raises":
                raise RuntimeError("the motor\nis on fire")
            case "four values":
                return found[:4]
            case "shape":
                return ({**obs, "counts": np.zeros(3, np.float32)}, reward, *rest)
            case "ragged":
                return ({**obs, "counts": [[1.0], [2.0, 3.0]]}, reward, *rest)
            case "nothing":
                return (None, reward, *rest)
            case "two ends":
                return (obs, reward, np.zeros(2, bool), *rest[1:])
            case "no dictionary":
                return (obs, reward, *rest[:2], None)
            case "lacks a part":
                return ({"counts": obs["counts"]}, reward, *rest)
            case "nan reward":
                return (obs, np.nan, *rest)
            case "huge reward":
                return (obs, 3e38, *rest)
            case "no reward":
                return (obs, None, *rest)
        return found


gymnasium.register("jaxplore_test/Faulty-v0", Faulty)


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize(
    ("how", "when", "message"),
    [
        ("reset raises", 0, r"raised KeyError: 'lost' at reset\. Expected: an observation and a dictionary\.$"),
        ("three values from reset", 0, r"returned 3 values at reset\. Expected: an observation and a dictionary\.$"),
        ("reset is nan", 0, r"returned an observation with numbers that are not finite at reset\."),
        (
            "reset is huge",
            0,
            r"returned an observation with numbers as large as 3e\+38 at reset\. .*between -1e\+18 and ",
        ),
        ("raises", 3, r"raised RuntimeError: the motor at step 3 of an episode\. Expected: an observation, a reward, "),
        ("four values", 3, r"returned 4 values at step 3 .*Expected: an observation, a reward, terminated, truncated"),
        ("shape", 3, r"returned an observation counts of shape \(3,\) at step 3 .*Expected: shape \(2,\)"),
        ("ragged", 3, r"returned an observation counts that is no array of numbers at step 3 .*Expected: shape \(2,\)"),
        ("nothing", 3, r"returned the observation NoneType at step 3 .*Expected: a dictionary with counts, others"),
        ("two ends", 3, r"returned terminated and truncated of shape \(2,\) and .* at step 3 .*: True or False"),
        ("no dictionary", 3, r"returned NoneType for the dictionary at step 3 .*Expected: an observation, a reward"),
        ("lacks a part", 3, r"returned the observation counts at step 3 .*Expected: a dictionary with counts, others"),
        ("nan reward", 3, r"returned the reward nan at step 3 .*Expected: a number between -1e\+18 and 1e\+18"),
        ("huge reward", 3, r"returned the reward 3e\+38 at step 3"),
        ("no reward", 3, r"returned a reward of type NoneType at step 3 .*Expected: one number"),
    ],
)
def test_what_it_does_wrong_is_said_in_a_line(how, when, message, size, monkeypatch):
    monkeypatch.setattr(Faulty, "how", how)
    env = envs.make("gymnasium:jaxplore_test/Faulty-v0")
    assert env.reset_all is not None and env.step_all is not None
    keys = jax.random.split(jax.random.key(0), size)
    if when == 0:
        with pytest.raises(EnvironmentFault, match=message):
            env.reset_all(keys)
        return
    states = env.reset_all(keys)
    for _ in range(when - 1):
        states, _ = env.step_all(states, np.zeros((size, 2), np.float32))
    with pytest.raises(
        EnvironmentFault, match="the environment gymnasium:jaxplore_test/Faulty-v0 " + message
    ) as caught:
        env.step_all(states, np.zeros((size, 2), np.float32))
    assert "\n" not in str(caught.value)


def test_an_environment_that_cannot_be_made_says_why():
    class Unmade(Toy):
        def __init__(self):
            raise OSError("no such robot")

    gymnasium.registry.pop("jaxplore_test/Unmade-v0", None)
    gymnasium.register("jaxplore_test/Unmade-v0", Unmade)
    with pytest.raises(ValueError, match=r"Unmade-v0' cannot be made here: raised OSError: no such robot\. Allowed: "):
        envs.make("gymnasium:jaxplore_test/Unmade-v0")


def test_what_no_float32_can_square_is_no_data():
    class Exploding(Toy):
        def _obs(self):
            obs = super()._obs()
            return {**obs, "others": obs["others"] + (3e38 if self.ups else 0.0)}

    gymnasium.registry.pop("jaxplore_test/Exploding-v0", None)
    gymnasium.register("jaxplore_test/Exploding-v0", Exploding)
    env = envs.make("gymnasium:jaxplore_test/Exploding-v0")
    _, transition = env.step(env.reset(jax.random.key(0)), np.ones(2))
    assert transition.terminated
    assert not np.isfinite(transition.next_obs).all()


def test_a_state_that_is_not_finite_ends_the_episode():
    class Broken(Toy):
        def _obs(self):
            obs = super()._obs()
            return {**obs, "others": obs["others"] / (0.0 if self.ups else 1.0)}

    gymnasium.register("jaxplore_test/Broken-v0", Broken)
    env = envs.make("gymnasium:jaxplore_test/Broken-v0")
    with np.errstate(divide="ignore"):
        _, transition = env.step(env.reset(jax.random.key(0)), np.ones(2))
    assert transition.terminated
    assert not np.isfinite(transition.next_obs).all()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "gymnasium:Pendulum-v9",
            {},
            r"env='gymnasium:Pendulum-v9' is not known\. Did you mean 'gymnasium:Pendulum-v1'\? Allowed: .* nearest "
            r"are (gymnasium:\S+, ){4}gymnasium:\S+\.$",
        ),
        ("gymnasium:?", {}, r"env='gymnasium:\?' is not known\. Allowed: a name that is known; the nearest are gym"),
        (
            "gymnasium:gymnasium:Pendulun-v1",
            {},
            r"env='gymnasium:gymnasium:Pendulun-v1' is not known\. Did you mean 'gymnasium:gymnasium:Pendulum-v1'\?",
        ),
        (
            "gymnasium:nowhere:Own-v0",
            {},
            "needs the module 'nowhere', .* with --import=nowhere, or after `import nowh",
        ),
        (
            "gymnasim:Pendulum-v1",
            {},
            r"env='gymnasim:NAME' is not known\. Did you mean 'gymnasium:NAME'\? Allowed: brax:NAME, gymnasium:NAME",
        ),
        ("gymnasium:Pendulum-v1", {"backend": "mjx"}, r"backend='mjx' is not known\. Allowed: auto, gymnasium"),
        ("gymnasium:Pendulum-v1", {"obs_noise": -1}, "obs_noise=-1 is out of range"),
        ("gymnasium:Pendulum-v1", {"episode_steps": 0}, "episode_steps=0 is out of range"),
        ("gymnasium:Pendulum-v1", {"nois": 1}, r"'nois' is not known\. Did you mean 'obs_noise'"),
        ("gymnasium:Blackjack-v1", {}, r"observations Tuple.*Allowed: a Box of one axis, a Dict of such, or Discrete"),
        ("gymnasium:jaxplore_test/Pixels-v0", {}, r"pictures\. Allowed: a Box of one axis"),
        ("gymnasium:jaxplore_test/Unbounded-v0", {}, r"actions Box.*Allowed: a Box with finite limits, or Discrete"),
        ("gymnasium:jaxplore_test/Several-v0", {}, r"actions MultiDiscrete.*Allowed: a Box with finite limits"),
    ],
)
def test_refuses_what_it_cannot_do_and_says_what_it_can(name, options, message):
    class Pixels(Toy):
        observation_space = spaces.Box(0, 255, (8, 8, 3), np.uint8)

    class Unbounded(Toy):
        action_space = spaces.Box(-np.inf, np.inf, (2,))

    class Several(Toy):
        action_space = spaces.MultiDiscrete([2, 3])

    for kind in (Pixels, Unbounded, Several):
        gymnasium.registry.pop(f"jaxplore_test/{kind.__name__}-v0", None)
        gymnasium.register(f"jaxplore_test/{kind.__name__}-v0", kind)
    with pytest.raises(ValueError, match=message):
        envs.make(name, **options)


def test_a_name_imports_nothing(tmp_path, monkeypatch):
    (tmp_path / "jaxplore_own.py").write_text(
        "import gymnasium, tests.envs.adapters.test_from_gymnasium as here\n"
        "gymnasium.register('jaxplore_test/Own-v0', here.Toy)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    name = "gymnasium:jaxplore_own:jaxplore_test/Own-v0"
    for refused in (envs.check_name, envs.make):
        with pytest.raises(ValueError, match=r"needs the module 'jaxplore_own', which has not been imported"):
            refused(name)
    assert "jaxplore_own" not in sys.modules
    importlib.import_module("jaxplore_own")
    assert envs.make(name).spec.name == name
    monkeypatch.delitem(sys.modules, "jaxplore_own")
    gymnasium.registry.pop("jaxplore_test/Own-v0")


def test_refuses_bad_actions():
    env = envs.make("gymnasium:Pendulum-v1")
    state = env.reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"action has shape \(2,\)\. Allowed: \(1,\)"):
        env.step(state, np.zeros(2))
    with pytest.raises(ValueError, match="Allowed: finite numbers"):
        env.step(state, np.array([np.nan]))


@pytest.mark.parametrize(
    ("drawn", "message"),
    [
        (
            None,
            r"returned a picture of type NoneType at step 1 of an episode\. Expected: a picture, \[height, width, ",
        ),
        (OSError("no screen"), r"raised OSError: no screen at step 1 of an episode\. Expected: a picture"),
    ],
)
def test_a_picture_that_cannot_be_drawn_is_said_in_a_line(drawn, message):
    class Undrawn(Toy):
        metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

        def __init__(self, render_mode=None):
            self.render_mode = render_mode

        def render(self):
            if drawn is not None:
                raise drawn

    gymnasium.registry.pop("jaxplore_test/Undrawn-v0", None)
    gymnasium.register("jaxplore_test/Undrawn-v0", Undrawn)
    env = envs.make("gymnasium:jaxplore_test/Undrawn-v0")
    states, _ = walk(env, env.reset(jax.random.key(0)), [np.ones(2)])
    assert env.view is not None
    with pytest.raises(EnvironmentFault, match=message):
        list(env.view.frames(states[1:], 8, 10, "own"))


def test_pictures_are_of_the_states_in_any_order():
    class Painted(Toy):
        metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
        render_mode = None

        def __init__(self, render_mode=None):
            self.render_mode = render_mode

        def render(self):
            return np.full((4, 6, 3), 10 * self.ups + self.downs, np.uint8)

    gymnasium.registry.pop("jaxplore_test/Painted-v0", None)
    gymnasium.register("jaxplore_test/Painted-v0", Painted)
    env = envs.make("gymnasium:jaxplore_test/Painted-v0")
    states, _ = walk(env, env.reset(jax.random.key(0)), [np.ones(2), -np.ones(2), np.ones(2)])
    assert env.view is not None
    frames = list(env.view.frames([*states, states[1]], 8, 10, "own"))
    assert [(frame.shape, frame.min(), frame.max()) for frame in frames] == [
        ((8, 10, 3), value, value) for value in (0, 10, 11, 21, 10)
    ]
