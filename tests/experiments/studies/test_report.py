"""From finished runs to panels, tables and verdicts; the runs are written by hand."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from experiments.analysis.load import load
from experiments.analysis.page import FloorVisits, Panel
from experiments.analysis.verdicts import ahead, at_most
from experiments.runs.errors import RunError
from experiments.studies import plan, report
from tests.experiments.studies.by_hand import COVERAGE, RETURN, VISITS, cell, figure, finish

RANDOM = {0: 1, 1: 1}


def make(tmp_path: Path, *figures, cells: dict[str, dict[int, int]], skip: tuple[str, ...] = ()):
    made = plan.make(list(figures), "laptop", tmp_path)
    for job in made.jobs.values():
        assert job.spec is not None
        if job.spec.config.method not in skip:
            finish(job, cells.get(job.spec.config.method))
    return report.make(made, plan.look_all(made), {}, plan.rates([]))


def test_a_claim_that_holds_and_its_numbers(tmp_path: Path):
    one = figure(
        "a", (cell("implicit"), cell("random")), COVERAGE, (ahead("implicit", "random"), at_most("random", 0.3))
    )
    found = make(tmp_path, one, cells={"implicit": {0: 4, 1: 4}, "random": RANDOM})
    (section,) = found.sections
    assert section.verdict == "holds"
    (panel,) = section.panels
    assert isinstance(panel, Panel)
    assert [(series.label, series.seeds) for series in panel.series] == [("implicit", (0, 1)), ("random", (0, 1))]
    assert panel.series[0].values[:, -1].tolist() == [1.0, 1.0] and panel.series[0].steps[-1] == 300
    assert panel.ceiling == 0.5  # two of the four squares can be reached
    assert panel.measure == "share seen of 4 squares"
    (table,) = section.tables
    assert [line[:2] for line in table.lines] == [("implicit", "0 to 1"), ("random", "0 to 1")]
    # Both seeds of `implicit` rank above both of `random`.
    assert table.lines[1][-1] == "1.00"
    assert section.command == "python -m experiments.paper a --preset=laptop"
    assert section.facts["seeds"] == "0 to 1" and section.facts["steps"] == "300"
    assert section.facts["wall time"] == "12 s of 4 runs together"


def test_a_claim_that_does_not(tmp_path: Path):
    one = figure("a", (cell("implicit"), cell("random")), COVERAGE, (ahead("implicit", "random"),))
    (section,) = make(tmp_path, one, cells={"implicit": RANDOM, "random": {0: 4, 1: 4}}).sections
    assert section.verdict == "does not hold"


def test_runs_that_are_missing_are_said_to_be(tmp_path: Path):
    one = figure("a", (cell("implicit"), cell("random")), COVERAGE, (ahead("implicit", "random"),))
    other = figure("b", (cell("max"),))
    found = make(tmp_path, one, other, cells={}, skip=("random", "max"))
    first, second = found.sections
    assert first.verdict == "not run" and "no runs of random" in first.explanation
    assert "2 of 4 runs are not in it" in first.explanation
    assert second.verdict == "not run" and not second.panels and not second.tables
    assert found.notes[0] == "2 of 6 runs are finished."


def test_those_that_failed_are_listed_with_the_reason(tmp_path: Path):
    made = plan.make([figure("a", (cell("random"),))], "laptop", tmp_path)
    first = next(iter(made.jobs.values()))
    found = report.make(made, plan.look_all(made), {first.key: "not finite was q_loss"}, {})
    assert f"{first.name} is in no figure: not finite was q_loss" in found.notes


def test_walks_of_all_seeds_are_one_picture(tmp_path: Path):
    (section,) = make(tmp_path, figure("a", (cell("implicit"),), VISITS), cells={}).sections
    (visits,) = section.panels
    assert isinstance(visits, FloorVisits)
    assert visits.positions.shape == (600, 2)
    assert np.unique(visits.seeds, return_counts=True)[1].tolist() == [300, 300]
    assert len(visits.floor.cells) == 2


def test_over_episodes_and_what_the_paper_prints(tmp_path: Path):
    measure = COVERAGE._replace(over="episodes")
    one = figure("a", (cell("implicit"),), measure)._replace(printed={"implicit": "11269 +- 395"})
    (section,) = make(tmp_path, one, cells={}).sections
    (panel,) = section.panels
    assert isinstance(panel, Panel) and panel.steps_label == "episodes"
    assert panel.series[0].steps[-1] == 300 / 50
    assert section.tables[0].head[-1] == "the paper's" and section.tables[0].lines[0][-1] == "11269 +- 395"


def test_a_return_is_of_the_last_tenth(tmp_path: Path):
    (section,) = make(tmp_path, figure("a", (cell("implicit"),), RETURN), cells={}).sections
    # Of seed 0 it is 1, of seed 1 it is 2.
    assert section.tables[0].lines[0][3].startswith("1.5 ± 0.71")


def test_runs_of_one_cell_may_differ_in_their_seed_alone(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit"),))], "laptop", tmp_path / "out")
    first, second = made.jobs.values()
    assert second.spec is not None
    changed = dataclasses.replace(second.spec, config=dataclasses.replace(second.spec.config, obs_noise=0.5))
    paths = [finish(first), finish(second._replace(spec=changed))]
    with pytest.raises(RunError, match=re.escape("obs_noise: 0.0 -> 0.5. Allowed: runs that differ in their seed")):
        report.measured(cell("implicit"), COVERAGE, [load(path) for path in paths])
    twice = [load(paths[0]), load(paths[0])]
    with pytest.raises(RunError, match="a seed comes twice"):
        report.measured(cell("implicit"), COVERAGE, twice)


def test_the_papers_scale_is_extrapolated_from_runs_of_its_preset(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit"), cell("max")))], "laptop", tmp_path)
    known = {("ant_maze", "implicit", "paper"): 2.0}
    (section,) = report.make(made, plan.look_all(made), {}, known).sections
    # Two seeds of 300 steps.
    told = section.facts["at the paper's scale, extrapolated"]
    assert told == "20 min 00 s, and 1 lines of which no run tells"
