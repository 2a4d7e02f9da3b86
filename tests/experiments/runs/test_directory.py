"""What a run directory says of itself, of every format there was, and what is refused."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import envs
from envs.base import FloorPlan
from experiments.analysis import load
from experiments.runs import scene, spec
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.presets import preset_config
from experiments.runs.scene import Cells, Scene
from experiments.runs.spec import RunRef, RunSpec
from experiments.runs.status import Status
from experiments.runs.upgrades import UNTIL_FORMAT_4, UNTIL_FORMAT_5
from experiments.training import build
from jaxplore.config import ExplorationConfig
from tests.experiments.tiny import ROOT

KEPT = sorted((ROOT / "experiments/results/runs").iterdir())
PLAN = FloorPlan((2, 3), (), ((0.0, 0.0, 1.0, 1.0),))
SCENE = Scene(Cells(7, "maze cells"), PLAN, 300, 31, 8, False, True, None, "x")


def begun(path: Path, **changes: object) -> RunDirectory:
    directory = RunDirectory(path)
    config = dataclasses.replace(preset_config("smoke", "acrobot"), **changes)  # pyright: ignore[reportArgumentType]
    directory.begin(RunSpec(config), SCENE)
    return directory


def test_a_run_goes_from_absent_to_finished(tmp_path: Path):
    directory = RunDirectory(tmp_path / "run")
    assert directory.status() is Status.ABSENT and directory.entries() is None
    begun(directory.path)
    assert directory.status() is Status.PARTIAL
    directory.write_walk(np.zeros((1, 2, 2)), np.zeros((1, 2)))
    assert directory.status() is Status.PARTIAL, "the outcome is the last file"
    directory.write_outcome(Status.FINISHED, {})
    assert directory.status() is Status.FINISHED
    (directory.path / "walk.npz").unlink()
    assert directory.status() is Status.PARTIAL, "the walk is to be written again"
    directory.write_outcome(Status.DIVERGED, {3: {"step": 75, "what": "fit/loss"}})
    assert directory.status() is Status.DIVERGED
    (directory.path / "outcome.json").write_text("{}")
    with pytest.raises(RunError, match=r"cannot read .*outcome\.json.*remove it, and finish with --resume"):
        directory.status()
    assert list(tmp_path.rglob("*.tmp*")) == []


def test_what_was_begun_stays_as_it_is(tmp_path: Path):
    directory = begun(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    directory.begin(RunSpec(preset_config("laptop")), dataclasses.replace(SCENE, obs_size=1))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert directory.config() == preset_config("smoke", "acrobot")
    assert directory.scene() == SCENE


def test_a_scene_comes_back_as_it_was():
    config = preset_config("smoke", "nchain")
    env = build.make_env(config)
    own = build.make_scene(config, env, build.make_agent(config, env))
    assert scene.from_json(json.loads(scene.to_json(own))) == own
    assert (own.coverage, own.episode_steps, own.variance_unit) == (Cells(40, "states"), 49, "probability, squared")
    assert own.reward_unit == "probability, squared" and own.has_reward and own.floor_plan is None
    assert Cells(512, "cells", 256).size == envs.base.Coverage(512, lambda obs: obs, "cells", 256).size
    assert scene.from_json(json.loads(scene.to_json(SCENE))) == SCENE
    with pytest.raises(ValueError, match="not a scene"):
        scene.from_json({})


def test_drafts_of_processes_that_have_ended_are_swept_and_others_stay(tmp_path: Path):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    names = [f"coverage.tmp{ended.pid}.png", f"walk.tmp{os.getpid()}.npz", "mine.tmp", "coverage.png"]
    for name in names:
        (tmp_path / name).write_text("")
    begun(tmp_path)
    there = {path.name for path in tmp_path.iterdir()}
    assert there & set(names) == set(names[1:])


# Specifications.


def test_the_identity_is_of_what_decides_the_result():
    config = preset_config("laptop")
    own = RunSpec(config).identity

    def changed(**changes):
        return RunSpec(dataclasses.replace(config, **changes)).identity

    explorer = config.explorer
    assert changed(checkpoint_every=7, eval_every=50, eval_episodes=2, preset="smoke") == own
    assert changed(explorer=dataclasses.replace(explorer, rnd=dataclasses.replace(explorer.rnd, lr=0.5))) == own
    different = {
        changed(seed=1),
        changed(num_seeds=2),
        changed(method="disagreement"),
        changed(explorer=dataclasses.replace(explorer, sac=dataclasses.replace(explorer.sac, lr=0.5))),
        RunSpec(config, RunRef("runs/a", 50, "abc")).identity,
        RunSpec(config, RunRef("runs/a", 75, "abc")).identity,
    }
    assert len(different - {own}) == 6
    assert RunSpec(config, RunRef("here", 50, "abc")).identity == RunSpec(config, RunRef("there", 50, "abc")).identity


def test_a_specification_comes_back_with_its_parent():
    own = RunSpec(preset_config("smoke", "half_cheetah_task", "sac"), RunRef("runs/explored", 4_000, "0123"))
    assert spec.from_json(spec.to_json(own), "c") == own
    with pytest.raises(ValueError, match=r"c: parent=\{\}\. Allowed: null, or an object with directory"):
        spec.from_json('{"parent": {}}', "c")


def test_references_are_written_with_an_at():
    assert RunRef.parse("runs/a@4000") == RunRef("runs/a", 4_000)
    assert RunRef.parse("runs/a") == RunRef("runs/a")
    assert [str(RunRef("runs/a", step)) for step in (None, 50)] == ["runs/a", "runs/a@50"]
    with pytest.raises(ValueError, match=r"parent='runs/a@latest'\. Allowed: DIRECTORY or DIRECTORY@STEP"):
        RunRef.parse("runs/a@latest")


def test_a_changed_configuration_is_noticed_in_a_run_and_welcome_in_a_file(tmp_path: Path):
    directory = begun(tmp_path)
    path = tmp_path / "config.json"
    path.write_text(path.read_text().replace('"seed": 0', '"seed": 5'))
    with pytest.raises(ValueError, match=r"config\.json has been changed since it was written"):
        directory.config()
    assert spec.from_json(path.read_text(), "mine").config.seed == 5
    # one of an older version lacks fields of today's, so its identity is of other fields
    data = json.loads(path.read_text())
    del data["explorer"]["sac"]["lr"]
    path.write_text(json.dumps(data))
    assert directory.config().seed == 5


def test_a_newer_format_is_refused(tmp_path: Path):
    directory = begun(tmp_path)
    path = tmp_path / "config.json"
    path.write_text(path.read_text().replace('"format": 5', '"format": 6'))
    with pytest.raises(RunError, match=r"has format 6; this version reads formats 0 to 5.*versions\.json"):
        directory.status() and directory.config()


# Format 0.


def check_first_format(explorer: ExplorationConfig, was: dict[str, Any]) -> None:
    """What the first format says, and what there was no setting for."""
    assert explorer.svgd.num_particles == explorer.ensemble.num_members == was["imagination"]["num_models"] == 32
    assert explorer.reactive.updates == was["reactive_updates"] or (
        was["reactive_updates"] == 0 and explorer.reactive.updates == 300
    )
    assert explorer.reactive.restart_every == was["imagination"]["restart_every"]
    for name in ("sac", "fit", "dynamics", "generator", "rnd", "ppo", "gradient"):
        assert json.loads(json.dumps(dataclasses.asdict(getattr(explorer, name)))).items() >= was[name].items()
    # what there was no setting for was so
    assert (explorer.generator.activation, explorer.generator.num_generators) == ("relu", 1)
    assert explorer.imagination.keep_imagined


UNITS = ("maze cells", "horizontal poses", "states", "cells of speed and pitch rate")
"""What coverage counts in the environments that runs were kept of."""


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.name)
def test_every_kept_run_reads(path: Path):
    directory = RunDirectory(path)
    old = json.loads((path / "config.json").read_text())
    config = directory.config()
    assert (config.env, config.method, config.seed, config.steps) == tuple(
        old[name] for name in ("env", "method", "seed", "steps")
    )
    if "format" in old:
        was = {group: {**then, **old["explorer"][group]} for group, then in (UNTIL_FORMAT_4 | UNTIL_FORMAT_5).items()}
        now = json.loads(json.dumps(dataclasses.asdict(config.explorer)))
        assert now.keys() - old["explorer"].keys() <= {"information"}, "a group that there was not yet, of new methods"
        assert {name: now[name] for name in old["explorer"]} == {**old["explorer"], **was}
    else:
        check_first_format(config.explorer, old["explorer"])
    assert directory.status() is Status.FINISHED and directory.is_kept()
    assert max(row["step"] for row in directory.rows()) == config.steps
    found = directory.scene()
    assert found is not None and found.coverage.unit in UNITS


def test_reading_a_kept_run_builds_no_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(build, "make_env", None)
    run = load.load(ROOT / "experiments/results/runs/ant-implicit-s0", 1_000)
    assert run.scene.coverage.num_cells == 7 and run.rows[-1]["step"] == 1_000


def test_kept_scenes_are_those_of_the_environments(tmp_path: Path):
    for name in ("ant-implicit-s0", "acro-implicit"):
        shutil.copytree(ROOT / "experiments/results/runs" / name, tmp_path / name)
        (tmp_path / name / "scene.json").unlink()
        directory = RunDirectory(tmp_path / name)
        assert load.scene_of(directory) == RunDirectory(ROOT / "experiments/results/runs" / name).scene()


def test_of_two_ms_one_is_refused():
    text = '{"explorer": {"imagination": {"num_models": 8}, "svgd": {"num_particles": 4}}}'
    with pytest.raises(ValueError, match=r"c: explorer\.imagination\.num_models=8\. Allowed: .*num_particles=4"):
        spec.from_json(text, "c")
    one = text.replace("8", "4")
    assert spec.from_json(one, "c").config.explorer.svgd.num_particles == 4
    static = spec.from_json('{"method": "max", "explorer": {"imagination": {"num_models": 8}}}', "c")
    assert static.config.explorer.ensemble.num_members == 8


def test_what_reactive_methods_took_from_imagination_is_their_own():
    text = '{"method": "icm", "explorer": {"imagination": {"num_rollouts": 3, "restart_every": 5}}}'
    reactive = spec.from_json(text, "c").config.explorer.reactive
    assert (reactive.updates, reactive.restart_every, reactive.normalize_reward) == (3 * 75, 5, True)
    text = '{"method": "icm", "explorer": {"reactive_updates": 40}}'
    assert spec.from_json(text, "c").config.explorer.reactive.updates == 40
    text = '{"method": "max_reactive", "explorer": {"imagination": {"bound": 3}}}'
    assert spec.from_json(text, "c").config.explorer.reactive.updates == 100, "its own, as its authors have it"


def test_what_is_kept_is_not_resumed(tmp_path: Path, tell):
    kept = tmp_path / "ant-implicit-s0"
    shutil.copytree(ROOT / "experiments/results/runs/ant-implicit-s0", kept)
    before = {path: path.read_bytes() for path in kept.iterdir()}
    done = tell(kept, "--resume")
    assert done.status == 0 and "is finished: drawing it again" in done.stdout
    assert {path: path.read_bytes() for path in kept.iterdir() if path.suffix != ".png"} == before
