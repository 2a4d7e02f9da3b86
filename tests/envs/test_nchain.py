"""The chain against a table worked out by hand, over all of its 80 transitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import coverage
from envs.nchain import flip_states, make_nchain
from envs.stepper import make_collect
from experiments.runs.config import RunConfig
from experiments.training.build import make_env

N = 40
FORWARD, BACKWARD = np.eye(2, dtype=np.float32)


@pytest.fixture(scope="module")
def chain():
    return make_nchain(seed=3)


@pytest.fixture(scope="module")
def step(chain):
    return jax.jit(jax.vmap(chain.step))


def at(chain, state, num_steps=0):
    """The environment standing in a state."""
    start = chain.reset(jax.random.key(0))
    return start.replace(
        physics=jnp.int32(state), obs=jax.nn.one_hot(state, N), num_steps=jnp.asarray(num_steps, jnp.int32)
    )


def successor(flips, state, choice):
    """Independent of the code: 0 is forward, 1 backward, a flip exchanges them, the ends hold."""
    direction = (+1, -1)[choice] * (-1 if flips[state] else +1)
    return {-1: 0, N: N - 1}.get(state + direction, state + direction)


def test_all_transitions(chain, step):
    # 40 states x 2 actions: next state, observations, reward 0.01 on reaching 0 and 1 on reaching 39
    flips = flip_states(N, 3)
    pairs = [(state, choice) for state in range(N) for choice in (0, 1)]
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(at(chain, state) for state, _ in pairs))
    after, rows = step(states, jnp.stack([(FORWARD, BACKWARD)[choice] for _, choice in pairs]))
    want = np.array([successor(flips, *pair) for pair in pairs])
    np.testing.assert_array_equal(after.physics, want)
    np.testing.assert_array_equal(rows.obs, np.eye(N)[[state for state, _ in pairs]])
    np.testing.assert_array_equal(rows.next_obs, np.eye(N)[want])
    np.testing.assert_allclose(rows.reward, np.where(want == 0, 0.01, np.where(want == N - 1, 1.0, 0.0)))
    assert not np.any(rows.terminated)
    # From each end one action holds and the other leads inwards.
    assert sorted(want[:2]) == [0, 1] and sorted(want[-2:]) == [N - 2, N - 1]


def test_flips_are_fair_fixed_and_reproducible(chain):
    # 50 chains of 40: half of 2,000 within 5 standard deviations; one seed, one chain, in every episode
    drawn = np.stack([flip_states(N, seed) for seed in range(50)])
    assert abs(drawn.mean() - 0.5) < 5 * 0.5 / np.sqrt(drawn.size)
    np.testing.assert_array_equal(flip_states(N, 3), flip_states(N, 3))
    assert len({tuple(row) for row in drawn}) == 50
    twin = make_nchain(seed=3)
    for key in map(jax.random.key, (0, 1, 2)):
        starts = [chain.reset(key), twin.reset(key)]
        assert [int(start.physics) for start in starts] == [1, 1]
        moves = [
            int(env.step(s, jnp.asarray(FORWARD))[0].physics) for env, s in zip((chain, twin), starts, strict=True)
        ]
        assert moves[0] == moves[1] == (0 if flip_states(N, 3)[1] else 2)


def test_time_limit_truncates(chain, step):
    # the 49th step, and no other, ends the episode, and not as terminated
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(at(chain, 5, n) for n in (47, 48)))
    _, rows = step(states, jnp.stack([FORWARD, FORWARD]))
    assert rows.truncated.tolist() == [False, True] and not np.any(rows.terminated)
    assert chain.spec.episode_steps == 49


def test_coverage_of_a_scripted_walk(chain):
    # straight to the end: after t steps the states 1..t have been left, so t of 40 are covered; back and forth: 2
    flips = jnp.asarray(flip_states(N, 3))
    straight = lambda key, obs: jnp.where(flips[jnp.argmax(obs)], BACKWARD, FORWARD)  # noqa: E731
    collect = jax.jit(make_collect(chain, 49), static_argnums=2)
    _, rows, _ = collect(jax.random.key(0), chain.reset(jax.random.key(0)), straight, 49)
    seen = coverage.init(chain.coverage)
    for t in (1, 10, 38):
        assert int(coverage.update_from_obs(chain.coverage, seen, rows.obs[:t]).sum()) == t
    seen = coverage.update_from_obs(chain.coverage, seen, rows.obs)
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(seen)), [0])
    assert float(rows.reward.sum()) == 49 - 37


def test_a_run_has_the_chain_of_its_seed():
    # the first seed's, whatever the number of seeds
    config = RunConfig(env="nchain", seed=7, num_seeds=2)
    env = make_env(config)
    for state in range(N):
        moved = int(env.step(at(env, state), jnp.asarray(FORWARD))[0].physics)
        assert moved == successor(flip_states(N, 7), state, 0)


def test_bad_settings_are_refused():
    # the field, the value, and what is allowed
    with pytest.raises(ValueError, match=r"backend='mjx' .*Allowed: auto, jax"):
        envs.make("nchain", backend="mjx")
    with pytest.raises(ValueError, match=r"obs_noise=0\.1 .*Allowed: 0"):
        make_nchain(obs_noise=0.1)
    with pytest.raises(ValueError, match=r"num_states=2 .*3 or more"):
        make_nchain(num_states=2)
    with pytest.raises(ValueError, match=r"seed=-1"):
        make_nchain(seed=-1)


def test_picture_shows_where_the_agent_is(chain):
    # two states differ only around the two links, and a picture has the size asked for
    one, other = chain.view.frames([at(chain, 4), at(chain, 35)], 160, 320, chain.view.cameras[0])
    assert one.shape == (160, 320, 3) and one.dtype == np.uint8
    changed = np.argwhere(np.any(one != other, axis=-1))
    assert 0 < len(changed) < 0.1 * 160 * 320
    assert changed[:, 0].min() < 60 and changed[:, 0].max() > 100
