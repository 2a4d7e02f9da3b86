"""The acrobot beside Gymnasium's, and against what physics says of two links without friction."""

import dataclasses
import itertools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import acrobot, coverage
from envs.acrobot import SPEC, make_acrobot
from envs.stepper import make_collect

RIGHT, LEFT, DOWN = np.pi / 2, -np.pi / 2, 0.0


@pytest.fixture(scope="module")
def env():
    return make_acrobot()


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def peer():
    peer = gymnasium.make("Acrobot-v1").unwrapped
    peer.reset(seed=0)
    return peer


def obs_at(theta1, theta2):
    return acrobot.observe(jnp.zeros(4), jnp.array([theta1, theta2, 1.0, -2.0]))


def pumping(state):
    """Gymnasium's choice, 0 to 2, that adds energy: torque with the elbow's velocity."""
    return int(np.sign(state[3])) + 1


@pytest.mark.parametrize("policy", ["random", "pumping"])
def test_each_step_is_gymnasiums(env, step, peer, policy):
    # 600 steps of the three torques that both have, each from our state; float32 against float64. Pumping swings it
    # over the top, so that angles wrap and the second velocity comes near its bound
    rng, height = np.random.default_rng(0), jax.jit(acrobot.height)
    state = env.reset(jax.random.key(0))
    above = wrapped = 0
    for _ in range(600):
        physics = jax.device_get(state.physics).astype(float)
        choice = pumping(physics) if policy == "pumping" else int(rng.integers(3))
        peer.state = physics
        want, want_reward, at_goal, _, _ = peer.step(choice)
        state, transition = step(state, np.array([choice - 1.0], np.float32))
        np.testing.assert_allclose(transition.next_obs, want, atol=2e-5)
        if abs(float(height(state.physics)) - 1) > 1e-4:
            assert transition.reward == want_reward
        assert not transition.terminated
        above += at_goal
        wrapped += abs(float(state.physics[0]) - physics[0]) > 3
    if policy == "pumping":
        assert 50 < above < 550
        assert wrapped > 10


def test_in_float64_whole_trajectories_agree_to_rounding(x64, peer):
    # 60 steps (12 s) without putting the states back together: chaos makes 1e-16 about 1e-10
    advance = jax.jit(acrobot.advance)
    rng, state = np.random.default_rng(1), jnp.array([1.9, -0.7, 0.3, 2.0])
    peer.state = jax.device_get(state)
    for _ in range(60):
        choice = int(rng.integers(3))
        want = peer.step(choice)[0]
        state = advance(jax.random.key(0), state, jnp.array([choice - 1.0]))
        np.testing.assert_allclose(peer.state[2:], state[2:], atol=1e-9)
        np.testing.assert_allclose(acrobot.observe(state, state), want, atol=1e-6)


def test_velocities_are_bounded_as_gymnasium_does(step, env, peer):
    for speeds in ((13.0, 29.0), (-13.0, -29.0)):
        physics = np.array([0.3, -0.4, *speeds])
        peer.state = physics
        want = peer.step(1)[0]
        state = env.reset(jax.random.key(0)).replace(physics=jnp.asarray(physics, jnp.float32))
        got = step(state, np.zeros(1, np.float32))[1].next_obs
        np.testing.assert_allclose(got, want, atol=1e-4)
        assert abs(want[4]) == pytest.approx(4 * np.pi)


def energy(state):
    """Kinetic and potential energy [J] from the positions and velocities of the centres of mass."""
    theta1, theta2, speed1, speed2 = np.moveaxis(np.asarray(state), -1, 0)
    both, speed_both = theta1 + theta2, speed1 + speed2
    elbow_v = np.stack([np.cos(theta1), np.sin(theta1)]) * speed1
    centre_v = elbow_v + 0.5 * np.stack([np.cos(both), np.sin(both)]) * speed_both
    kinetic = 0.5 * (0.25 * speed1**2 + np.sum(centre_v**2, axis=0)) + 0.5 * (speed1**2 + speed_both**2)
    return kinetic + 9.8 * (-0.5 * np.cos(theta1) - np.cos(theta1) - 0.5 * np.cos(both))


@jax.jit
def swing(state, torque, dt, num_steps):
    return jax.lax.fori_loop(0, num_steps, lambda i, s: acrobot.integrate(s, torque, dt), state)


def test_energy_stays_to_the_order_of_the_integrator(x64):
    # 5 s of free swing from rest. At steps of 0.2 s the drift is small; a rule of order 4 makes it at least 2^4 times
    # smaller with each halving of the step
    start = jnp.array([0.7, -0.5, 0.0, 0.0])
    drift = [abs(energy(swing(start, 0.0, 0.2 / n, 25 * n)) - energy(start)) for n in (1, 2, 4, 8)]
    assert drift[0] < 0.05
    assert all(fine < coarse / 16 for coarse, fine in itertools.pairwise(drift))


def test_torque_does_its_work(x64):
    # the energy gained is torque times the angle through which the second joint turned
    start = jnp.array([0.4, -0.3, 0.5, -0.2])
    end = swing(start, 0.7, 1e-3, 1500)
    assert abs(end[1] - start[1]) > 0.1
    assert energy(end) - energy(start) == pytest.approx(0.7 * float(end[1] - start[1]), abs=1e-9)


def test_mirrored_torques_give_the_mirrored_swing(env, step):
    state = env.reset(jax.random.key(3))
    mirror = state.replace(physics=-state.physics, obs=state.obs * jnp.array([1, -1, 1, -1, -1, -1]))
    for action in np.random.default_rng(0).uniform(-1, 1, (30, 1)).astype(np.float32):
        state, mirror = step(state, action)[0], step(mirror, -action)[0]
        np.testing.assert_allclose(mirror.physics, -state.physics, atol=1e-5)


