"""The mountain car beside Gymnasium's, and on drives worked out beforehand."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import coverage
from envs.mountain_car import GOAL_POSITION, REACHABLE, SPEC, make_mountain_car
from envs.stepper import make_collect


@pytest.fixture(scope="module")
def env():
    return make_mountain_car()


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


@pytest.fixture(scope="module")
def peer():
    peer = gymnasium.make("MountainCarContinuous-v0").unwrapped
    peer.reset(seed=0)
    return peer


def put(env, position, velocity):
    physics = jnp.array([position, velocity], jnp.float32)
    return env.reset(jax.random.key(0)).replace(physics=physics, obs=physics)


def with_velocity(key, obs):
    """Push the way it rolls: the quickest simple way up."""
    return jnp.where(obs[1:] < 0, -1.0, 1.0)


def test_each_step_is_gymnasiums(env, step, peer):
    # random states all over the box, beyond the flag too, and random pushes, some too strong
    rng = np.random.default_rng(0)
    ends = stops = 0
    for _ in range(600):
        state = put(env, rng.uniform(-1.2, 0.6), rng.uniform(-0.07, 0.07))
        action = rng.uniform(-1.3, 1.3, 1).astype(np.float32)
        peer.state = jax.device_get(state.physics)
        want, reward, terminated, _, _ = peer.step(action)
        _, transition = step(state, action)
        np.testing.assert_allclose(transition.next_obs, want, atol=2e-7)
        if abs(want[0] - GOAL_POSITION) > 1e-6:
            assert transition.terminated == terminated
            assert transition.reward == (100 if terminated else 0)
        # Gymnasium's reward is ours less what the push costs.
        assert float(transition.reward) == pytest.approx(reward + 0.1 * float(action[0]) ** 2, abs=1e-5)
        ends += terminated
        stops += want[0] == np.float32(-1.2)
    assert ends > 20
    assert stops > 5


def test_a_whole_drive_is_gymnasiums(env, step, peer):
    # from one state on, until the flag: rounding does not grow
    state = put(env, -0.5, 0.0)
    peer.state = jax.device_get(state.physics)
    for _ in range(500):
        action = jax.device_get(with_velocity(None, state.obs))
        want, _, terminated, _, _ = peer.step(action)
        state, transition = step(state, action)
        np.testing.assert_allclose(transition.next_obs, want, atol=1e-5)
        assert transition.terminated == terminated
        if terminated:
            break
    assert transition.terminated
    assert 60 < state.num_steps < 200


@pytest.fixture(scope="module")
def drive(env):
    """`drive(full_throttle, num_steps) -> transitions`: the way it rolls, or always forward."""
    collect = make_collect(env, 501)

    @jax.jit
    def run(full_throttle, num_steps):
        act = lambda key, obs: jnp.where(full_throttle, 1.0, with_velocity(key, obs))  # noqa: E731
        return collect(jax.random.key(1), env.reset(jax.random.key(0)), act, num_steps)[1]

    return lambda full_throttle, num_steps: jax.tree.map(lambda leaf: leaf[:num_steps], run(full_throttle, num_steps))


def test_the_flag_ends_an_episode_and_pays_100(drive):
    rows = drive(False, 400)
    ends = np.asarray(rows.terminated)
    assert 2 <= ends.sum() <= 6
    assert not np.any(rows.truncated)
    np.testing.assert_array_equal(rows.reward, 100.0 * ends)
    assert np.all(rows.next_obs[ends, 0] >= GOAL_POSITION)
    starts = rows.obs[1:][ends[:-1]]
    assert np.all((starts[:, 0] >= -0.6) & (starts[:, 0] <= -0.4) & (starts[:, 1] == 0))


def test_full_throttle_alone_does_not_reach_the_flag_and_is_cut_at_500(drive):
    rows = drive(True, 501)
    assert not np.any(rows.terminated)
    np.testing.assert_array_equal(np.flatnonzero(rows.truncated), [499])
    assert np.all(rows.reward == 0)


@pytest.mark.parametrize(
    ("position", "velocity", "ends"),
    [
        (0.44, 0.02, True),
        (0.44, 0.001, False),  # not there yet
        (0.47, -0.01, False),  # at the flag, but rolling back
        (0.60, 0.0, True),
    ],
)
def test_only_the_flag_ends_the_task(env, step, position, velocity, ends):
    assert step(put(env, position, velocity), jnp.zeros(1))[1].terminated == ends


def test_the_wall_stops_the_car(env, step):
    state, _ = step(put(env, -1.18, -0.05), jnp.zeros(1))
    np.testing.assert_array_equal(state.physics, np.array([-1.2, 0.0], np.float32))


def test_reset_is_at_rest_in_the_valley_and_the_same_for_the_same_key(env):
    keys = jax.random.split(jax.random.key(0), 2000)
    states = jax.device_get(jax.jit(jax.vmap(env.reset))(keys).physics)
    assert np.all((states[:, 0] >= -0.6) & (states[:, 0] <= -0.4))
    assert states[:, 0].std() == pytest.approx(0.2 / np.sqrt(12), rel=0.05)
    assert not np.any(states[:, 1])
    np.testing.assert_array_equal(env.reset(keys[3]).physics, states[3])


def test_cells_are_ten_by_ten_of_position_and_velocity(env):
    # cells are 0.18 wide and 0.014 high; velocity runs fastest
    assert env.coverage.num_cells == 100
    for position, velocity, cell in ((-1.2, -0.07, 0), (-1.2, 0.07, 9), (0.6, 0.07, 99), (-0.5, 0.0071, 35)):
        assert env.coverage.cell(jnp.array([position, velocity])) == cell
    # noise beyond the box counts at its border
    assert env.coverage.cell(jnp.array([-1.3, -0.1])) == 0


def test_no_drive_leaves_the_cells_that_are_said_to_be_reachable(env):
    # 4,000 drives that push for a while one way, a while the other, find nearly all of the 90, and no other
    @jax.jit
    @jax.vmap
    def drive(key):
        collect = make_collect(env, 150)

        def act(key, obs):
            return jnp.where(jax.random.bernoulli(key, 0.15), -1.0, 1.0) * jnp.where(obs[1:] < 0, -1.0, 1.0)

        reset_key, key = jax.random.split(key)
        return collect(key, env.reset(reset_key), act, 150)[1].obs

    seen = coverage.update_from_obs(
        env.coverage, coverage.init(env.coverage), drive(jax.random.split(jax.random.key(0), 4000))
    )
    assert env.coverage.reachable == REACHABLE
    assert 80 < int(seen.sum()) <= REACHABLE


def test_the_picture_shows_where_the_car_is(env):
    # the columns in which something blue is drawn lie at the car's position; the picture is 2 wide, from -1.3 to 0.7
    positions = [-1.0, -0.5, 0.1]
    for position, frame in zip(
        positions, env.view.frames([put(env, x, 0.0) for x in positions], 145, 200, "sketch"), strict=True
    ):
        red, _, blue = np.moveaxis(frame.astype(int), -1, 0)
        columns = np.flatnonzero(np.any((blue > red + 60) & (red < 90), axis=0))
        assert -1.3 + columns.mean() / 100 == pytest.approx(position, abs=0.06)


def test_shapes_are_those_of_the_spec(env, step):
    state, transition = step(env.reset(jax.random.key(0)), jnp.zeros(1))
    assert state.obs.shape == transition.next_obs.shape == (SPEC.obs_size,)
    assert state.obs.dtype == jnp.float32
    with pytest.raises(ValueError, match=r"action has shape \(2,\)\. Allowed: \(1,\)"):
        env.step(state, jnp.zeros(2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backend": "mujoco"}, "backend='mujoco' is not known.*Allowed: auto, jax"),
        ({"obs_noise": -1}, "obs_noise=-1 is"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_mountain_car(**options)
