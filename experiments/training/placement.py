"""Where the seeds of a run are computed: side by side on one device, or spread over several.

A seed never looks at another one, so each device runs the program of its own seeds alone (`jax.shard_map`): it waits
for no other device, not even in a loop whose length depends on the numbers, such as a physics solver's. Left to
partition the program by itself, XLA would have all devices agree after each turn of such a loop on whether any seed
needs another.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "seed"
"""Of the mesh."""


@dataclass(frozen=True)
class Placement:
    """Where seeds lie."""

    mesh: Mesh | None = None
    """One axis, `AXIS`. None: one device, and programs are as they are without any of this."""

    @property
    def num_devices(self) -> int:
        """How many devices compute."""
        return 1 if self.mesh is None else self.mesh.size

    @property
    def sharding(self) -> NamedSharding | None:
        """Of an array whose first axis is the seeds'; None on one device."""
        return None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec(AXIS))

    def spread(self, function: Callable[..., Any], shared: Collection[int] = ()) -> Callable[..., Any]:
        """The same function, each device computing its own seeds. To be jitted.

        Args:
            function: of arguments and to results that are trees of arrays `[S, ...]`. No seed's results may depend on
                another's arguments.
            shared: places of the arguments that have no seeds' axis, and that all devices get whole.

        Returns:
            `function` itself on one device. On several a function whose arguments and results are split along the
            seeds' axis; arguments that lie elsewhere are moved first.
        """
        mesh = self.mesh
        if mesh is None:
            return function

        def spread_function(*args: Any) -> Any:
            split = PartitionSpec(AXIS)
            specs = tuple(PartitionSpec() if i in shared else split for i in range(len(args)))
            return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)(*args)

        return spread_function

    def gather(self, tree: Any) -> Any:
        """The same arrays whole on one device, for what acts in an environment on the host."""
        return tree if self.mesh is None else jax.device_put(tree, self.mesh.devices.flat[0])


def share(num_seeds: int, num_devices: int) -> int:
    """Over how many devices seeds are spread: the most that get the same number of seeds each.

    To fill up with seeds that nobody asked for would keep more devices busy, and mostly end no sooner.

    Example:
        6 seeds on 4 devices are 2 on each of 3. 7 stay on one: ask for a multiple of the devices.

        >>> share(8, 8), share(8, 4), share(6, 4), share(7, 4), share(1, 8)
        (8, 4, 3, 1, 1)
    """
    return max(n for n in range(1, min(num_seeds, num_devices) + 1) if num_seeds % n == 0)


def place(num_seeds: int, devices: Sequence[Any] | None = None) -> Placement:
    """Seeds over devices, the first of them that `share` counts.

    Args:
        num_seeds: `S`, 1 or more.
        devices: those to choose from, in order; by default all that JAX has, those of other processes among them.

    Returns:
        A `Placement`; on one device that of a program without one.

    Example:
        >>> place(4, jax.devices()[:1]).mesh is None
        True
    """
    devices = jax.devices() if devices is None else list(devices)
    count = share(num_seeds, len(devices))
    return Placement(Mesh(np.array(devices[:count]), (AXIS,))) if count > 1 else Placement()
