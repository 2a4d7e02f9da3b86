"""What the paper's scale comes to, beside what benchmarks have counted."""

import dataclasses

import pytest

from benchmarks import kernels
from experiments.runs.presets import preset_config
from experiments.studies import scale
from experiments.studies.estimates import Rates
from experiments.studies.figures_of_paper import figures
from tests.experiments.studies.by_hand import NO_RATES, cell, figure


def test_a_round_is_what_the_benchmarks_have_counted_and_measured():
    config = preset_config("paper", "ant_maze", "implicit")
    # 256 random steps, which 50 epochs of a batch each are fitted to, and one round more of the same size.
    assert scale.run_flops(dataclasses.replace(config, steps=256)) == scale.ROUND_FLOPS
    assert scale.run_flops(dataclasses.replace(config, steps=275)) == 2 * scale.ROUND_FLOPS
    assert pytest.approx(71.3e9, rel=0.01) == scale.RATE


def test_the_laptops_round_is_counted_as_there():
    config = preset_config("laptop", "ant_maze", "implicit")
    found = scale.run_flops(dataclasses.replace(config, steps=256))
    explorer = config.explorer
    assert found == 60 * kernels.svgd_flops(explorer) + 300 * kernels.sac_flops(explorer)


def test_random_actions_cost_nothing_and_more_data_more():
    assert scale.run_flops(preset_config("paper", "ant_maze", "random")) == 0
    config = preset_config("paper", "ant_maze", "max")
    long, short = (scale.run_flops(dataclasses.replace(config, steps=steps)) for steps in (10_000, 5_000))
    assert long > 2.5 * short


def test_it_is_marked_as_extrapolated_unless_runs_of_before_tell():
    one = figure("a", (cell("implicit"), cell("max")))
    text = scale.describe(one, NO_RATES)
    assert text.startswith("extrapolated, not measured: ") and "FLOPs of learning at 71 GFLOP/s, the pace of" in text
    # Two seeds of 300 steps.
    known = Rates({}, {("ant_maze", "implicit", "paper"): 2.0})
    assert scale.describe(one, known).startswith("20 min 00 s by runs of before; and extrapolated, not measured: ")
    known = Rates({}, {("ant_maze", method, "paper"): 2.0 for method in ("implicit", "max")})
    assert scale.describe(one, known) == "40 min 00 s by runs of before"


def test_every_figure_says_something():
    told = {name: scale.describe(one, NO_RATES) for name, one in figures().items()}
    assert "without DDPG, PPO" in told["rnd_psne"] and told["beliefs"].startswith("not told")
    assert all("extrapolated, not measured" in text for name, text in told.items() if name != "beliefs")
