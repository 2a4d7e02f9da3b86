"""The kernels are what a run computes: traced, not timed."""

import dataclasses

import jax
import pytest

from benchmarks import flops, kernels
from benchmarks.timing import Timing
from experiments.runs.presets import preset_config
from jaxplore import DynamicsConfig, FitConfig, GeneratorConfig, ImaginationConfig, SACConfig, SVGDConfig

SMOKE = preset_config("smoke")
TINY = dataclasses.replace(
    SMOKE.explorer,
    dynamics=DynamicsConfig(hidden=(8,)),
    generator=GeneratorConfig(noise_size=4, hidden=(8,)),
    svgd=SVGDConfig(num_particles=4),
    fit=FitConfig(batch_size=8, epochs=3, restart=False),
    imagination=ImaginationConfig(
        num_actors=4, horizon=3, num_rollouts=5, num_random_rollouts=2, updates_per_rollout=7, real_updates=11
    ),
    sac=SACConfig(hidden=(8,), batch_size=8),
)
TARGET, POLICY = (39, 8, 31), (31, 8, 16)
SVGD = flops.svgd_step(TARGET, (4, 8), models=4, batch=8)
IMAGINED = flops.imagined_step(TARGET, POLICY, models=4, actors=4)
SAC = flops.sac_update(31, 8, (8,), batch=8)


@pytest.fixture
def traced(monkeypatch):
    """What is measured is traced and takes a second."""
    second = Timing(1.0, 1.0, 1.0)
    monkeypatch.setattr(kernels, "measure", lambda call, **_: (jax.eval_shape(call), second)[1])
    monkeypatch.setattr(kernels, "measure_chain", lambda call, state, **_: (jax.eval_shape(call, state), second)[1])


@pytest.mark.parametrize(
    ("measure", "shape", "flop"),
    [
        (lambda: kernels.svgd_step(TINY, 1e9, 2), "4 x 8, batch 8", SVGD),
        (lambda: kernels.imagined_step(TINY, 1e9), "4 x 8, 4 actors", IMAGINED),
        (lambda: kernels.sac_update(TINY, 1e9, 2), "8, batch 8", SAC),
    ],
)
def test_a_kernel(traced, measure, shape, flop):
    result = measure()
    assert (result.shape, result.flops) == (shape, flop)
    assert result.floor_seconds == pytest.approx(flop / 1e9)


def test_points_beside_the_batch_count(traced):
    # 8 rows of data and as many beside them; two generators of two networks each, which repel each other within a pair
    svgd, generator = SVGDConfig(4, repulsion_points="perturbed", accept_improper=True), TINY.generator
    config = dataclasses.replace(TINY, svgd=svgd, generator=dataclasses.replace(generator, num_generators=2))
    result = kernels.svgd_step(config, 1e9, 2)
    assert result.shape == "4 x 8, batch 8 and 8 points"
    assert result.flops == 2 * flops.svgd_step(TARGET, (4, 8), models=2, batch=16)


def test_a_whole_round_is_so_many_of_each_kernel(traced):
    # 3 epochs of 20 data in batches of 8; 5 rollouts of 3 steps, of which 3 are followed by 7 updates, after 11
    run = dataclasses.replace(SMOKE, explorer=TINY)
    result = kernels.whole_round(run, 1e9, num_data=20, repeats=1)
    assert result.shape == "smoke, N = 20: 6 SVGD, 15 imagined, 32 SAC"
    assert result.flops == 6 * SVGD + 15 * IMAGINED + 32 * SAC
