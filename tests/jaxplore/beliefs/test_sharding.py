"""A belief's state over several devices."""

import jax
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

from jaxplore.beliefs.sharding import state_shardings
from jaxplore.validate import FieldError
from tests import devices


@pytest.fixture(scope="module")
def mesh():
    return Mesh(np.array(jax.devices()[:2]), ("columns",))


@pytest.mark.parametrize(
    ("shape", "spec"),
    [
        ((20_000, 65), ("columns",)),
        ((65, 20_000), (None, "columns")),  # a head
        ((4, 20_000, 65), (None, "columns")),  # those of four generators
        ((20_001, 64), (None, "columns")),  # two devices do not divide its longest axis
        ((20_001, 65), ()),  # nor any other
        ((64, 64), ()),  # features: not worth it
        ((), ()),
    ],
)
def test_large_leaves_are_split_along_their_longest_axis(mesh, shape, spec):
    state = {"leaf": jax.ShapeDtypeStruct(shape, np.float32)}
    found = state_shardings(state, mesh)["leaf"]
    assert (found.mesh, found.spec) == (mesh, PartitionSpec(*spec))


def test_an_axis_of_the_mesh_is_named_or_the_only_one():
    leaf = jax.ShapeDtypeStruct((40_000,), np.float32)
    grid = Mesh(np.array(jax.devices()[:2]).reshape(1, 2), ("seed", "columns"))
    assert state_shardings(leaf, grid, "columns").spec == PartitionSpec("columns")
    with pytest.raises(FieldError, match=r"axis=None .*Allowed: one of seed, columns"):
        state_shardings(leaf, grid)
    with pytest.raises(FieldError, match=r"axis='column'.*Allowed: one of seed, columns"):
        state_shardings(leaf, grid, "column")


@pytest.mark.slow
def test_eight_devices_hold_an_eighth_each_and_learn_as_one_does():
    found = devices.result(devices.start("tests.jaxplore.beliefs.on_eight_devices", num_devices=8))
    # the 64 x 64 weights of the middle layer, from 16 features and their constant
    assert [[17, 4096], [17, 512]] in found["parts"]
    assert found["memory"] > 7.5  # of 8: features lie everywhere
    assert found["laid_out"]
    assert found["metrics"] < 1e-5
    assert found["moment"] < 1e-5
