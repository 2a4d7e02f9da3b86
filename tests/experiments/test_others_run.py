"""Other packages' environments through the command line: a smoke run of each, or a line that says why not."""

import json
from pathlib import Path

import gymnasium
import pytest

from experiments import run
from tests.experiments.tiny import STEPS, TINY, tiny_flags

pytestmark = pytest.mark.slow

BRAX = (
    *("ant", "fast", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_double_pendulum"),
    *("inverted_pendulum", "pusher", "reacher", "walker2d"),
)
PLAYGROUND = (
    *("AcrobotSwingup", "BallInCup", "CartpoleBalance", "CartpoleSwingup", "CheetahRun"),
    *("FingerSpin", "HopperStand", "PendulumSwingup", "ReacherEasy", "WalkerStand"),
)
MUJOCO = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum", "InvertedPendulum")
MUJOCO = (*MUJOCO, "Pusher", "Reacher", "Swimmer", "Walker2d")
GYMNASIUM = (
    *("Acrobot-v1", "CartPole-v0", "CartPole-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1"),
    *("Blackjack-v1", "CliffWalking-v1", "CliffWalkingSlippery-v1", "FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v3"),
    *(f"{name}-v{version}" for name in MUJOCO for version in (4, 5)),
    *("BipedalWalker-v3", "CarRacing-v3", "LunarLander-v3", "LunarLanderContinuous-v3"),
    *("phys2d/CartPole-v1", "phys2d/Pendulum-v0", "tabular/Blackjack-v0", "tabular/CliffWalking-v0"),
)
REFUSED = ("cannot be made here", "has observations", "has actions", "does not fit", "needs", "is not known")


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


@pytest.mark.parametrize("name", BRAX)
def test_brax(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    found = outcome(f"brax:{name}", tmp_path / "run", capsys, TINY)
    print(f"brax:{name:<30} {found}")
    assert "cells" in found


@pytest.mark.parametrize("name", PLAYGROUND)
def test_playground(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("mujoco_playground")
    found = outcome(f"playground:{name}", tmp_path / "run", capsys, TINY)
    print(f"playground:{name:<24} {found}")
    assert "cells" in found


def test_gymnasium(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert len(GYMNASIUM) >= 40
    table = {}
    for name in GYMNASIUM:
        words = tiny_flags("random") if name not in gymnasium.registry else TINY
        table[name] = outcome(f"gymnasium:{name}", tmp_path / name.replace("/", "-"), capsys, words)
        if "implicit" in table[name]:
            # no belief fits it: uniform actions do
            table[name] = outcome(f"gymnasium:{name}", tmp_path / name.replace("/", "-"), capsys, tiny_flags("random"))
    with capsys.disabled():
        print("", *(f"gymnasium:{name:<28} {found}" for name, found in table.items()), sep="\n")
    assert sum("cells" in found for found in table.values()) >= 25
