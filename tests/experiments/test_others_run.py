"""Other packages' environments through the command line: a smoke run of each, or a line that says why not."""

import json
from pathlib import Path

import gymnasium
import pytest

from experiments import run
from tests.experiments.tiny import GROUPS, RUN, STEPS, TINY, tiny_flags

pytestmark = pytest.mark.slow

BRAX = (
    *("ant", "fast", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_double_pendulum"),
    *("inverted_pendulum", "pusher", "reacher", "walker2d"),
)
PLAYGROUND = (
    *("AcrobotSwingup", "BallInCup", "CartpoleBalance", "CartpoleSwingup", "CheetahRun"),
    *("FingerSpin", "HopperStand", "PendulumSwingup", "CartpoleSwingupSparse", "ReacherEasy", "WalkerStand"),
)
MUJOCO = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum", "InvertedPendulum")
MUJOCO = (*MUJOCO, "Pusher", "Reacher", "Swimmer", "Walker2d")
BOX2D = ("BipedalWalker-v3", "CarRacing-v3", "LunarLander-v3", "LunarLanderContinuous-v3")
GYMNASIUM = (
    *("Acrobot-v1", "CartPole-v0", "CartPole-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1"),
    *("Blackjack-v1", "CliffWalking-v1", "CliffWalkingSlippery-v1", "FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4"),
    *(f"{name}-v{version}" for name in MUJOCO for version in (4, 5)),
    *BOX2D,
    *("phys2d/CartPole-v1", "phys2d/Pendulum-v0", "tabular/Blackjack-v0", "tabular/CliffWalking-v0"),
)
MAY_BE_REFUSED = ("Blackjack-v1", "Pusher-v4", "ReacherEasy", *BOX2D)
"""A tuple for observations, an old MuJoCo, a call that MuJoCo 3.17 has no more, pictures, and a package that may not be
there."""
DISCRETE = (*RUN, *(word for group in ("dynamics", "generator", "svgd", "fit", "ddqn") for word in GROUPS[group]))
TABULAR = (
    *RUN,
    *(word for group in ("dynamics", "generator", "svgd", "fit") for word in GROUPS[group]),
    *("--planner=mcts", "--dynamics.target=one_hot", "--mcts.num-iterations=6", "--mcts.num-trajectories=2"),
)
REFUSED = (
    "where actions are discrete",
    "Allowed: planner='mcts'",
    *"cannot be made here",
    "has observations",
    "has actions",
    "does not fit",
    "needs",
    "acts by numbers",
)


def outcome(name: str, out: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]) -> str:
    """What became of a run, for the table."""
    status = run.main([f"--env={name}", f"--out={out}", *words])
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    if status == 0:
        lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
        assert [line["step"] for line in lines] == list(STEPS)
        return f"{lines[-1]['cells']} cells, {sum(line['dropped'] for line in lines)} dropped"
    (line,) = [line for line in told.err.splitlines() if line.startswith("error: ")]
    assert status == 2, line
    assert any(word in line for word in REFUSED), line
    assert not out.exists()
    return line


def show(name: str, found: str, capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled():
        print(f"\n{name:<36} {found}", end=" ")


@pytest.mark.parametrize("name", BRAX)
def test_brax(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    found = outcome(f"brax:{name}", tmp_path / "run", capsys, TINY)
    show(f"brax:{name}", found, capsys)
    assert "cells" in found


@pytest.mark.parametrize("name", PLAYGROUND)
def test_playground(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("mujoco_playground")
    found = outcome(f"playground:{name}", tmp_path / "run", capsys, TINY)
    show(f"playground:{name}", found, capsys)
    assert "cells" in found or name in MAY_BE_REFUSED


def test_there_are_enough_of_gymnasium():
    assert len({name for name in GYMNASIUM if name in gymnasium.registry}) >= 40


@pytest.mark.filterwarnings("ignore:.* is out of date:DeprecationWarning")
@pytest.mark.parametrize("name", GYMNASIUM)
def test_gymnasium(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    found = outcome(f"gymnasium:{name}", tmp_path / "run", capsys, TINY)
    # What a belief on choices, or on a table of states, learns by has settings of its own.
    for said, words in (("where actions are discrete", DISCRETE), ("Allowed: planner='mcts'", TABULAR)):
        if said in found:
            found = outcome(f"gymnasium:{name}", tmp_path / "run", capsys, words)
    if "such as random" in found:
        # No belief fits it: uniform actions do.
        found = outcome(f"gymnasium:{name}", tmp_path / "run", capsys, ("--method=random", *tiny_flags("random")))
    show(f"gymnasium:{name}", found, capsys)
    assert "cells" in found or name in MAY_BE_REFUSED
