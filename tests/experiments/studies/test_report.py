"""From finished runs to panels, tables and verdicts; the runs are written by hand."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from experiments import machine
from experiments.analysis.load import load
from experiments.analysis.page import FloorVisits, Panel
from experiments.analysis.verdicts import ahead, at_most, ranks
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.studies import figures_of_paper, plan, report
from tests.experiments.studies.by_hand import COVERAGE, NO_RATES, RETURN, VISITS, WHOLE, cell, figure, finish, write

RANDOM = {0: 1, 1: 1}


def make(tmp_path: Path, *figures, cells: dict[str, dict[int, int]], skip: tuple[str, ...] = ()):
    made = plan.make(list(figures), "laptop", tmp_path)
    for job in made.jobs.values():
        assert job.spec is not None
        if job.spec.config.method not in skip:
            finish(job, cells.get(job.spec.config.method))
    return report.make(made, plan.look_all(made), {}, NO_RATES)


def test_a_claim_that_holds_and_its_numbers(tmp_path: Path):
    one = figure(
        "a", (cell("implicit"), cell("random")), COVERAGE, (ahead("implicit", "random"), at_most("random", 0.3))
    )
    found = make(tmp_path, one, cells={"implicit": {0: 4, 1: 4}, "random": RANDOM})
    (section,) = found.sections
    assert section.verdict == "holds"
    said = [str(one) for one in section.reasons]
    assert said[0] == "implicit ahead of random: holds (by 61 ± 0 points of coverage on 2 seeds)" and len(said) == 2
    (panel,) = section.panels
    assert isinstance(panel, Panel)
    assert [(series.label, series.seeds) for series in panel.series] == [("implicit", (0, 1)), ("random", (0, 1))]
    assert panel.series[0].values[:, -1].tolist() == [1.0, 1.0] and panel.series[0].steps[-1] == 300
    assert panel.ceiling == 0.5  # two of the four squares can be reached
    assert panel.measure == "share seen of 4 squares"
    (table,) = section.tables
    assert [line[:2] for line in table.lines] == [("implicit", "2: 0 to 1"), ("random", "2: 0 to 1")]
    # Both seeds of `implicit` rank above both of `random`, by as much as the verdict says.
    assert table.lines[1][-2:] == ("61 ± 0", "1.00") and table.head[-2] == "implicit ahead by, 95 % by Student's t"
    assert table.head[2] == "interquartile mean, 95 % by bootstrap"
    assert section.command == "python -m experiments.paper a --preset=laptop"
    assert section.facts["seeds of a line"] == "2" and section.facts["steps"] == "300"
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
    assert first.verdict == "not run" and first.reasons[0].why == "no runs of random"
    assert "2 of 4 runs are not in it" in first.explanation
    assert second.verdict == "not run" and not second.panels and not second.tables
    assert found.notes[0] == "2 of 6 runs of these figures are finished."
    assert found.notes[1].startswith("2 of 15 figures are in this report. Not in it: chain, acrobot, ")
    # It has no conditions, and no verdict either.
    (only,) = make(tmp_path / "more", figure("c", (cell("max"),)), cells={}).sections
    assert only.verdict == "not asked"


def test_those_that_failed_are_listed_with_the_reason(tmp_path: Path):
    made = plan.make([figure("a", (cell("random"),))], "laptop", tmp_path)
    first = next(iter(made.jobs.values()))
    found = report.make(made, plan.look_all(made), {first.key: "not finite was q_loss"}, NO_RATES)
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


def test_a_number_has_one_sign_in_words_and_in_the_table(tmp_path: Path):
    one = figure("a", (cell("implicit"), cell("random")), WHOLE, (ahead("implicit", "random"),))
    (section,) = make(tmp_path, one, cells={"implicit": {0: 4, 1: 4}, "random": RANDOM}).sections
    # `implicit` is whole in the first round of the second half, at step 175, and `random` never, which counts as 300.
    assert section.reasons[0].why == "by 125 ± 0 steps on 2 seeds"
    head, lines = section.tables[0].head, section.tables[0].lines
    assert lines[1][head.index("implicit ahead by, 95 % by Student's t")] == "125 ± 0"
    never = head.index("never, counted as the last step")
    assert [line[never] for line in lines] == ["0 of 2", "2 of 2"]


def test_seeds_that_diverged_in_a_run_that_survived_are_listed(tmp_path: Path):
    made = plan.make([figure("a", (cell("random", env="acrobot", seeds=3),))], "laptop", tmp_path)
    (job,) = made.jobs.values()
    finish(job)
    (job.path / "outcome.json").write_text(
        '{"status": "finished", "diverged": {"1": {"step": 50, "what": "fit/loss"}}}'
    )
    made = plan.make(made.figures, "laptop", tmp_path)
    found = report.make(made, plan.look_all(made), {}, NO_RATES)
    assert f"{job.name}, seed 1, is in no figure: it diverged at step 50 (not finite: fit/loss)" in found.notes
    assert found.sections[0].tables[0].lines[0][1] == "2: 0, 2"


def test_a_damaged_run_is_left_out_and_said_to_be(tmp_path: Path):
    one = figure("a", (cell("implicit"), cell("random")), conditions=(ahead("implicit", "random"),))
    made = plan.make([one], "laptop", tmp_path)
    for job in made.jobs.values():
        finish(job)
    first = next(iter(made.jobs.values()))
    (first.path / "metrics.jsonl").write_text("{}\n")
    found = report.make(made, plan.look_all(made), {}, NO_RATES)
    (note,) = [note for note in found.notes if "is left out" in note]
    assert note.startswith(f"{first.name} is left out: line 1 of {first.path / 'metrics.jsonl'} is damaged")
    (section,) = found.sections
    assert section.facts["seeds of a line"] == "1 to 2, of 2 that there are to be"
    assert section.tables[0].lines[0][1] == "1: 1" and "1 of 4 runs are not in it" in section.explanation


def test_what_the_runs_were_made_on(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit"),))], "laptop", tmp_path)
    paths = [finish(job) for job in made.jobs.values()]
    assert report.make(made, plan.look_all(made), {}, NO_RATES).sections[0].facts["machine"] == machine.describe()
    saved = json.loads((paths[0] / "versions.json").read_text())
    for path, name in zip(paths, ("a large one", None), strict=True):
        (path / "versions.json").write_text(json.dumps({**saved, "machine": name}))
    facts = report.make(made, plan.look_all(made), {}, NO_RATES).sections[0].facts
    assert facts["machine"] == "a large one (1 runs); not recorded (1 runs)"
    # Another machine is no other version: what is resumed there goes on.
    assert RunDirectory(paths[0]).changed_versions() == []


def test_commands_are_shown_with_the_flags_that_were_given(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit"),))], "laptop", tmp_path)
    words = ("--report", "--out=a place")
    (section,) = report.make(made, plan.look_all(made), {}, NO_RATES, words).sections
    assert section.command == "python -m experiments.paper a --preset=laptop --report '--out=a place'"


def test_a_belief_is_judged_by_the_lowest_of_its_correlations(tmp_path: Path):
    beliefs = tuple(figures_of_paper.Testbed(name, name) for name in ("max", "implicit"))
    one = figure("a", (), conditions=(ranks("max"), ranks("implicit")))._replace(parts=(), testbeds=beliefs)
    made = plan.make([one._replace(unasked="the rest.")], "laptop", tmp_path)
    for job, lowest in zip(made.jobs.values(), (0.2, -0.1), strict=True):
        kinds = {
            kind: {"error": 1, "variance": 1, "ratio": 1, "rank": rank} for kind, rank in (("b", 0.5), ("c", lowest))
        }
        job.path.parent.mkdir(exist_ok=True)
        job.path.write_text(json.dumps({"stored": [{"environment": "acrobot", "kinds": kinds}]}))
    (section,) = report.make(made, plan.look_all(made), {}, NO_RATES).sections
    assert section.verdict == "does not hold" and section.explanation == "Not asked: the rest."
    first = str(section.reasons[0])
    assert first == "max's variance and errors correlated by rank: holds (in 1 of 1 fits; the lowest is 0.2)"


def test_runs_of_one_cell_may_differ_in_their_seed_alone(tmp_path: Path):
    made = plan.make([figure("a", (cell("implicit"),))], "laptop", tmp_path / "out")
    first, second = made.jobs.values()
    assert second.spec is not None
    changed = dataclasses.replace(second.spec, config=dataclasses.replace(second.spec.config, obs_noise=0.5))
    paths = [finish(first), finish(second._replace(spec=changed))]
    members = [report.Member(load(path), (seed,)) for seed, path in enumerate(paths)]
    with pytest.raises(RunError, match=re.escape("obs_noise: 0.0 -> 0.5. Allowed: runs that differ in their seed")):
        report.measured(cell("implicit"), COVERAGE, members)
    with pytest.raises(RunError, match="a seed comes twice"):
        report.measured(cell("implicit"), COVERAGE, [members[0], members[0]])
    # When a run was saved and looked at is no difference.
    alike = dataclasses.replace(second.spec.config, checkpoint_every=7, preset="smoke")
    path = write(dataclasses.replace(second.spec, config=alike), tmp_path / "alike")
    line = report.measured(cell("implicit"), COVERAGE, [members[0], report.Member(load(path), (1,))])
    assert line is not None and line.series.seeds == (0, 1)
