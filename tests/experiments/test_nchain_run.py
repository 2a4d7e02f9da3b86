"""The chain and its tree search through the command line, as small as it gets."""

import pytest

from experiments import run
from experiments.runs.config import PRESETS
from experiments.runs.presets import preset_config
from tests.experiments.tiny import rows

TINY_CHAIN = (
    *("--env=nchain", "--preset=smoke", "--steps=12", "--warm-up-steps=8", "--checkpoint-every=6"),
    *("--dynamics.hidden", "4", "--generator.hidden", "4", "--generator.noise-size=2", "--svgd.num-particles=2"),
    "--generator.num-generators=2",
    *("--mcts.num-iterations=4", "--mcts.num-trajectories=2", "--mcts.horizon=5"),
)


def test_a_run_plans_after_every_step(tmp_path):
    # rounds of one step; after the warm-up each learns, and says what its models make of all 80 pairs
    assert run.main([*TINY_CHAIN, f"--out={tmp_path / 'run'}"]) == 0
    told = rows(tmp_path / "run")
    assert [row["step"] for row in told] == list(range(1, 13))
    assert ["policy/utility" in row for row in told] == [row["step"] >= 8 for row in told]
    assert all(0 <= row["policy/agreement"] <= 1 for row in told[7:])
    assert all(row["coverage"] == row["cells"] / 40 for row in told)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_whole_episodes_after_three_random_ones(preset):
    # 49 steps an episode; 15 episodes but for the smoke test
    config = preset_config(preset, "nchain")
    assert config.steps == 49 * (4 if preset == "smoke" else 15)
    assert config.explorer.warm_up_steps == 3 * 49 and config.explorer.steps_per_round == 1


def test_planners_that_do_not_fit_are_refused_before_anything_is_written(tmp_path, capsys):
    # the chain given to SAC, and the maze to tree search: status 2, the reason, no directory
    out = tmp_path / "run"
    chain = [word for word in TINY_CHAIN if not word.startswith("--mcts")]
    assert run.main([*chain, "--planner=sac", f"--out={out}"]) == 2
    assert "planner='sac'" in capsys.readouterr().err
    assert run.main(["--env=ant_maze", "--planner=mcts", f"--out={out}"]) == 2
    assert "planner='mcts'" in capsys.readouterr().err
    assert not out.exists()
