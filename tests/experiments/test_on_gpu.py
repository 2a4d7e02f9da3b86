"""A run on a GPU."""

from pathlib import Path

import jax
import pytest

from envs.base import choose_engine
from experiments.training import memory
from experiments.training.placement import place
from tests.experiments.tiny import STEPS, TINY, assert_same_run

pytestmark = pytest.mark.gpu


def test_physics_runs_there_and_its_own_memory_counts():
    assert choose_engine("auto").BACKEND == "mjx"
    assert memory.total_memory() == jax.devices()[0].memory_stats()["bytes_limit"]


def test_a_run_that_is_cut_short_ends_as_one_that_is_not(tell, point: str, tmp_path: Path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert tell(whole, "--env=point", *TINY).status == 0
    short = [word if word != "--steps=81" else "--steps=50" for word in TINY]
    assert tell(parts, "--env=point", *short).status == 0
    assert tell(parts, "--resume", f"--steps={STEPS[-1]}").status == 0
    assert_same_run(whole, parts)


def test_seeds_are_spread_over_all_gpus():
    count = len(jax.devices())
    if count == 1:
        pytest.skip("there is one GPU")
    assert place(2 * count).num_devices == count
