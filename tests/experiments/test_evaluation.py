"""What an agent earns: by episode, in evaluations without exploring, and with a policy taken over from another run."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from experiments import run
from experiments.runs.directory import RunDirectory
from experiments.runs.presets import preset_config
from experiments.runs.spec import RunRef
from experiments.training import build, loop, parent, record
from experiments.training.evaluate import first_episodes
from experiments.training.programs import RunState
from jaxplore.types import Transition
from tests.experiments.test_methods_run import make_task_point
from tests.experiments.tiny import rows, tiny_flags

SAC = ("--env=task", "--method=sac", *tiny_flags("sac"))


@pytest.fixture
def task(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(envs.FACTORIES, "task", make_task_point)


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny run of SAC on the point's task, two seeds, evaluated every 40 steps. Not to be written to."""
    out = tmp_path_factory.mktemp("evaluated") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(envs.FACTORIES, "task", make_task_point)
        assert run.main([*SAC, "--num-seeds=2", "--eval-every=40", "--eval-episodes=3", f"--out={out}"]) == 0
    return out


def empty_state(num_seeds: int) -> RunState:
    blank = np.zeros((num_seeds, 0))
    alive = np.ones(num_seeds, bool)
    return RunState(None, None, blank, blank, blank, alive, np.zeros(num_seeds), np.zeros(num_seeds, np.int32))


def test_episodes_are_summed_across_rounds():
    # rewards 1, 2, 4 | 8, 16: seed 0 ends after 4 (7) and after 16 (24); seed 1 never; seed 2 is not alive
    state = empty_state(3)
    state.alive[2] = False
    done = np.array([[False, False, True], [False] * 3, [True] * 3])
    first = record.episodes(state, np.tile([1.0, 2.0, 4.0], (3, 1)), done)
    assert first == [[(7.0, 3)], [], []]
    second = record.episodes(state, np.array([[8.0, 16.0], [8.0, np.nan], [1.0, 1.0]]), np.array([[False, True]] * 3))
    assert second == [[(24.0, 2)], [(15.0, 5)], []]
    assert record.earned([(1.0, 3), (3.0, 5)]) == {"episode_return": 2.0, "episode_length": 4.0}
    assert record.earned([]) == {}


def test_an_evaluation_is_of_first_episodes():
    # what comes after the first end is another episode; one that is cut by the end of the rows counts whole
    done = np.array([[False, True, False, True], [False, False, False, True]])
    reward = np.array([[1.0, 2.0, 4.0, 8.0]] * 2)
    returns, lengths = first_episodes(Transition(0, 0, reward, 0, done, ~done & False))  # pyright: ignore
    assert returns.tolist() == [3.0, 15.0] and lengths.tolist() == [2, 4]


def test_returns_are_those_of_the_task(evaluated: Path):
    told = rows(evaluated)
    finished = [row for row in told if "episode_return" in row]
    assert {row["step"] for row in finished} == {25, 50, 75, 81}
    assert all(row["episode_return"] < 0 and row["episode_length"] == 20 for row in finished)
    # evaluations come with the first round that ends past a multiple of 40, and with the run
    assert [row["step"] for row in told if "eval/return" in row and row["seed"] == 0] == [50, 81]
    for row in told:
        if "eval/return" in row:
            assert row["eval/length"] == 20 and row["eval/return_std"] >= 0


def test_an_evaluation_is_what_the_policy_does_without_exploring(evaluated: Path, task: None):
    # acting by hand from the same starts, with the last state's policy
    directory = RunDirectory(evaluated)
    config = directory.config()
    env = build.make_env(config)
    agent = build.make_agent(config, env)
    state, step = loop.last_state(directory, env, agent)
    own = jax.tree.map(lambda leaf: leaf[1], state.explorer)
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(1), 4), step)
    returns = []
    for start in jax.random.split(key, 6)[:3]:
        now, total = env.reset(start), 0.0
        for _ in range(20):
            now, transition = env.step(now, agent.act_greedily(start, agent.actor(own), now.obs))
            total += float(transition.reward)
        returns.append(total)
    last = next(row for row in rows(evaluated) if (row["step"], row["seed"]) == (81, 1))
    assert last["eval/return"] == pytest.approx(np.mean(returns), rel=1e-4)
    assert last["eval/return_std"] == pytest.approx(np.std(returns), rel=1e-2, abs=1e-4)


