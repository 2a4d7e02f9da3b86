"""What a round of learning does with the state that it is given."""

import functools

import jax
import numpy as np
import pytest

from experiments.training.programs import learn_side_by_side
from jaxplore import METHODS, ExplorationConfig, ModelFreeConfig, SACConfig, Sizes, Transition, make_explorer

CAPACITY, ROWS = 100_000, 5


def explorer_of(capacity: int):
    sac = SACConfig(hidden=(4,), batch_size=64)
    config = ExplorationConfig(data_capacity=capacity, task_sac=sac, model_free=ModelFreeConfig(updates_per_round=1))
    return make_explorer(METHODS["sac"], Sizes(3, 2, has_reward=True), config)


def rows_of(num_seeds: int, reward: float) -> Transition:
    obs = np.random.default_rng(0).normal(size=(num_seeds, ROWS, 3)).astype(np.float32)
    flag = np.zeros((num_seeds, ROWS), bool)
    return Transition(obs, np.tanh(obs[..., :2]), np.full((num_seeds, ROWS), reward, np.float32), obs + 1, flag, flag)


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_the_replay_is_written_to_where_it_lies(num_seeds: int):
    # at a million steps it is 160 MB: a copy of it in each round would take as long as the round's updates
    explorer = explorer_of(CAPACITY)
    learn = jax.jit(functools.partial(learn_side_by_side, explorer), donate_argnums=1)
    keys = jax.random.split(jax.random.key(0), num_seeds)
    state = jax.eval_shape(jax.vmap(explorer.init), keys)
    valid, alive = np.ones((num_seeds, ROWS), bool), np.ones(num_seeds, bool)
    args = (rows_of(num_seeds, 1.0), valid), np.zeros((num_seeds, 3), np.float32), np.int32(ROWS), alive
    memory = learn.lower(keys, state, *args).compile().memory_analysis()
    held = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state.data))
    assert memory.alias_size_in_bytes > held
    assert memory.temp_size_in_bytes < 0.1 * held


def test_a_seed_that_does_not_come_out_finite_keeps_what_it_held():
    # of three seeds the first learns, the second meets a reward that is not finite, the third had stopped before
    explorer = explorer_of(50)
    learn = jax.jit(functools.partial(learn_side_by_side, explorer))
    keys = jax.random.split(jax.random.key(0), 3)
    valid, obs = np.ones((3, ROWS), bool), np.zeros((3, 3), np.float32)
    first = jax.jit(jax.vmap(explorer.init))(keys)
    start, _, _ = learn(keys, first, (rows_of(3, 1.0), valid), obs, np.int32(ROWS), np.ones(3, bool))
    rows = rows_of(3, 2.0)
    rows.reward[1] = np.nan
    after, _, finite = learn(keys, start, (rows, valid), obs, np.int32(2 * ROWS), np.array([True, True, False]))
    assert [bool(np.all([part[seed] for part in finite.values()])) for seed in range(3)] == [True, False, True]
    before, after = jax.device_get((start, after))
    assert after.data.size.tolist() == after.data.position.tolist() == [2 * ROWS, ROWS, ROWS]
    np.testing.assert_array_equal(after.data.rows.reward[0, : 2 * ROWS], np.repeat([1.0, 2.0], ROWS))
    for seed in (1, 2):
        for part in ("behaviour", "normalizers"):
            for leaf, was in zip(*(jax.tree.leaves(getattr(one, part)) for one in (after, before)), strict=True):
                np.testing.assert_array_equal(leaf[seed], was[seed])
        for leaf, was in zip(after.data.rows, before.data.rows, strict=True):
            np.testing.assert_array_equal(leaf[seed, :ROWS], was[seed, :ROWS])
    assert after.normalizers.obs.count.tolist() == [2 * ROWS, ROWS, ROWS]
