"""Each environment of our own through the command line, with the proposed method (the ant and the chain: elsewhere)."""

from pathlib import Path

import pytest

import envs
from experiments import run
from tests.experiments.tiny import STEPS, TINY, rows

ELSEWHERE = {"ant_maze", "nchain"}
"""In the other tests here."""
NAMES = [pytest.param(name, marks=pytest.mark.slow) for name in sorted(set(envs.FACTORIES) - ELSEWHERE)]
"""Each compiles its own programs, half a minute and more; that the environments are what they should be is tested where
they are."""


@pytest.mark.parametrize("name", NAMES)
def test_explores_by_its_own_uncertainty(name: str, tmp_path: Path):
    # rounds end where the configuration says, each after the warm-up meets what it did not know, and what was seen
    # stays seen
    if name == "hand_block":
        pytest.importorskip("gymnasium_robotics")
    assert run.main([f"--env={name}", *TINY, f"--out={tmp_path / 'run'}"]) == 0
    told = rows(tmp_path / "run")
    assert [row["step"] for row in told] == list(STEPS)
    assert ["intrinsic_reward" in row for row in told] == [row["step"] >= 31 for row in told]
    assert all(row["intrinsic_reward"] > 0 for row in told if row["step"] >= 31)
    assert [row["cells"] for row in told] == sorted(row["cells"] for row in told)
    assert all(row["dropped"] == 0 for row in told)
    coverage = envs.make(name).coverage
    assert all(row["coverage"] == row["cells"] / coverage.num_cells for row in told)
