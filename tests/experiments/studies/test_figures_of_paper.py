import dataclasses

import pytest

from experiments.analysis.verdicts import Numbers
from experiments.runs.config import PRESETS, RunConfig
from experiments.runs.inherit import form_of
from experiments.studies import figures_of_paper
from experiments.studies.figures_of_paper import config_of, figures
from jaxplore.validate import FieldError

NAMES = ("chain", "acrobot", "ant_coverage", "ant_reward", "ant_visits", "hand", "transfer", "transfer_length")
NAMES = (*NAMES, "transfer_cold", "table_sac", "disagreement_full", "rnd_psne", "transfer_today", "methods", "beliefs")


def test_every_figure_is_there_in_the_papers_order():
    assert tuple(figures()) == NAMES
    assert [figure.name for figure in figures_of_paper.choose(("hand", "chain"))] == ["chain", "hand"]


def test_an_unknown_one_has_its_nearest():
    with pytest.raises(FieldError, match="Did you mean 'ant_reward'"):
        figures_of_paper.choose(("ant_rewards",))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_cell_makes_a_configuration(preset: str):
    cells = [cell for figure in figures().values() for part in figure.parts for cell in part.cells]
    assert len(cells) > 80
    for cell in cells:
        config = config_of(cell, preset)
        assert (config.env, config.method, config.preset) == (cell.env, cell.method, preset)
        many = preset == "laptop" and cell.by_preset["laptop"].get("num_seeds")
        assert config.num_seeds == (2 if preset == "smoke" else many or cell.seeds)
        assert config.seed == (20 if preset == "laptop" else 0)


def test_the_laptops_acrobot_and_maze_have_ten_seeds():
    for name in ("acrobot", "ant_coverage", "ant_reward", "ant_visits"):
        for cell in figures()[name].parts[0].cells:
            laptop, paper = config_of(cell, "laptop"), config_of(cell, "paper")
            assert (laptop.seed, laptop.num_seeds, paper.num_seeds) == (20, 10, 5)


def test_the_papers_seeds_and_steps():
    chain, ant = figures()["chain"].parts[0].cells, figures()["ant_coverage"].parts[0].cells
    assert {(cell.seeds, cell.steps["paper"]) for cell in chain} == {(3, 15 * 49)}
    assert {(cell.seeds, cell.steps["paper"]) for cell in ant} == {(5, 10_000)}
    # A million in all, those of the exploration included.
    task = {cell.label: config_of(cell, "paper").steps for cell in figures()["transfer"].parts[0].cells}
    assert task == {"implicit": 990_000, "max": 990_000, "icm": 990_000, "disagreement": 990_000, "sac": 1_000_000}
    lengths = {cell.label: config_of(cell, "paper").steps for cell in figures()["transfer_length"].parts[0].cells}
    assert lengths["init-2k"] == 998_000 and lengths["init-10k"] == 990_000


@pytest.mark.parametrize("preset", PRESETS)
def test_what_is_handed_on_has_the_form_that_the_task_has(preset: str):
    """So that a difference between the two is what the weights know, and not another network."""
    warm = figures()["transfer"].parts[0].cells
    (alone,) = [form_of(config_of(cell, preset)) for cell in warm if cell.parent is None]
    parents = [cell.parent for cell in warm if cell.parent is not None]
    assert len(parents) == 4
    for parent in parents:
        assert form_of(config_of(parent, preset)) == alone


def test_as_much_has_been_learned_by_whatever_policy_is_handed_on():
    """A policy of the laptop preset lives for several rounds, and each length of exploration ends in the same one."""
    config = config_of(figures_of_paper.PARENTS["implicit"], "laptop")
    explorer, life = config.explorer, config.explorer.imagination.restart_every
    ages = {
        (step - explorer.warm_up_steps) // explorer.steps_per_round % life for step in (*config.keep_at, config.steps)
    }
    assert len(config.keep_at) == 4 and len(ages) == 1
    assert config_of(figures_of_paper.PARENTS["icm"], "laptop").explorer.reactive.restart_every == life


def test_rnd_is_paid_for_the_task_on_the_cheetah_and_not_in_the_maze():
    task, maze = figures()["rnd_psne"].parts
    (cheetah,) = [cell for cell in task.cells if cell.method == "rnd"]
    (ant,) = [cell for cell in maze.cells if cell.method == "rnd"]
    for preset in PRESETS:
        assert config_of(cheetah, preset).explorer.ppo.extrinsic_weight == 2.0
        assert config_of(ant, preset).explorer.ppo.extrinsic_weight == 0.0


def test_conditions_ask_for_labels_that_there_are():
    for figure in figures().values():
        for condition in figure.conditions:
            beliefs = condition.part == len(figure.parts)
            cells = figure.testbeds if beliefs else figure.parts[condition.part].cells
            found = {cell.label: {0: 1.0, 1: 2.0} for cell in cells}
            assert condition.decide(Numbers(found, "", found, found, found))[0] != "not run", condition.text


def test_conditions_ask_what_the_claims_say():
    texts = {name: [one.text for one in figure.conditions] for name, figure in figures().items()}
    assert all(texts.values())
    assert {f"{one} at 100% on every seed" for one in ("implicit", "max")} <= set(texts["chain"])
    assert {f"max ahead of {one}" for one in ("icm", "disagreement")} <= set(texts["chain"])
    assert sum("at 100% on every seed" in text for text in texts["acrobot"]) == 4
    assert "implicit at 100% on every seed" in texts["ant_coverage"]
    rises, falls = texts["ant_reward"][:2]
    assert rises.startswith("implicit higher later") and falls.startswith("max lower in the second half")
    # No more than half of the hand's rotations can be reached, so that none sees half of them is no finding.
    assert not any("or less" in text for text in texts["hand"]) and "256" in figures()["hand"].unasked


def test_the_table_prints_what_the_paper_prints():
    table = figures()["table_sac"]
    assert table.printed["ours with warm-up, exploration's settings"] == "11269 +- 395"
    assert {cell.label for cell in table.parts[0].cells} == set(table.printed)
    (cell,) = [one for one in table.parts[0].cells if one.label == "sac, exploration's settings"]
    sac = config_of(cell, "paper").explorer.task_sac
    assert (sac.lr, sac.batch_size, sac.alpha, sac.reward_scale) == (1e-3, 4096, 0.02, 1.0)


def test_without_a_warm_up_is_as_short_as_can_be():
    (cell,) = [one for one in figures()["transfer_cold"].parts[0].cells if one.label == "sac"]
    config = config_of(cell, "paper")
    if "warm_up" in {item.name for item in dataclasses.fields(RunConfig)}:
        assert getattr(config, "warm_up") == "none"  # noqa: B009
        assert config.explorer.warm_up_steps == 0
    else:
        assert config.explorer.warm_up_steps == 1
