import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.errors import EnvironmentFault
from envs.stepper import make_collect, make_collect_all, make_stepper, make_walk, prepared

BACKENDS = ["mujoco", "mjx"]
ROWS = 20


def act(key, obs):
    """A random push, different from step to step, that also depends on what is seen."""
    return 0.5 * jax.random.uniform(key, (1,), minval=-1.0) + 0.1 * jnp.tanh(obs[:1])


def pushed(key, actor, obs):
    """`act`, as strong as the actor is, and to its side."""
    return actor["strength"] * act(key, obs) + 0.1 * actor["side"]


SEEDS = 3
ACTORS = {"strength": jnp.array([0.1, 1.0, 2.0]), "side": jnp.array([1.0, 0.0, -1.0])}
ONE_ACTOR = {"strength": jnp.float32(1.0), "side": jnp.float32(0.0)}
"""Acts as `act` does."""


@functools.cache
def program(env):
    """`(key, state, actor, num_steps) -> (state, transitions [ROWS], valid [ROWS])`: one program where `env` allows."""
    collect, as_actor = make_collect(env, ROWS), jax.jit(pushed)

    def run(key, state, actor, num_steps):
        return collect(key, state, lambda act_key, obs: as_actor(act_key, actor, obs), num_steps)

    return jax.jit(run) if env.compiled else run


def collect_with(env, num_steps=ROWS, seed=0):
    """Collects from a fresh episode."""
    reset_key, key = jax.random.split(jax.random.key(seed))
    state, transitions, valid = program(env)(key, prepared(env).reset(reset_key), ONE_ACTOR, num_steps)
    np.testing.assert_array_equal(valid, np.arange(ROWS) < num_steps)
    return state, jax.tree.map(lambda leaf: leaf[:num_steps], transitions)


@pytest.mark.parametrize("backend", BACKENDS)
def test_shapes_and_types(make_bead, backend):
    _, transitions = collect_with(make_bead(backend))
    shapes = [leaf.shape for leaf in transitions]
    assert shapes == [(20, 2), (20, 1), (20,), (20, 2), (20,), (20,)]
    assert [leaf.dtype for leaf in transitions] == [np.float32] * 4 + [bool] * 2


@pytest.mark.parametrize("backend", BACKENDS)
def test_resets_come_after_each_episode_and_never_enter_a_transition(make_bead, backend):
    _, transitions = collect_with(make_bead(backend, episode_steps=7))
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
    host_state, host = collect_with(make_bead("mujoco", obs_noise=0.01))
    device_state, device = collect_with(make_bead("mjx", obs_noise=0.01))
    for a, b in zip(host, device, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6)
    np.testing.assert_allclose(host_state.obs, device_state.obs, atol=2e-6)
    assert host_state.num_steps == device_state.num_steps == 6
    assert jnp.array_equal(jax.random.key_data(host_state.key), jax.random.key_data(device_state.key))


def test_continues_where_it_stopped(make_bead):
    env = make_bead("mujoco")
    collect = make_collect(env, 10)
    state, first, _ = collect(jax.random.key(1), env.reset(jax.random.key(0)), jax.jit(act), 10)
    _, second, _ = collect(jax.random.key(2), state, jax.jit(act), 10)
    np.testing.assert_array_equal(second.obs[0], first.next_obs[-1])
    np.testing.assert_array_equal(np.flatnonzero(second.truncated), [3])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_state_that_needs_a_reset_comes_back_reset(make_bead, backend):
    state, transitions = collect_with(make_bead(backend, episode_steps=7), 7)
    assert transitions.truncated[-1]
    assert state.num_steps == 0
    assert state.obs[1] == 0


def test_vmap_is_the_same_as_one_by_one(make_bead):
    env = make_bead("mjx")
    keys, reset_keys = jax.random.split(jax.random.key(3), (2, 3))
    states = jax.vmap(prepared(env).reset)(reset_keys)
    _, together, _ = jax.vmap(program(env), in_axes=(0, 0, None, None))(keys, states, ONE_ACTOR, 9)
    for i in range(3):
        _, alone, _ = program(env)(keys[i], prepared(env).reset(reset_keys[i]), ONE_ACTOR, 9)
        np.testing.assert_allclose(together.obs[i], alone.obs, atol=1e-6)


def test_the_act_key_is_new_at_every_step(make_bead):
    _, transitions = collect_with(make_bead("mujoco"))
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
    _, _, valid = make_walk(broken, 4)(jax.random.key(0), prepared(env).reset(jax.random.key(1)), act, 4)
    np.testing.assert_array_equal(valid, [True, False, True, True])


def test_refuses_bad_numbers(make_bead):
    env = make_bead("mujoco")
    for make in (make_collect, make_collect_all, make_walk, lambda env, capacity: make_stepper(env, capacity, pushed)):
        with pytest.raises(ValueError, match="capacity=0 is out of range"):
            make(env, 0)
    for count in (0, 6):
        with pytest.raises(ValueError, match=f"num_steps={count} is out of range. Allowed: 1 to 5"):
            make_collect(env, 5)(jax.random.key(0), env.reset(jax.random.key(0)), act, count)


@pytest.fixture(scope="module", params=BACKENDS)
def steppers(request, make_bead):
    """A bead with noise, and a stepper of it; episodes are 7 steps."""
    env = make_bead(request.param, obs_noise=0.01)
    return env, make_stepper(env, ROWS, pushed)


def seeds(seed):
    return jax.random.split(jax.random.key(seed), SEEDS)


