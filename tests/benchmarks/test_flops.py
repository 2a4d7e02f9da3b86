"""The floors count what XLA counts, where XLA can count it."""

import jax
import jax.numpy as jnp
import pytest

from benchmarks import flops
from jaxplore.networks import MLP


def xla_flops(function, *arguments) -> float:
    """FLOPs that XLA finds in a compiled function."""
    analysis = jax.jit(function).lower(*arguments).compile().cost_analysis()
    return (analysis[0] if isinstance(analysis, list) else analysis)["flops"]


WIDTHS = (39, 256, 256, 31)
ROWS = 512


def test_a_forward_pass_by_hand():
    assert flops.forward((2, 3, 4), rows=5) == 2 * 5 * (2 * 3 + 3 * 4)


@pytest.mark.parametrize("kind", ["forward", "train"])
def test_a_network_against_xla(kind):
    net = MLP(WIDTHS[1:-1], WIDTHS[-1])
    inputs = jnp.ones((ROWS, WIDTHS[0]))
    params = net.init(jax.random.key(0), inputs)["params"]

    def forward(params):
        return net.apply({"params": params}, inputs)

    def train(params):
        return jax.grad(lambda p: jnp.sum(forward(p) ** 2))(params)

    counted = xla_flops({"forward": forward, "train": train}[kind], params)
    # XLA also counts biases and activations: about one FLOP per entry beside 2 x 256 in the products.
    assert counted == pytest.approx(getattr(flops, kind)(WIDTHS, ROWS), rel=0.02)


def test_svgd_step_at_the_papers_shape():
    # 32 networks of 4 x 512 on 256 rows: 50 GFLOP; the generators' share is 10 (53.6 M parameters, 32 draws).
    total = flops.svgd_step((39, 512, 512, 512, 512, 31), (32, 64, 64), 32, 256)
    assert total == pytest.approx(50.2e9, rel=0.02)
