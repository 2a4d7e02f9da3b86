import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.stepper import make_collect

BACKENDS = ["mujoco", "mjx"]


def act(key, obs):
    """A random push, different from step to step, that also depends on what is seen."""
    return 0.5 * jax.random.uniform(key, (1,), minval=-1.0) + 0.1 * jnp.tanh(obs[:1])


def collect_with(env, num_steps, seed=0):
    """Collects from a fresh episode, in one program where `env` allows."""
    reset_key, key = jax.random.split(jax.random.key(seed))
    collect = make_collect(env, num_steps)
    if env.compiled:
        run = jax.jit(lambda key, reset_key: collect(key, env.reset(reset_key), act, num_steps))
        state, transitions, valid = run(key, reset_key)
    else:
        state, transitions, valid = collect(key, env.reset(reset_key), jax.jit(act), num_steps)
    assert np.all(valid)
    return state, transitions


@pytest.mark.parametrize("backend", BACKENDS)
def test_shapes_and_types(make_bead, backend):
    _, transitions = collect_with(make_bead(backend), 20)
    shapes = [leaf.shape for leaf in transitions]
    assert shapes == [(20, 2), (20, 1), (20,), (20, 2), (20,), (20,)]
    assert [leaf.dtype for leaf in transitions] == [np.float32] * 4 + [bool] * 2


@pytest.mark.parametrize("backend", BACKENDS)
def test_resets_come_after_each_episode_and_never_enter_a_transition(make_bead, backend):
    _, transitions = collect_with(make_bead(backend, episode_steps=7), 20)
    obs, next_obs = np.asarray(transitions.obs), np.asarray(transitions.next_obs)
    ends = np.flatnonzero(transitions.truncated)
    np.testing.assert_array_equal(ends, [6, 13])
    assert not np.any(transitions.terminated)
    for t in range(19):
        if t in ends:  # a new episode: at rest, somewhere else
            assert obs[t + 1, 1] == 0
            assert abs(obs[t + 1, 0] - next_obs[t, 0]) > 1e-3
        else:
            np.testing.assert_array_equal(obs[t + 1], next_obs[t])
    # The bead moves by its own dynamics in every transition, the last of an episode too: 2 substeps of 10 N on 2 kg.
    gain = 0.01 * 10 / 2 * np.asarray(transitions.action)[:, 0]
    np.testing.assert_allclose(next_obs[:, 1], obs[:, 1] + 2 * gain, atol=1e-6)
    np.testing.assert_allclose(next_obs[:, 0], obs[:, 0] + 0.01 * (2 * obs[:, 1] + 3 * gain), atol=1e-6)


def test_both_engines_collect_the_same(make_bead):
    host_state, host = collect_with(make_bead("mujoco", obs_noise=0.01), 20)
    device_state, device = collect_with(make_bead("mjx", obs_noise=0.01), 20)
    for a, b in zip(host, device, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6)
    np.testing.assert_allclose(host_state.obs, device_state.obs, atol=2e-6)
    assert host_state.num_steps == device_state.num_steps == 6
    assert jnp.array_equal(jax.random.key_data(host_state.key), jax.random.key_data(device_state.key))


def test_goes_on_where_it_stopped(make_bead):
    env = make_bead("mujoco")
    collect = make_collect(env, 10)
    state, first, _ = collect(jax.random.key(1), env.reset(jax.random.key(0)), jax.jit(act), 10)
    _, second, _ = collect(jax.random.key(2), state, jax.jit(act), 10)
    np.testing.assert_array_equal(second.obs[0], first.next_obs[-1])
    np.testing.assert_array_equal(np.flatnonzero(second.truncated), [3])


def test_a_state_that_needs_a_reset_comes_back_reset(make_bead):
    for backend in BACKENDS:
        state, transitions = collect_with(make_bead(backend, episode_steps=7), 7)
        assert transitions.truncated[-1]
        assert state.num_steps == 0
        assert state.obs[1] == 0


def test_vmap_is_the_same_as_one_by_one(make_bead):
    env = make_bead("mjx")
    collect = make_collect(env, 9)
    keys, reset_keys = jax.random.split(jax.random.key(3), (2, 3))
    one = jax.jit(lambda key, reset_key: collect(key, env.reset(reset_key), act, 9))
    _, together, _ = jax.vmap(one)(keys, reset_keys)
    for i in range(3):
        _, alone, _ = one(keys[i], reset_keys[i])
        np.testing.assert_allclose(together.obs[i], alone.obs, atol=1e-6)


def test_the_act_key_is_new_at_every_step(make_bead):
    _, transitions = collect_with(make_bead("mujoco"), 20)
    assert len(np.unique(transitions.action)) == 20


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_termination_resets_too(make_bead, backend):
    env = make_bead(backend)

    def step(state, action):
        state, transition = env.step(state, action)
        return state, transition._replace(terminated=state.num_steps >= 3)

    state, transitions = collect_with(dataclasses.replace(env, step=step), 10)
    np.testing.assert_array_equal(np.flatnonzero(transitions.terminated), [2, 5, 8])
    assert not np.any(transitions.truncated)
    assert state.num_steps == 1


@pytest.mark.parametrize("backend", BACKENDS)
def test_fewer_steps_than_rows_are_the_same_steps_and_zeros(make_bead, backend):
    env = make_bead(backend)
    collect = make_collect(env, 8)
    traces = []

    def counted_act(key, obs):
        traces.append(1)
        return act(key, obs)

    run = jax.jit(lambda key, state, n: collect(key, state, counted_act, n)) if env.compiled else None
    start, key = env.reset(jax.random.key(0)), jax.random.key(1)
    for count in (8, 3):
        _, rows, valid = run(key, start, count) if run else collect(key, start, jax.jit(act), count)
        np.testing.assert_array_equal(valid, np.arange(8) < count)
        if count == 8:
            everything = rows
    for full, part in zip(everything, rows, strict=True):
        np.testing.assert_array_equal(full[:3], part[:3])
        assert not np.any(part[3:])
    # Two traces of one program (shapes, then the loop's body), however many steps are asked for.
    assert len(traces) == (2 if run else 0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_row_that_is_not_finite_is_not_valid(make_bead, backend):
    env = make_bead(backend)

    def step(state, action):
        after, transition = env.step(state, action)
        xp = jnp if env.compiled else np
        bad = xp.where(after.num_steps == 2, xp.inf, 0.0).astype(xp.float32)
        return after, transition._replace(next_obs=transition.next_obs + bad)

    broken = dataclasses.replace(env, step=step)
    collect = make_collect(broken, 4)
    _, _, valid = collect(jax.random.key(0), broken.reset(jax.random.key(1)), act, 4)
    np.testing.assert_array_equal(valid, [True, False, True, True])


def test_refuses_bad_numbers(make_bead):
    env = make_bead("mujoco")
    with pytest.raises(ValueError, match="capacity is 0"):
        make_collect(env, 0)
    for count in (0, 6):
        with pytest.raises(ValueError, match=f"num_steps is {count}. Allowed: 1 to 5"):
            make_collect(env, 5)(jax.random.key(0), env.reset(jax.random.key(0)), act, count)
