"""The methods through the command line: each runs where it can, and is refused with what fits where it cannot."""

import json
import re
from pathlib import Path

import pytest

import envs
from experiments import run
from jaxplore.methods import METHODS
from tests.experiments.tiny import TINY, make_point

HERE = (
    "disagreement",
    "max",
    "max_reactive",
    "max_trajectory",
    "prediction_error",
    "icm",
    "icm_active",
    "implicit_grad",
    "disagreement_grad",
    "rnd",
    "rnd_sac",
    "psne",
    "psne_no_norm",
    "sac",
    "sac_v2",
)
FEW = (
    *("--gradient.updates=2", "--gradient.batch-size=8", "--gradient.hidden", "8"),
    *("--rnd.hidden", "8", "--rnd.features=4", "--ppo.hidden", "8", "--ppo.rollout-steps=25", "--ppo.minibatch-size=5"),
    *("--ddpg.hidden", "8", "--ddpg.batch-size=8", "--task-sac.hidden", "8", "--task-sac.batch-size=8"),
)


@pytest.mark.slow
@pytest.mark.parametrize("name", HERE)
def test_runs_to_the_end(name: str, tmp_path: Path):
    out = tmp_path / "run"
    assert run.main(["--env=mountain_car", f"--method={name}", f"--out={out}", *TINY, *FEW]) == 0
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 81
    assert any(key.startswith("policy/") for key in lines[-1])


@pytest.mark.parametrize("name", [name for name, row in METHODS.items() if row.needs_reward])
def test_no_reward_no_method(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    # a point on a floor has no task: refused before anything is written, with the methods that fit
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(envs.FACTORIES, "point", make_point)
    assert run.main(["--env=point", f"--method={name}", "--preset=smoke"]) == 2
    told = capsys.readouterr()
    assert re.search(rf"method='{name}' learns from the environment's own reward.*has none\. Allowed: ", told.err)
    assert re.search(r"methods implicit, .*random\.", told.err)
    assert told.out == "" and list(tmp_path.iterdir()) == []


def test_environments_say_whether_there_is_a_reward():
    have = {"acrobot", "half_cheetah_task", "mountain_car", "nchain"}
    from envs import acrobot, ant_maze, half_cheetah, hand_block, mountain_car

    specs = [acrobot.SPEC, ant_maze.SPEC, half_cheetah.SPEC, half_cheetah.TASK_SPEC, hand_block.SPEC, mountain_car.SPEC]
    assert {spec.name for spec in [*specs, envs.make("nchain").spec] if spec.has_reward} == have
