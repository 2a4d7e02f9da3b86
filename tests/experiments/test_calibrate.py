"""What a belief knows and whether it knows that: known answers for the figures, and the command on a finished run."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from experiments import calibrate
from experiments.analysis.calibration import DATA, FEWEST, HELD_OUT, SEEN, UNSEEN, Judged, calibration, told_apart
from experiments.training.ask import CHUNK, STEPS_EACH, Judge, walk, walk_elsewhere
from jaxplore import dynamics
from jaxplore.behaviours import uniform_actions
from jaxplore.beliefs import Belief, make_no_belief
from jaxplore.dynamics import Prediction
from jaxplore.types import Transition
from tests.experiments.tiny import ROOT, make_point


def judged(variance, error, stated=0.0):
    variance = np.asarray(variance, float)
    return Judged(variance, np.asarray(error, float), np.full(len(variance), stated), np.zeros(len(variance), int))


def test_errors_a_fixed_factor_above_the_variance():
    variance = np.linspace(1.0, 3.0, 50)
    found = calibration(judged(variance, 4.0 * variance))
    assert (found.num, found.error, found.variance) == (50, pytest.approx(8.0), pytest.approx(2.0))
    assert found.error_per_variance == pytest.approx(4.0)
    assert found.rank == pytest.approx(1.0)
    # networks that state a variance of 6 themselves predict 2 + 6, which is what the errors are
    assert calibration(judged(variance, 4.0 * variance, 6.0)).error_per_predictive == pytest.approx(1.0)
    assert calibration(judged(variance, variance[::-1])).rank == pytest.approx(-1.0)


def test_draws_from_the_posterior_are_calibrated():
    # truth and models are drawn alike: the squared error of m models' mean is (1 + 1/m) times the variance drawn from,
    # which m models show (1 - 1/m) of
    m, n, rng = 32, 20_000, np.random.default_rng(0)
    scale = rng.uniform(0.5, 2.0, n)
    models, truth = scale * rng.standard_normal((m, n)), scale * rng.standard_normal(n)
    found = calibration(judged(models.var(axis=0), (models.mean(axis=0) - truth) ** 2))
    assert found.error_per_variance == pytest.approx((1 + 1 / m) / (1 - 1 / m), abs=0.05)
    assert 0.2 < found.rank < 0.6


def test_what_cannot_be_told_is_none():
    assert calibration(judged(np.ones(FEWEST - 1), np.ones(FEWEST - 1))) is None
    sure = calibration(judged(np.zeros(FEWEST), np.arange(FEWEST)))
    assert (sure.error_per_variance, sure.error_per_predictive, sure.rank) == (None, None, None)
    assert told_apart(np.ones(FEWEST), np.ones(FEWEST - 1)) is None


def test_told_apart_is_every_pair_counted():
    rng = np.random.default_rng(0)
    low, high = rng.integers(0, 6, 40), rng.integers(2, 9, 30)
    pairs = np.mean([(b > a) + 0.5 * (a == b) for a in low for b in high])
    assert told_apart(low, high) == pytest.approx(pairs)
    assert told_apart(np.arange(30.0), np.arange(30.0) + 100) == 1.0


@pytest.mark.parametrize("num", [3, CHUNK + 1])
def test_a_judge_sees_each_transition_once(num: int):
    # models predict 1, 2 and 3 times the observation: variance 2/3 |obs|^2, and the mean is off by |2 obs - delta|^2
    belief = Belief(
        init=lambda key: (),
        update=lambda key, state, data, normalizers: (state, {}),
        sample=lambda key, state, num: jnp.arange(1.0, num + 1),
        predict=lambda models, inputs: Prediction(
            models[:, None, None] * inputs[None, :, :4], jnp.full((3, inputs.shape[0], 4), 0.5)
        ),
    )
    rng = np.random.default_rng(0)
    obs, delta = rng.normal(size=(2, num, 4)).astype(np.float32)
    flag = np.zeros(num, bool)
    rows = Transition(obs, np.zeros((num, 2), np.float32), np.zeros(num, np.float32), obs + delta, flag, flag)
    env = make_point()
    found = Judge(belief, env)(belief.sample(None, (), 3), dynamics.init_normalizers(4, 2), rows)
    np.testing.assert_allclose(found.variance, 2 / 3 * np.sum(obs**2, axis=1), rtol=1e-5)
    np.testing.assert_allclose(found.error, np.sum((2 * obs - delta) ** 2, axis=1), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.stated, 2.0)
    np.testing.assert_array_equal(found.cell, [int(env.coverage.cell(one)) for one in obs])
    with pytest.raises(ValueError, match=r"no belief to ask. Allowed: a method with models"):
        Judge(make_no_belief(), env)((), dynamics.init_normalizers(4, 2), rows)


def test_elsewhere_is_everywhere():
    env = envs.make("mountain_car")
    rows = walk_elsewhere(env, jax.random.key(0), lambda key, obs: uniform_actions(key, obs, 1))
    starts = rows.obs[::STEPS_EACH]
    # an episode that reaches the flag is shorter, so look at the set of all cells instead of the order
    cells = {int(cell) for cell in jax.vmap(env.coverage.cell)(rows.obs)}
    assert cells == set(range(100))
    assert len(starts) > 90
    assert walk_elsewhere(make_point(), jax.random.key(0), lambda key, obs: obs[:2]) is None


@pytest.fixture(scope="module")
def asked(finished, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of a finished run that was asked."""
    out = tmp_path_factory.mktemp("asked") / "run"
    shutil.copytree(finished.out, out)
    assert calibrate.main([str(out)]) == 0
    return out


