"""A belief's state over several devices, where one is too small for it.

The paper's generator has 53 million parameters for the Ant maze, and with Adam's moments 640 MB; nearly all are columns
of heads, one for each number of a network. Split over them, each device generates its share of every network.
"""

import math
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxplore.validate import FieldError

MIN_SIZE = 2**14
"""Entries below which a leaf is not worth splitting: the paper's features have 4,096 at most."""


def state_shardings(state: Any, mesh: Mesh, axis: str | None = None, min_size: int = MIN_SIZE) -> Any:
    """How a belief's state lies over devices: large leaves split along their longest axis, the others on each of them.

    It goes by shapes alone, so parameters and Adam's moments lie alike, several generators side by side are no
    different, and any other state is split as well as its shapes allow.

    Args:
        state: of a belief, or its shapes (`jax.eval_shape(belief.init, key)`).
        mesh: of the devices.
        axis: the axis of `mesh` that leaves are split over; by default its only one.
        min_size: leaves of fewer entries are not split.

    Returns:
        A tree like `state` of `jax.sharding.NamedSharding`, for `jax.device_put` and for `in_shardings` and
        `out_shardings` of `jax.jit`. A leaf whose longest axis the number of devices does not divide is split along the
        longest one that it does; one without any lies whole on each device.

    Raises:
        FieldError: the mesh has no such axis, or several and none is named.

    Example:
        `init` and `update` of a generator's belief on all devices. Neither the state nor its gradient is ever whole
        on one device:

        >>> import jax, jax.numpy as jnp, numpy as np
        >>> from jaxplore import DynamicsConfig, Transition, dynamics, make_generator_belief, replay
        >>> belief = make_generator_belief(3, 1, DynamicsConfig(hidden=(64, 64)))
        >>> mesh = jax.sharding.Mesh(np.array(jax.devices()), ("columns",))
        >>> shardings = state_shardings(jax.eval_shape(belief.init, jax.random.key(0)), mesh)
        >>> init = jax.jit(belief.init, out_shardings=shardings)
        >>> update = jax.jit(belief.update, donate_argnums=1, out_shardings=(shardings, None))
        >>> flag = jnp.zeros((), bool)
        >>> example = Transition(jnp.zeros(3), jnp.zeros(1), jnp.zeros(()), jnp.zeros(3), flag, flag)
        >>> data, normalizers = replay.init(example, 100), dynamics.init_normalizers(3, 1)
        >>> state, metrics = update(jax.random.key(1), init(jax.random.key(0)), data, normalizers)
        >>> all(jax.tree.leaves(jax.tree.map(lambda leaf, own: leaf.sharding == own, state, shardings)))
        True
    """
    names = mesh.axis_names
    if axis is None and len(names) != 1:
        raise FieldError("axis", axis, f"one of {', '.join(map(str, names))}", "leaves open which axis of the mesh")
    if axis is not None and axis not in names:
        raise FieldError("axis", axis, f"one of {', '.join(map(str, names))}")
    name = names[0] if axis is None else axis

    def one(leaf: Any) -> NamedSharding:
        return NamedSharding(mesh, _spec(leaf.shape, name, mesh.shape[name], min_size))

    return jax.tree.map(one, state)


def _spec(shape: tuple[int, ...], name: str, count: int, min_size: int) -> PartitionSpec:
    """Where a leaf of this shape is cut into `count` parts, if it is."""
    divisible = [place for place, size in enumerate(shape) if size % count == 0 and size >= count]
    if count == 1 or math.prod(shape) < min_size or not divisible:
        return PartitionSpec()
    longest = max(divisible, key=lambda place: shape[place])
    return PartitionSpec(*(name if place == longest else None for place in range(longest + 1)))
