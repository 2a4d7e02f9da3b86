"""The ring buffer against a list."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from jaxplore import replay

CAPACITY, BATCH = 7, 5
add = jax.jit(replay.add)


def held(state) -> list[int]:
    """The rows in the buffer, oldest first."""
    rows, position, size = np.asarray(state.rows["x"]), int(state.position), int(state.size)
    return [int(rows[(position - size + i) % CAPACITY]) for i in range(size)]


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.lists(st.lists(st.booleans(), min_size=BATCH, max_size=BATCH), max_size=8))
def test_buffer_is_the_end_of_a_list(masks):
    # model: append the valid rows to a list, keep the last CAPACITY; every leaf of a record moves together
    state, model, counter = replay.init({"x": jnp.zeros((), jnp.int32), "y": jnp.zeros(2)}, CAPACITY), [], 0
    for mask in masks:
        numbers = np.arange(counter + 1, counter + 1 + BATCH, dtype=np.int32)
        rows = {"x": jnp.asarray(numbers), "y": jnp.asarray(numbers[:, None] * np.array([[1.0, -1.0]], np.float32))}
        state = add(state, rows, jnp.asarray(mask))
        model += [int(n) for n, valid in zip(numbers, mask, strict=True) if valid]
        counter += BATCH
        assert held(state) == model[-CAPACITY:]
        assert int(state.size) == min(len(model), CAPACITY)
        assert int(state.position) == len(model) % CAPACITY
    x, y = (np.asarray(state.rows[name]) for name in "xy")
    np.testing.assert_array_equal(y, x[:, None] * np.array([[1.0, -1.0]]))


def test_all_rows_are_valid_by_default_and_wrap_around():
    # 5 + 5 rows in 7 places: 3 to 9 remain, 7, 8, 9 in front
    state = replay.init({"x": jnp.zeros((), jnp.int32)}, CAPACITY)
    for start in (0, 5):
        state = add(state, {"x": jnp.arange(start, start + 5)})
    assert held(state) == [3, 4, 5, 6, 7, 8, 9]
    np.testing.assert_array_equal(state.rows["x"], [7, 8, 9, 3, 4, 5, 6])
    assert replay.capacity(state) == CAPACITY


def test_a_batch_as_large_as_the_buffer_fills_it():
    # the whole of it, from any position
    state = add(replay.init({"x": jnp.zeros((), jnp.int32)}, CAPACITY), {"x": jnp.arange(3)})
    assert held(add(state, {"x": jnp.arange(10, 17)})) == list(range(10, 17))


@pytest.mark.parametrize(("added", "want"), [(4, [0, 1, 2, 3]), (10, [3, 4, 5, 6, 7, 8, 9])])
def test_samples_are_uniform_over_the_rows_held(added, want):
    # chi-square over 7,000 draws, p > 0.001; a row that is not held never comes
    state = replay.init({"x": jnp.full((), 99)}, CAPACITY)
    for i in range(added):
        state = add(state, {"x": jnp.array([i])})
    drawn = np.asarray(replay.sample(jax.random.key(0), state, 7000)["x"])
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == want
    assert stats.chisquare(counts).pvalue > 1e-3


def test_draws_are_independent():
    # with replacement: 3 rows, 3 draws, all different in 3!/3^3 = 22 % of 2,000 samples (standard error 0.9 %)
    state = add(replay.init({"x": jnp.zeros(())}, CAPACITY), {"x": jnp.arange(3.0)})
    keys = jax.random.split(jax.random.key(0), 2000)
    draws = np.asarray(jax.vmap(lambda key: replay.sample(key, state, 3)["x"])(keys))
    distinct = np.mean([len(set(row)) == 3 for row in draws.tolist()])
    assert distinct == pytest.approx(6 / 27, abs=0.04)


def test_an_empty_buffer_is_refused_where_it_is_known_and_gives_zero_rows_where_not():
    # as its docstring says; dtypes are those of the example
    state = replay.init({"x": jnp.ones((2,), jnp.int32), "flag": jnp.ones((), bool)}, CAPACITY)
    with pytest.raises(ValueError, match=r"size=0 is all that the buffer holds\. Allowed: a buffer with a row in it"):
        replay.sample(jax.random.key(0), state, 3)
    drawn = jax.jit(replay.sample, static_argnums=2)(jax.random.key(0), state, 3)
    np.testing.assert_array_equal(drawn["x"], np.zeros((3, 2), np.int32))
    assert drawn["x"].dtype == jnp.int32 and drawn["flag"].dtype == bool


@pytest.mark.parametrize(
    ("batch", "message"),
    [
        ({"x": jnp.zeros((5, 1)), "y": jnp.zeros(5)}, r"batch=\(5, 1\) is the shape of a part\. Allowed: .*\[B, 3\]"),
        ({"x": jnp.zeros(3), "y": jnp.zeros(())}, r"batch=\(3,\) is the shape"),
        ({"x": jnp.zeros((5, 3)), "y": jnp.zeros(1)}, r"batch=\(1,\) .*Allowed: shape \[B\], the same B in all"),
        ({"x": jnp.zeros((5, 3))}, r"batch is PyTreeDef\(.*Allowed: PyTreeDef"),
    ],
)
def test_records_of_another_shape_are_refused(batch, message):
    # rows of width 1 would be broadcast
    state = replay.init({"x": jnp.zeros(3), "y": jnp.zeros(())}, CAPACITY)
    for add in (replay.add, jax.jit(replay.add)):
        with pytest.raises(ValueError, match=message):
            add(state, batch)


def test_bad_sizes_are_refused():
    # rows that would overwrite each other, and no room at all
    state = replay.init({"x": jnp.zeros(())}, CAPACITY)
    with pytest.raises(ValueError, match=r"batch of 8 rows does not fit.*at most the capacity, 7"):
        replay.add(state, {"x": jnp.zeros(8)})
    with pytest.raises(ValueError, match=r"capacity=0"):
        replay.init({"x": jnp.zeros(())}, 0)