def test_a_run_is_asked_of_all_that_it_should_know(asked: Path, finished):
    text = json.loads((asked / "calibration.json").read_text())
    assert (text["method"], text["env"], text["step"]) == ("implicit", "ant_maze", 81)
    assert text["unit"] == "normalised delta, squared"
    (seed,) = text["seeds"]
    sets = seed["sets"]
    assert sets[DATA]["num"] == 81
    assert sets[HELD_OUT]["num"] == 600
    # 20 starts of 10 steps in each of 7 cells; a step near a wall may leave the cell that it started in
    assert 1_300 < sets[SEEN]["num"] + sets[UNSEEN]["num"] <= 1_400
    seen = {entry["cell"] for entry in seed["cells"] if entry["seen"]}
    last = json.loads((finished.out / "metrics.jsonl").read_text().splitlines()[-1])
    assert len(seen) == last["cells"] and len(seed["cells"]) == 7
    assert 0.0 <= seed["unseen_told_from_data"] <= 1.0
    for figures in sets.values():
        assert figures["error_per_variance"] == pytest.approx(figures["error"] / figures["variance"])
        assert figures["error_per_predictive"] == figures["error_per_variance"]
    new = {path.name for path in asked.iterdir()} - {path.name for path in finished.out.iterdir()}
    assert new == {"calibration.json", "calibration.png"}
    assert (asked / "calibration.png").stat().st_size > 20_000


def test_asking_again_gives_the_same(asked: Path):
    before = (asked / "calibration.json").read_text()
    assert calibrate.main([str(asked)]) == 0
    assert (asked / "calibration.json").read_text() == before


@pytest.mark.slow
def test_an_earlier_checkpoint_can_be_asked(asked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "run"
    shutil.copytree(asked, out)
    assert calibrate.main([str(out), "--until=80"]) == 0
    text = json.loads((out / "calibration.json").read_text())
    assert (text["step"], text["seeds"][0]["sets"][DATA]["num"]) == (75, 75)
    assert calibrate.main([str(out), "--until=74"]) == 1
    assert "no checkpoint up to step 74, only of [75, 81]" in capsys.readouterr().err


class Told:
    """A `Progress` that keeps what it is told."""

    def __init__(self) -> None:
        self.done: list[int] = []

    def reach(self, done: int) -> None:
        self.done.append(done)


@pytest.mark.parametrize(
    ("name", "options", "steps", "seen"),
    [
        # On the host every step is seen; of a compiled one, that it begins anew.
        ("ant_maze", {"backend": "mujoco"}, 600 + 7 * 20 * STEPS_EACH, 600 + 7 * 20 * STEPS_EACH),
        ("mountain_car", {}, 600 + 100 * STEPS_EACH, 100 * STEPS_EACH),
    ],
)
def test_how_far_it_is(name: str, options: dict, steps: int, seen: int):
    env = envs.make(name, **options)
    assert calibrate.num_steps(env) == steps
    told = Told()
    watched = calibrate.watched(env, told, 5_000)  # type: ignore[arg-type]

    def act(key, obs):
        return uniform_actions(key, obs, env.spec.action_size)

    rows = walk(watched, jax.random.key(0), act, 600)
    again = walk(env, jax.random.key(0), act, 600)
    np.testing.assert_array_equal(rows.obs, again.obs)
    assert walk_elsewhere(watched, jax.random.key(1), act) is not None
    assert 0.95 * seen < told.done[-1] - 5_000 <= seen
    assert told.done == sorted(told.done)


def test_an_environment_that_cannot_be_put_anywhere_is_asked_less():
    assert calibrate.num_steps(make_point()) == 600


@pytest.mark.slow
def test_a_bar_on_a_terminal(asked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copytree(asked, tmp_path / "run")
    stream = io.StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", stream)
    assert calibrate.main([str(tmp_path / "run")]) == 0
    # 600 steps of its own and 20 starts in each of 7 cells.
    assert "asking: " in stream.getvalue() and "/2000 [" in stream.getvalue()
    assert stream.getvalue().split("\r")[-1].strip() == ""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_gives_a_line(finished, tmp_path: Path):
    runs = [tmp_path / str(i) for i in range(5)]
    for out in runs:
        shutil.copytree(finished.out, out)
    command = [sys.executable, "-u", "-m", "experiments.calibrate", *map(str, runs)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "implicit on ant_maze after 81 steps\n", "the first run's table"
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    # Above it how far the next run is, on a machine slow enough for that to be said.
    assert stderr.strip().splitlines()[-1] == "Stopped."
    assert "Traceback" not in stderr
    assert not (runs[-1] / "calibration.json").exists()


def test_says_why_not(tell, point: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert calibrate.main([str(tmp_path)]) == 1
    assert "holds no run" in capsys.readouterr().err
    out = tmp_path / "random"
    told = tell(out, f"--env={point}", "--method=random", "--preset=smoke", "--steps=300")
    assert told.status == 0
    assert calibrate.main([str(out)]) == 1
    assert "no belief to ask" in capsys.readouterr().err
    assert not (out / "calibration.json").exists()
