"""The methods through the command line: each runs where it can and reports what the schema says, and is refused with
what fits where it cannot."""

import json
import re
from pathlib import Path

import pytest

import envs
from experiments import run
from experiments.runs.rows import FIELDS, REWARD
from jaxplore.methods import METHODS
from tests.experiments.tiny import make_point, tiny_flags

NO_REWARD = ("ddqn", "psne", "psne_no_norm", "sac", "sac_v2", "sac_explorer", "random")
"""Methods without an intrinsic reward."""


ONE_OF_EACH = ("implicit", "icm", "disagreement_grad", "rnd", "ddqn", "psne", "sac", "random")
"""Every kind of behaviour and most signals; the others are further pairs, and `jaxplore/test_baselines.py` has a round
of each."""


@pytest.mark.parametrize(
    "name", [name if name in ONE_OF_EACH else pytest.param(name, marks=pytest.mark.slow) for name in METHODS]
)
def test_runs_to_the_end_and_reports_what_the_schema_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    # a point with a task, which compiles in no time; ddqn chooses between two pushes
    make = make_task_switch if METHODS[name].actions == "discrete" else make_task_point
    monkeypatch.setitem(envs.FACTORIES, "point", make)
    out = tmp_path / "run"
    assert run.main(["--env=point", f"--method={name}", f"--out={out}", *tiny_flags(name)]) == 0
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [25, 31, 50, 75, 81]
    assert set().union(*lines) - FIELDS.keys() == set(), "every field is in the schema"
    assert {"coverage", "cells", "dropped", "wall_time", "steps_per_second"} <= set.intersection(*map(set, lines))
    # episodes of 20 steps: one ends in each round but the shorter ones at 31 and 81
    assert ["episode_return" in line for line in lines] == [True, False, True, True, True]
    assert all(line["episode_length"] == 20 for line in lines if "episode_return" in line)
    scene = json.loads((out / "scene.json").read_text())
    told = "intrinsic_reward" in lines[-1]
    assert told == (name not in NO_REWARD) == (scene["reward_unit"] is not None)
    assert told == any(FIELDS[field].unit == REWARD for field in lines[-1])
    if name != "random":
        assert any(key.startswith("policy/") for key in lines[-1])
    assert "last return" in capsys.readouterr().out


def make_task_point(backend: str = "auto", obs_noise: float = 0.0):
    return make_point(has_reward=True)


def make_task_switch(backend: str = "auto", obs_noise: float = 0.0):
    return make_point(has_reward=True, discrete=True)


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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--method=random --sac.lr=1e-3", r"--sac\.lr does nothing with method='random'.*methods implicit, .*rnd_sac"),
        (
            "--rnd.lr=1e-3",
            r"--rnd\.lr does nothing with method='implicit'.*Allowed: .* methods rnd, rnd_sac, rnd_active\.",
        ),
        ("--method=icm --imagination.horizon=5", r"--imagination\.horizon does nothing with method='icm'"),
        (
            "--method=max --svgd.num-particles=4",
            r"--svgd\.num-particles .* methods implicit, implicit_reactive, implicit_grad",
        ),
        (
            "--mcts.num-iterations=4",
            r"--mcts\.num-iterations does nothing with --planner=sac\..*--planner=mcts",
        ),
        ("--method=max --reward-units=raw", r"--reward-units does nothing with method='max'"),
        ("--imagination.num-models=4", r"no setting any more\. Allowed: svgd\.num_particles .* ensemble\.num_members"),
        ("--reactive-updates=4", r"--reactive-updates=4 is no setting any more\. Allowed: reactive\.updates"),
    ],
)
def test_a_flag_that_does_nothing_is_refused(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    assert run.main(words.split()) == 2
    told = capsys.readouterr()
    assert re.search(message, told.err), told.err
    assert told.out == "" and list(tmp_path.iterdir()) == []


def test_help_shows_first_what_the_method_reads(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        run.main(["--method=rnd", "--help=all"])
    text = capsys.readouterr().out
    assert max(map(text.index, ("--rnd.lr", "--ppo.lr"))) < min(map(text.index, ("--sac.lr", "--svgd.kernel")))


def test_environments_say_whether_there_is_a_reward():
    have = {"acrobot", "half_cheetah_transfer", "half_cheetah_task", "mountain_car", "nchain"}
    from envs import acrobot, ant_maze, half_cheetah, hand_block, mountain_car

    cheetahs = [half_cheetah.SPEC, half_cheetah.TRANSFER_SPEC, half_cheetah.TASK_SPEC]
    specs = [acrobot.SPEC, ant_maze.SPEC, *cheetahs, hand_block.SPEC, mountain_car.SPEC]
    assert {spec.name for spec in [*specs, envs.make("nchain").spec] if spec.has_reward} == have
