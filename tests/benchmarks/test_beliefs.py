"""The testbed of beliefs: known answers of its measures, and a belief that it can tell from a better one."""

import dataclasses
import json
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import beliefs, gaussian_process, transitions
from experiments.runs.presets import preset_config
from jaxplore.dynamics import Prediction


def test_the_exact_posterior_is_what_sampling_finds():
    # of a function seen at the data: by conditioning, and by weighing many functions of the prior by their likelihood
    problem = gaussian_process.draw_problem(3)
    few = 4
    inputs, values, test = problem.inputs[:few], problem.values[:few], problem.test[:2]
    rng = np.random.default_rng(0)
    points = np.concatenate([inputs, test])
    root = np.linalg.cholesky(gaussian_process.kernel(points, points) + 1e-9 * np.eye(len(points)))
    functions = rng.normal(size=(400_000, len(points))) @ root.T
    noise = 0.5
    weights = np.exp(-0.5 * np.sum((functions[:, :few] - values) ** 2, axis=1) / noise**2)
    weights /= weights.sum()
    mean = weights @ functions[:, few:]
    seen = gaussian_process.kernel(inputs, inputs) + noise**2 * np.eye(few)
    across = gaussian_process.kernel(test, inputs)
    np.testing.assert_allclose(across @ np.linalg.solve(seen, values), mean, atol=0.03)


def test_divergences_are_zero_of_the_same_and_known_of_others():
    covariance = np.array([[1.0, 0.5], [0.5, 2.0]])
    zero = gaussian_process.divergence(np.ones(2), covariance, np.ones(2), covariance)
    assert zero == pytest.approx(0.0, abs=1e-12)
    # twice the standard deviation: ln 2 - 1/2 + 1/8
    one = gaussian_process.divergence(np.zeros(1), np.eye(1), np.zeros(1), 4 * np.eye(1))
    assert one == pytest.approx(np.log(2) - 0.5 + 0.125)


def test_a_kind_is_judged_by_hand():
    # two models at 0 and 2 times the row's number, which happens to be what it is wrong by: error and variance n^2
    numbers = np.arange(1.0, 8.0, dtype=np.float32)
    rows = transitions.Transition(
        numbers[:, None],
        np.zeros((7, 1), np.float32),
        np.zeros(7),
        np.zeros((7, 1), np.float32),
        np.zeros(7),
        np.zeros(7),
    )

    class Fake:
        """Pairs of models, each of a generator of its own."""

        def __init__(self, num_groups: int):
            self.num_groups, self.has_groups = num_groups, num_groups > 1

        def judge(self, models, normalizers, rows):
            mean = jnp.stack([0.0 * rows.obs, 2.0 * rows.obs] * self.num_groups)
            return Prediction(mean), rows.obs - rows.obs

    for num_groups in (1, 3):
        found = beliefs.judge(Fake(num_groups), (), (), rows)  # pyright: ignore[reportArgumentType]
        assert found.error == pytest.approx(np.mean(numbers**2))
        assert found.variance == pytest.approx(np.mean(numbers**2))
        assert found.ratio == pytest.approx(1.0)
        assert found.rank == pytest.approx(1.0)
        # a generator's own is the unbiased variance of two, twice the other; with one there is nothing to tell apart
        assert found.within == (pytest.approx(2 * np.mean(numbers**2)) if num_groups > 1 else None)


@pytest.mark.parametrize("name", ["ant_maze", "acrobot", "half_cheetah"])
def test_what_is_stored_is_three_kinds_of_one_environment(name: str):
    stored = transitions.load(name)
    assert name in transitions.names()
    assert len(stored.next_steps.obs) == transitions.NUM_NEXT
    assert len(stored.data.obs) >= 1_000 and len(stored.elsewhere.obs) >= 500
    for rows in stored:
        assert np.isfinite(rows.obs).all() and np.isfinite(rows.next_obs).all()
        assert np.abs(rows.action).max() <= 1.0
        assert rows.obs.shape[1] == stored.data.obs.shape[1]
    # the steps that came next go on where the data end, but for a new episode
    joined = np.array_equal(stored.data.next_obs[-1], stored.next_steps.obs[0])
    assert joined or not np.array_equal(stored.data.obs[-1], stored.next_steps.obs[0])


def test_the_command_judges_a_belief(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["--preset=smoke", "--env=acrobot", "--method=disagreement", "--dynamics.hidden", "8"]
    out = tmp_path / "found.json"
    assert beliefs.main([*words, "--data=acrobot,gaussian_process", "--fit-steps=60", f"--json={out}"]) == 0
    text = capsys.readouterr().out
    assert "next_steps" in text and "KL, ten at a time" in text
    found = json.loads(out.read_text())
    assert found["words"] == words and found["steps"] == 60
    kinds = found["stored"][0]["kinds"]
    assert set(kinds) == {"data", "next_steps", "elsewhere"}
    assert all(0 < kind["error"] < 1e4 and kind["variance"] > 0 and -1 <= kind["rank"] <= 1 for kind in kinds.values())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--data=ant_mase", r"--data=ant_mase is not known\. Allowed: acrobot, ant_maze"),
        ("--fit-steps=x", r"--fit-steps=x\. Allowed: a whole number"),
        ("--method=random --data=acrobot", r"--method=random has no belief"),
        ("--sac.lr=x", r"--sac\.lr='x' is not a number"),
    ],
)
def test_bad_words_are_refused(words: str, message: str, capsys: pytest.CaptureFixture[str]):
    assert beliefs.main(words.split()) == 2
    assert re.search(message, capsys.readouterr().err)


@pytest.mark.slow
def test_tanh_features_live_where_the_papers_die():
    # after as many gradient steps as a run of 4,000 in the maze comes to, on its data: measured 0 and 90 %
    config = preset_config("laptop", "ant_maze").explorer
    dead = {}
    for activation in ("tanh", "relu"):
        generator = dataclasses.replace(config.generator, activation=activation)
        own = dataclasses.replace(config, generator=generator)
        dead[activation] = beliefs.verdict("ant_maze", "implicit", own, beliefs.STEPS, 0).metrics["dead_features"]
    assert dead["tanh"] == 0.0
    assert dead["relu"] > 0.5


@pytest.mark.slow
def test_svgd_keeps_the_draws_of_a_generator_apart():
    # for as many gradient steps as a run of 5,500 has; fitted each on a batch of its own, draws become one network
    config, share = preset_config("laptop", "ant_maze").explorer, {}
    for batches in ("shared", "own"):
        own = dataclasses.replace(config, svgd=dataclasses.replace(config.svgd, batches=batches))
        kind = beliefs.verdict("ant_maze", "implicit", own, 12_000, 0).kinds["data"]
        assert kind.within is not None
        share[batches] = kind.within / kind.variance
    assert share["shared"] > 0.2 > 4 * share["own"]
