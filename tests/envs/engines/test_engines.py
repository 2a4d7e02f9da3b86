"""The two engines on a bead whose motion has a closed form."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.base import choose_engine
from envs.stepper import prepared

BACKENDS = ["mujoco", "mjx"]


def start(env, seed=0):
    return prepared(env).reset(jax.random.key(seed))


@pytest.mark.parametrize("backend", BACKENDS)
def test_closed_form(make_bead, backend):
    env = make_bead(backend)
    step, state = prepared(env).step, start(env)
    x, v = (float(value) for value in state.obs)
    for push in (1.0, 0.25, -0.5):
        state, transition = step(state, jnp.array([push], jnp.float32))
        for _ in range(2):  # semi-implicit Euler, 10 N on 2 kg
            v += 0.01 * 5 * push
            x += 0.01 * v
        np.testing.assert_allclose(transition.next_obs, [x, v], atol=1e-6)
        np.testing.assert_allclose(transition.reward, v - 0.5 * push, atol=1e-6)
    assert (env.backend, env.compiled) == (backend, backend == "mjx")
    assert (env.view.cameras, env.view.needs_renderer) == (("free",), True)


@pytest.mark.parametrize("backend", BACKENDS)
def test_actions_are_clipped(make_bead, backend):
    env = make_bead(backend)
    step, state = prepared(env).step, start(env)
    _, beyond = step(state, jnp.array([7.0]))
    _, limit = step(state, jnp.array([1.0]))
    for a, b in zip(beyond, limit, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("backend", BACKENDS)
def test_noise_is_seen_and_not_felt(make_bead, backend):
    clean, noisy = make_bead(backend, episode_steps=1000), make_bead(backend, obs_noise=0.3, episode_steps=1000)

    def rollout(env):
        step, state = prepared(env).step, start(env)
        transitions = []
        for push in np.sin(np.arange(600.0)):
            before = state
            state, transition = step(state, np.array([push], np.float32))
            np.testing.assert_array_equal(transition.obs, before.obs)
            np.testing.assert_array_equal(transition.next_obs, state.obs)
            transitions.append(transition)
        return state, jax.tree.map(lambda *leaves: np.stack(leaves), *transitions)

    clean_state, clean_steps = rollout(clean)
    noisy_state, noisy_steps = rollout(noisy)
    jax.tree.map(np.testing.assert_array_equal, noisy_state.physics, clean_state.physics)
    np.testing.assert_array_equal(noisy_steps.reward, clean_steps.reward)
    noise = noisy_steps.next_obs - clean_steps.next_obs
    # 1200 draws: standard errors 0.3 / sqrt(1200) = 0.0087 of the mean, 0.3 / sqrt(2400) = 0.0061 of the deviation.
    assert abs(noise.mean()) < 4 * 0.0087
    assert abs(noise.std() - 0.3) < 4 * 0.0061
    assert abs(np.corrcoef(noise[:-1, 0], noise[1:, 0])[0, 1]) < 4 / np.sqrt(600)
    assert abs(np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]) < 4 / np.sqrt(600)


def test_noise_is_the_same_on_both_engines(make_bead):
    states = [start(make_bead(backend, obs_noise=0.3), seed=5) for backend in BACKENDS]
    np.testing.assert_allclose(states[0].obs, states[1].obs, atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_divergence_terminates(make_bead, backend, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = make_bead(backend)
    state = start(env)
    # Finite, and past the largest float after 0.02 s.
    if env.compiled:
        physics = state.physics.replace(qpos=jnp.array([3.4e38]), qvel=jnp.array([3e38]))
    else:
        physics = state.physics.copy()
        physics[1:3] = 1.79e308, 1.7e308
    state = state.replace(physics=physics)
    state, transition = prepared(env).step(state, jnp.ones(1))
    assert transition.terminated
    assert not np.all(np.isfinite(transition.next_obs))
    assert not list(tmp_path.iterdir())  # MuJoCo would leave its log
    assert not prepared(env).step(start(env), jnp.ones(1))[1].terminated


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", [(), (2,), (1, 1)])
def test_refuses_an_action_of_another_shape(make_bead, backend, shape):
    env = make_bead(backend)
    with pytest.raises(ValueError, match=r"action has shape .* Allowed: \(1,\)"):
        env.step(start(env), jnp.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_host_refuses_an_action_that_is_not_finite(make_bead, value):
    env = make_bead("mujoco")
    with pytest.raises(ValueError, match=r"action is \[.*\]. Allowed: finite numbers"):
        env.step(start(env), np.array([value]))


def test_an_action_that_is_not_finite_terminates_on_the_device(make_bead):
    env = make_bead("mjx")
    assert prepared(env).step(start(env), jnp.array([jnp.nan]))[1].terminated


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf"), "much"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_refuses_noise_that_is_no_deviation(make_bead, backend, value):
    with pytest.raises(ValueError, match=r"obs_noise=.* is out of range\. Allowed: a finite .* at least 0"):
        make_bead(backend, obs_noise=value)


def test_host_entries_are_numpy(make_bead):
    env = make_bead("mujoco", obs_noise=0.1)
    state, transition = env.step(start(env), jnp.zeros(1))
    for leaf in (state.obs, transition.obs, transition.action, transition.next_obs):
        assert isinstance(leaf, np.ndarray)
        assert leaf.dtype == np.float32
    assert isinstance(transition.reward, np.float32)
    assert isinstance(transition.terminated, np.bool_)
    assert isinstance(transition.truncated, np.bool_)
    assert state.physics.dtype == np.float64


def test_device_states_can_be_sharded(make_bead):
    env = make_bead("mjx")
    devices = jax.devices()[:2]
    sharding = jax.NamedSharding(jax.sharding.Mesh(np.array(devices), ("seed",)), jax.P("seed"))
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4))
    actions = jnp.linspace(-1, 1, 4)[:, None]
    step = jax.jit(jax.vmap(env.step))
    (_, here), (_, there) = step(states, actions), step(*jax.device_put((states, actions), sharding))
    assert there.next_obs.sharding.device_set == set(devices)
    np.testing.assert_allclose(here.next_obs, there.next_obs, atol=1e-7)


def test_products_on_the_device_have_all_digits_of_float32(make_bead):
    # a GPU's own choice is 10 bits of mantissa; on a CPU only the program shows what was asked for
    env = make_bead("mjx")
    text = str(jax.make_jaxpr(env.step)(start(env), jnp.zeros(1)))
    found = re.findall(r"dot_general\[.*?precision=(.*?)\n", text, re.DOTALL)
    assert found
    assert set(found) == {"(Precision.HIGHEST, Precision.HIGHEST)"}


def test_auto_takes_the_host_where_jax_runs_on_a_cpu(make_bead, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert choose_engine("auto").BACKEND == "mujoco"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert choose_engine("auto").BACKEND == "mjx"


def test_names_the_nearest_match():
    with pytest.raises(ValueError, match=r"backend='mujocoo' .*Did you mean 'mujoco'\? Allowed: auto, mjx, mujoco"):
        choose_engine("mujocoo")
