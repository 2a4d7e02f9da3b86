import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.adapters import from_brax
from envs.stepper import make_collect

# Without physics; one joint; two joints and a target; contacts, and an end when it falls.
NAMES = (
    "fast",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("inverted_pendulum", "reacher", "hopper")),
)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_as_brax_itself(name):
    env = envs.make(f"brax:{name}")
    with from_brax.quiet():
        raw = from_brax.load().get_environment(name)
    key = jax.random.key(2)
    start_key, _ = jax.random.split(key)
    state = jax.jit(env.reset)(key)
    with jax.numpy_rank_promotion("allow"), from_brax.quiet():
        raw_reset, raw_step = jax.jit(raw.reset), jax.jit(raw.step)
        expected = raw_reset(jax.random.key_data(start_key))
    step = jax.jit(env.step)
    # Two programs, which may round differently.
    np.testing.assert_allclose(state.obs, expected.obs, rtol=1e-5, atol=1e-6)
    for action in np.random.default_rng(0).uniform(-1, 1, (20, env.spec.action_size)).astype(np.float32):
        before = state.obs
        state, transition = step(state, action)
        with jax.numpy_rank_promotion("allow"), from_brax.quiet():
            expected = raw_step(expected, action)
        np.testing.assert_array_equal(transition.obs, before)
        np.testing.assert_allclose(transition.next_obs, expected.obs, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(transition.reward, expected.reward, rtol=1e-4, atol=1e-4)
        assert bool(transition.terminated) == bool(expected.done)
        assert not transition.truncated
        if transition.terminated:
            break


def test_resets_never_enter_a_transition_and_ends_are_told_apart():
    """An environment of Brax's kind that counts its steps, drifts by what its key says, and is done at 5."""
    brax = from_brax.load()

    class Counter(brax.Env):
        observation_size, action_size, backend = 2, 1, "jax"

        def reset(self, rng):
            drift = jax.random.uniform(rng)
            return brax.State(drift, jnp.array([0.0, drift]), jnp.float32(0), jnp.float32(0))

        def step(self, state, action):
            obs = state.obs + jnp.array([1.0, 0.0])
            return state.replace(obs=obs, reward=2 * action[0], done=jnp.where(obs[0] >= 5, 1.0, 0.0))

    brax.register_environment("counter", Counter)
    for limit, ends in ((3, [2, 5]), (9, [4])):
        env = envs.make("brax:counter", episode_steps=limit)
        collect = make_collect(env, 8)
        run = jax.jit(lambda key, env=env, collect=collect: collect(key, env.reset(key), lambda *_: jnp.ones(1), 8))
        state, rows, valid = run(jax.random.key(0))
        assert valid.all()
        np.testing.assert_array_equal(np.flatnonzero(rows.truncated), ends if limit == 3 else [])
        np.testing.assert_array_equal(np.flatnonzero(rows.terminated), ends if limit == 9 else [])
        length = ends[0] + 1
        np.testing.assert_array_equal(rows.obs[:, 0], np.arange(8) % length)
        np.testing.assert_array_equal(rows.next_obs[:, 0], np.arange(8) % length + 1)
        np.testing.assert_array_equal(rows.next_obs[:, 1], rows.obs[:, 1])
        assert len(np.unique(rows.obs[:, 1])) == len(ends) + 1, "each episode starts from its own key"
        np.testing.assert_array_equal(rows.reward, 2.0)
        assert state.num_steps == 8 - length * len(ends)


def test_a_state_that_is_changed_in_place_does_not_leak():
    """Hopper, walker, ant and others change the metrics of the state that they are given, and give them back."""
    brax = from_brax.load()

    class InPlace(brax.Env):
        observation_size, action_size, backend = 2, 1, "jax"

        def reset(self, rng):
            return brax.State(jnp.zeros(()), jnp.zeros(2), jnp.float32(0), jnp.float32(0), {"x": jnp.float32(0)})

        def step(self, state, action):
            state.metrics.update(x=state.metrics["x"] + action[0])
            return state.replace(obs=state.obs + state.metrics["x"])

    brax.register_environment("in_place", InPlace)
    env = envs.make("brax:in_place")
    state = jax.jit(env.reset)(jax.random.key(0))
    _, first = env.step(state, jnp.ones(1))
    _, second = jax.jit(env.step)(state, jnp.ones(1))
    _, third = env.step(state, jnp.ones(1))
    assert [float(one.next_obs[0]) for one in (first, second, third)] == [1.0] * 3
    collect = make_collect(env, 8)
    _, rows, _ = jax.jit(lambda key, state: collect(key, state, lambda *_: jnp.ones(1), 8))(jax.random.key(0), state)
    np.testing.assert_array_equal(rows.next_obs[:, 0], np.cumsum(np.arange(1, 9)))


def test_a_saved_backend_makes_the_same_environment_again():
    # what a run writes down is what its backend turned out to be
    toy = envs.make("brax:fast")
    assert envs.make("brax:fast", backend=toy.backend).backend == toy.backend == "jax"


@pytest.mark.slow
def test_what_an_environment_becomes():
    hopper = envs.make("brax:hopper", backend="spring")
    assert (hopper.spec.obs_size, hopper.spec.action_size, hopper.spec.episode_steps) == (11, 3, 1000)
    assert hopper.spec.dt == pytest.approx(0.008)
    assert (hopper.backend, hopper.compiled) == ("spring", True)
    assert hopper.view is not None


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "brax:hoper",
            {},
            r"env='brax:hoper' is not known\. Did you mean 'brax:hopper'\? Allowed: a name that is known; the nearest "
            r"are brax:hopper(, brax:\w+){4}\.$",
        ),
        ("brax:swimmer", {}, r"cannot be stepped by this version of Brax and JAX: it raised TypeError: .*Allowed: env"),
        (
            "brax:inverted_pendulum",
            {"backend": "jax"},
            r"backend='jax' is for environments without physics\. Allowed: auto",
        ),
        ("brax:fast", {"backend": "mujoco"}, r"backend='mujoco' is not known\. Allowed: auto, generalized, mjx"),
        ("brax:fast", {"episode_steps": 0}, "episode_steps=0 is out of range"),
        ("brax:fast", {"obs_noise": -1.0}, r"obs_noise=-1\.0 is out of range"),
    ],
)
def test_refusals(name, options, message):
    with pytest.raises(ValueError, match=message):
        envs.make(name, **options)