def test_evaluations_change_nothing(evaluated: Path, task: None, tmp_path: Path):
    assert run.main([*SAC, "--num-seeds=2", f"--out={tmp_path / 'run'}"]) == 0
    plain = [{name: v for name, v in row.items() if not name.startswith("eval/")} for row in rows(evaluated)]
    assert rows(tmp_path / "run") == plain


@pytest.mark.parametrize("words", [("--env=ant_maze",), ("--env=half_cheetah", "--method=random")])
def test_no_task_no_evaluation(words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run.main([*words, "--eval-every=50", f"--out={tmp_path / 'run'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: --eval-every=50 evaluates by the return, and ")
    assert not (tmp_path / "run").exists()


# Runs from a parent.


@pytest.mark.slow
def test_a_run_starts_from_its_parents_policy(evaluated: Path, task: None, tmp_path: Path):
    out = tmp_path / "child"
    words = [*SAC, f"--parent={evaluated}@75", "--seed=7", f"--out={out}"]
    assert run.main(words) == 0
    saved = json.loads((out / "config.json").read_text())["parent"]
    identity = RunDirectory(evaluated).spec().identity
    assert saved == {"directory": str(evaluated), "step": 75, "identity": identity, "before": 0}
    # the state it started from: the parent's policy and statistics, critics of its own
    config = RunDirectory(out).config()
    env = build.make_env(config)
    agent = build.make_agent(config, env)
    fresh = loop.make_programs(config, env, agent).init()
    begun = parent.adopt(fresh, RunRef(str(evaluated), 75, identity), agent).explorer
    theirs, _ = loop.last_state(RunDirectory(evaluated), env, agent, 75)
    first = jax.tree.map(lambda leaf: leaf[:1], theirs.explorer)
    same(begun.behaviour.params["policy"], first.behaviour.params["policy"])
    same(begun.normalizers, first.normalizers)
    same(begun.behaviour.params["q"], fresh.explorer.behaviour.params["q"])
    assert int(begun.data.size[0]) == 0
    # and it differs from a run of the same seed without a parent
    assert run.main([*SAC, "--seed=7", f"--out={tmp_path / 'orphan'}"]) == 0
    assert rows(out)[-1]["policy/q"] != rows(tmp_path / "orphan")[-1]["policy/q"]


def same(a: object, b: object) -> None:
    assert all(jax.tree.leaves(jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), a, b)))


@pytest.mark.parametrize(
    ("flags", "which", "message"),
    [
        (SAC, "{run}@50", "has no checkpoint of step 50. Allowed: one of its checkpoints (75, 81)."),
        (SAC, "{run}@x", "Allowed: DIRECTORY or DIRECTORY@STEP, the step a whole number."),
        (SAC, "{folder}/none", "holds no run. Allowed: the directory of a run."),
        (SAC, "{kept}", "has no checkpoint. Allowed: one of its checkpoints (none; it is kept,"),
        ((*SAC, "--task-sac.hidden", "9"), "{run}", "has a policy of another form (task_sac.hidden=(8,), not (9,))"),
        (("--env=task", "--method=psne", *tiny_flags("psne")), "{run}", "this method has no policy to start with"),
        (
            ("--env=acrobot", "--method=sac", "--preset=smoke"),
            "{run}",
            "has 4 and 2. Allowed: a run with 6 obs",
        ),
    ],
)
def test_a_parent_that_does_not_fit_is_refused(
    flags: tuple[str, ...],
    which: str,
    message: str,
    evaluated: Path,
    task: None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    from tests.experiments.tiny import ROOT

    kept = ROOT / "experiments/results/runs/ant-implicit-s0"
    ref = which.format(run=evaluated, folder=tmp_path, kept=kept)
    assert run.main([*flags, f"--parent={ref}", f"--out={tmp_path / 'run'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: --parent={ref!r}") and message in line
    assert list(tmp_path.iterdir()) == []


def test_the_old_name_answers_with_the_new_one(capsys: pytest.CaptureFixture[str]):
    import runpy
    import sys

    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stop:
        patch.setattr(sys, "argv", ["posterior", "runs/a b"])
        runpy.run_module("experiments.posterior", run_name="__main__")
    assert stop.value.code == 2
    assert "is now experiments.calibrate: python -m experiments.calibrate 'runs/a b'" in capsys.readouterr().err


def test_a_preset_evaluates_nothing_by_itself():
    assert dataclasses.replace(preset_config("laptop")).eval_every == 0