def test_each_seed_of_a_stepper_is_that_seed_alone(steppers):
    env, stepper = steppers
    env_state, alone = stepper.init(seeds(0)), [prepared(env).reset(key) for key in seeds(0)]
    np.testing.assert_allclose(stepper.obs(env_state), [state.obs for state in alone], rtol=0, atol=1e-7)
    # The second time from where the first one stopped, and for fewer steps.
    for keys, num_steps in ((seeds(1), ROWS), (seeds(2), 5)):
        env_state, rows, valid = stepper.collect(keys, env_state, ACTORS, num_steps)
        np.testing.assert_array_equal(valid, [np.arange(ROWS) < num_steps] * SEEDS)
        assert rows.obs.shape == (SEEDS, ROWS, 2)
        for i in range(SEEDS):
            actor = jax.tree.map(lambda leaf, i=i: leaf[i], ACTORS)
            alone[i], own, _ = program(env)(keys[i], alone[i], actor, num_steps)
            for together, by_itself in zip(rows, own, strict=True):
                # On the host to the bit.
                np.testing.assert_allclose(together[i], by_itself, rtol=0, atol=1e-6 if env.compiled else 0)
            np.testing.assert_allclose(stepper.obs(env_state)[i], alone[i].obs, rtol=0, atol=1e-6)
            assert stepper.episode_step(env_state)[i] == alone[i].num_steps
    assert not np.array_equal(rows.action[0], rows.action[1])


def test_a_stepper_knows_where_it_stands_in_an_episode(steppers):
    _, stepper = steppers
    env_state, at = stepper.init(seeds(0)), 0
    assert stepper.episode_step(env_state).tolist() == [0] * SEEDS
    for count in (3, 3, 1, 6, 2, 14):  # episodes end with steps 7, 14, 21 and 28
        before = stepper.obs(env_state)
        env_state, rows, _ = stepper.collect(seeds(at), env_state, ACTORS, count)
        np.testing.assert_array_equal(rows.obs[:, 0], before)
        at += count
        step = stepper.episode_step(env_state)
        assert isinstance(step, np.ndarray)
        assert step.tolist() == [at % 7] * SEEDS
        obs = stepper.obs(env_state)
        assert obs.shape == (SEEDS, 2)
        if at % 7:
            # one program may compute it twice, and round otherwise
            np.testing.assert_allclose(obs, rows.next_obs[:, count - 1], rtol=1e-6)
        else:  # what is seen is the new episode, at rest but for the noise
            assert np.abs(obs - rows.next_obs[:, count - 1]).max() > 0.05
            assert np.abs(obs[:, 1]).max() < 0.05


def test_what_a_checkpoint_is_restored_into(steppers):
    env, stepper = steppers
    computed = []

    def init():
        computed.append(stepper.init(seeds(0)))
        return computed[0]

    abstract = stepper.abstract(init)
    shapes = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), abstract)
    assert shapes == jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), stepper.init(seeds(0)))
    on_device = isinstance(abstract.obs if env.compiled else abstract[0].obs, jax.ShapeDtypeStruct)
    assert stepper.compiles == on_device == env.compiled
    assert (abstract is computed[0]) == (not on_device)


def test_a_prepared_environment_is_the_same_but_compiled(make_bead):
    host, device = make_bead("mujoco"), make_bead("mjx")
    assert prepared(host) is host
    ready = prepared(device)
    assert (ready.spec, ready.coverage, ready.reset_in) == (device.spec, device.coverage, device.reset_in)
    state = ready.reset(jax.random.key(0))
    np.testing.assert_allclose(state.obs, device.reset(jax.random.key(0)).obs, atol=1e-7)
    after, transition = ready.step(state, jnp.ones(1))
    np.testing.assert_allclose(transition.next_obs, host.step(host.reset(jax.random.key(0)), np.ones(1))[1].next_obs)
    assert after.num_steps == 1


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (
            "nan at reset",
            r"returned an observation with numbers that are not finite at reset\. Expected: finite",
        ),
        (
            "nothing at reset",
            r"returned an observation of type NoneType at reset\. Expected: shape \(2,\), an",
        ),
        ("nan reward", r"returned the reward nan at step\. Expected: a finite number"),
        ("two rewards", r"returned `reward` of shape \(2,\) at step\. Expected: shape \(\), one number"),
        ("a tuple", r"returned EnvState and tuple at step\. Expected: an EnvState and a Transition"),
        ("raises", r"raised KeyError: 'wind' at step\. Expected: an EnvState and a Transition"),
    ],
)
def test_what_an_environment_on_the_host_does_wrong_is_said_in_a_line(make_bead, how, message):
    bead = make_bead("mujoco")

    def reset(key):
        state = bead.reset(key)
        return {"nan at reset": state.replace(obs=state.obs * np.nan), "nothing at reset": None}.get(how, state)

    def step(state, action):
        after, transition = bead.step(state, action)
        match how:
            case "nan reward":
                transition = transition._replace(reward=np.float32(np.nan))
            case "two rewards":
                transition = transition._replace(reward=np.zeros(2, np.float32))
            case "a tuple":
                transition = tuple(transition)
            case "raises":
                raise KeyError("wind")
        return after, transition

    stepper = make_stepper(dataclasses.replace(bead, reset=reset, step=step), ROWS, pushed)
    with pytest.raises(EnvironmentFault, match="the environment bead " + message):
        stepper.collect(seeds(0), stepper.init(seeds(1)), ACTORS, 3)


def test_on_the_host_the_reward_of_a_step_that_diverged_is_nobodys_fault(make_bead):
    bead = make_bead("mujoco")

    def step(state, action):
        after, transition = bead.step(state, action)
        return after, transition._replace(reward=np.float32(np.nan), terminated=np.bool_(True))

    stepper = make_stepper(dataclasses.replace(bead, step=step), ROWS, pushed)
    _, _, valid = stepper.collect(seeds(0), stepper.init(seeds(1)), ACTORS, 3)
    assert not valid.any()