@pytest.mark.parametrize(
    ("theta1", "theta2", "cell"),
    [
        (RIGHT, 0.0, 0),
        (LEFT, 0.0, 1),
        (DOWN, 0.0, -1),
        (np.pi, 0.0, -1),  # upright
        (RIGHT, np.pi, -1),  # folded back: the second link points to the left
        (LEFT, np.pi, -1),
        (RIGHT, np.pi / 2, -1),  # first link to the right, second up
        (DOWN, RIGHT, -1),  # only the second link to the right
        (RIGHT - 0.31, 0.62, 0),  # 17.8 degrees below, 17.8 above; 18.2 are allowed
        (RIGHT - 0.33, 0.33, -1),
        (RIGHT, 0.33, -1),
        (LEFT + 0.31, -0.31, 1),
        (LEFT + 0.33, 0.0, -1),
    ],
)
def test_cells_are_horizontal_to_the_right_and_to_the_left(env, theta1, theta2, cell):
    assert env.coverage.cell(obs_at(theta1, theta2)) == cell


def test_the_tolerance_is_an_argument():
    for horizontal, cell in ((0.9, 0), (0.95, -1)):  # sin is 0.921
        assert make_acrobot(horizontal=horizontal).coverage.cell(obs_at(RIGHT - 0.4, 0.0)) == cell


def test_a_scripted_swing_sees_both_sides(env):
    # coverage counts each side once, however often it is passed
    cover, fractions = env.coverage, []
    visited = coverage.init(cover)
    for angle in (DOWN, RIGHT, DOWN, RIGHT, DOWN, LEFT):
        visited = coverage.update(visited, cover.cell(obs_at(angle, 0.0)))
        fractions.append(float(coverage.fraction(visited)))
    assert fractions == [0, 0.5, 0.5, 0.5, 0.5, 1]


def test_reset_hangs_within_its_range_and_is_the_same_for_the_same_key(env):
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2000))
    physics = jax.device_get(states.physics)
    assert physics.shape == (2000, 4)
    assert np.all(np.abs(physics) <= 0.1)
    np.testing.assert_allclose(physics.std(axis=0), 0.1 / np.sqrt(3), rtol=0.05)
    again = env.reset(jax.random.split(jax.random.key(0), 2000)[7])
    np.testing.assert_array_equal(again.physics, physics[7])
    np.testing.assert_array_equal(again.obs, states.obs[7])


def test_an_episode_is_500_steps_and_its_goal_ends_nothing(env):
    # torque with the elbow's velocity swings the tip over the bar
    collect = make_collect(env, 1001)
    run = jax.jit(lambda key, state: collect(key, state, lambda key, obs: jnp.sign(obs[5:]), 1001))
    _, rows, valid = run(jax.random.key(1), env.reset(jax.random.key(0)))
    assert np.all(valid)
    assert not np.any(rows.terminated)
    np.testing.assert_array_equal(np.flatnonzero(rows.truncated), [499, 999])
    assert {-1.0, 0.0} == set(np.unique(rows.reward))
    assert rows.obs.shape == (1001, SPEC.obs_size)


def test_noise_is_on_what_is_seen_only(env):
    noisy, action = make_acrobot(obs_noise=0.05), jnp.zeros(1)
    for state, twin in [(env.reset(jax.random.key(5)), noisy.reset(jax.random.key(5)))]:
        after, seen = jax.jit(env.step)(state, action)[0], jax.jit(noisy.step)(twin, action)[0]
        np.testing.assert_array_equal(after.physics, seen.physics)
        assert np.all(np.abs(after.obs - seen.obs) > 0)


def test_actions_beyond_1_are_clipped(env, step):
    state = env.reset(jax.random.key(0))
    np.testing.assert_array_equal(step(state, jnp.array([7.0]))[0].physics, step(state, jnp.array([1.0]))[0].physics)


def test_the_picture_shows_where_the_links_are(env):
    # to the right, something is drawn at the right end of the horizontal, and nothing hangs below; and mirrored
    state = env.reset(jax.random.key(0))
    states = [state.replace(physics=jnp.array([theta, 0.0, 0.0, 0.0])) for theta in (RIGHT, LEFT, DOWN)]
    right, left, down = env.view.frames(states, 92, 92, "sketch")  # 20 pixels a metre, the pivot in the middle

    def dark(frame, x, y):
        return int(frame[46 - round(20 * y), 46 + round(20 * x)].min()) < 160

    for frame, seen in ((right, (True, False, False)), (left, (False, True, False)), (down, (False, False, True))):
        assert tuple(dark(frame, *at) for at in ((1.5, 0.0), (-1.5, 0.0), (0.0, -1.5))) == seen


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backend": "mjx"}, "backend='mjx' is not known.*Allowed: auto, jax"),
        ({"obs_noise": -0.1}, r"obs_noise=-0\.1 is out of range"),
        ({"horizontal": 1.5}, r"horizontal=1\.5 is out of range\. Allowed: a finite number in \(0, 1\]"),
        ({"horizontal": 0.0}, r"horizontal=0\.0 is out of range"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_acrobot(**options)


def test_an_action_of_the_wrong_shape_is_refused(env):
    with pytest.raises(ValueError, match=r"action has shape \(3,\)\. Allowed: \(1,\)"):
        env.step(env.reset(jax.random.key(0)), jnp.zeros(3))


def test_a_state_that_is_not_finite_ends_the_episode(env, step):
    state = env.reset(jax.random.key(0))
    _, transition = step(dataclasses.replace(state, physics=state.physics.at[2].set(jnp.nan)), jnp.zeros(1))
    assert transition.terminated
