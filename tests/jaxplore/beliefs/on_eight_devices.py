"""A generator's belief over all devices and on one: sizes, first updates. For `test_sharding`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxplore as jx


def main() -> dict[str, Any]:
    """Bytes of the whole state over those of the fullest device (`memory`), shapes of the parameters and of a device's
    part of them (`parts`), whether the state after an update lies as before (`laid_out`), and how far the first moments
    and the metrics are from those on one device.
    """
    belief = jx.make_generator_belief(
        *(4, 2),
        jx.DynamicsConfig(hidden=(64, 64)),
        jx.GeneratorConfig(hidden=(16,), noise_size=4),
        jx.SVGDConfig(num_particles=4),
        jx.FitConfig(batch_size=16),
    )
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("columns",))
    shardings = jx.state_shardings(jax.eval_shape(belief.init, jax.random.key(0)), mesh, min_size=1024)
    data, normalizers = random_data(), jx.dynamics.init_normalizers(4, 2)
    key = jax.random.key(2)
    whole = jax.jit(belief.init)(jax.random.key(1))
    expected, expected_metrics = jax.jit(belief.update)(key, whole, data, normalizers)
    split = jax.device_put(whole, shardings)
    parts = [[list(leaf.shape), list(leaf.addressable_shards[0].data.shape)] for leaf in jax.tree.leaves(split.eta)]
    memory = bytes_of(split) / max(bytes_of(split, device) for device in jax.devices())
    after, metrics = jax.jit(belief.update, donate_argnums=1, out_shardings=(shardings, None))(
        key, split, data, normalizers
    )
    # Not the parameters: Adam's first step has the size of its learning rate, however small a gradient is.
    moments, own = optax.tree.get(expected.opt_state, "mu"), optax.tree.get(after.opt_state, "mu")
    return {
        "memory": memory,
        "parts": parts,
        "laid_out": all(jax.tree.leaves(jax.tree.map(lambda leaf, one: leaf.sharding == one, after, shardings))),
        "moment": error(own, moments),
        "metrics": error(metrics, expected_metrics),
    }


def random_data() -> jx.Replay[jx.Transition]:
    """64 transitions."""
    obs, next_obs = jax.random.normal(jax.random.key(3), (2, 64, 4))
    flag = jnp.zeros(64, bool)
    rows = jx.Transition(obs, jnp.zeros((64, 2)), jnp.zeros(64), next_obs, flag, flag)
    return jx.replay.add(jx.replay.init(jax.tree.map(lambda leaf: leaf[0], rows), 64), rows)


def bytes_of(state: Any, device: jax.Device | None = None) -> int:
    """Of a state, or of what one device holds of it."""
    if device is None:
        return sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    shards = [shard for leaf in jax.tree.leaves(state) for shard in leaf.addressable_shards if shard.device == device]
    return sum(shard.data.nbytes for shard in shards)


def error(one: Any, other: Any) -> float:
    """The largest difference of two trees, relative to the size of the leaf that it is in."""
    pairs = zip(jax.tree.leaves(jax.device_get(one)), jax.tree.leaves(jax.device_get(other)), strict=True)
    return max(float(np.max(np.abs(a - b)) / max(np.max(np.abs(b)), 1e-6)) for a, b in pairs)
