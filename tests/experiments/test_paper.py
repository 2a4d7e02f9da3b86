"""The paper from one command: what it refuses, what it plans, and one small figure from the runs to the page."""

import contextlib
import dataclasses
import io
import json
import os
import re
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import NamedTuple

import pytest

from experiments import machine, paper
from experiments.analysis.pages.markdown import plain
from experiments.runs import lock
from experiments.runs.directory import RunDirectory
from experiments.runs.status import Status
from experiments.studies import estimates, figures_of_paper, plan
from experiments.studies.figures_of_paper import Cell
from tests.experiments.studies import by_hand
from tests.experiments.tiny import ROOT

STEPS = dict.fromkeys(("smoke", "laptop", "paper"), 100)
WARM_UP = {"explorer": {"warm_up_steps": 50}}


class Told(NamedTuple):
    status: int
    stdout: str
    stderr: str


def tell(*words: str) -> Told:
    stdout, stderr = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        try:
            status = paper.main(words)
        except SystemExit as stop:
            status = int(stop.code or 0)
    return Told(status, stdout.getvalue(), stderr.getvalue())


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> str:
    """The only figure: random actions in the acrobot, which compile in no time."""
    cells = tuple(
        Cell(label, "acrobot", "random", 2, STEPS, {**WARM_UP, "obs_noise": noise})
        for label, noise in (("still", 0.0), ("noisy", 0.1))
    )
    monkeypatch.setattr(figures_of_paper, "figures", lambda: {"small": by_hand.figure("small", cells)})
    monkeypatch.setattr(paper, "KEPT", Path("no such place"))
    return "small"


def test_one_figure_of_the_paper_from_its_run_to_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Figure 5, the quickest: one run. Figure 2 has five, and takes a minute."""
    monkeypatch.setattr(paper, "KEPT", Path("no such place"))
    out = tmp_path / "out"
    words = ("ant_visits", "--preset=smoke", f"--out={out}")
    planned = tell(*words, "--dry-run")
    assert planned.status == 0 and "1 runs, 0 of them finished" in planned.stdout
    assert not out.exists()
    first = tell(*words)
    assert first.status == 0, first.stderr
    assert re.search(r"ant_visits +(holds|does not hold)", first.stdout)
    (run,) = (out / plan.RUNS).iterdir()
    assert RunDirectory(run).status() is Status.FINISHED
    assert json.loads((run / "config.json").read_text())["num_seeds"] == 2
    text = (out / "report.md").read_text()
    assert "| implicit | 2: 0 to 1 |" in text and "Over five seeds our agent takes many ways" in text
    assert f"experiments.paper ant_visits --preset=smoke --out={out}\n" in text
    assert plain(machine.describe()) in text
    assert (out / "pictures" / "ant_visits.svg").is_file() and (out / "csv" / "ant_visits.csv").is_file()
    # Again, nothing is left to be done, and the run stays as it is.
    before = (run / "metrics.jsonl").read_bytes()
    again = tell(*words)
    assert again.status == 0 and "0 of them left" in again.stderr
    assert (run / "metrics.jsonl").read_bytes() == before
    assert "1 of them finished" in tell(*words, "--dry-run").stdout
    # A run that is there already is not made again.
    other = ("ant_visits", "--preset=smoke", f"--out={tmp_path / 'other'}", f"--runs={out / plan.RUNS}")
    assert "1 of them finished" in tell(*other, "--dry-run").stdout
    assert tell(*other).status == 0
    assert not list((tmp_path / "other" / plan.RUNS).iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["chian"], "FIGURE='chian' is not known. Did you mean 'chain'? Allowed: acrobot, "),
        (["chain", "--preset=labtop"], "--preset='labtop' is not known. Did you mean 'laptop'? Allowed: "),
        (["chain", "--executor=slrum"], "--executor='slrum' is not known. Did you mean 'slurm'? Allowed: "),
        (["chain", "--runs=nowhere"], "--runs='nowhere' is none. Allowed: a directory of runs."),
        (["chain", "--port=70000"], "--port=70000 is out of range. Allowed: a whole number, 0 to 65535."),
        (["chain", "--every=0"], "--every=0.0"),
        (["chain", "--import=no_such"], "--import=no_such: cannot import it"),
        (["chain", "--preset=smoke", "--report"], "--report: no run of these figures is finished in --out="),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    told = tell(*words)
    assert told.status == 2
    assert told.stderr.startswith(f"error: {message}") and told.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "package"), [("slurm", "submitit"), ("ray", "ray")])
def test_an_executor_without_its_package(
    name: str, package: str, small: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, package, None)
    told = tell(small, f"--executor={name}", f"--out={tmp_path / 'out'}")
    assert told.status == 2 and told.stderr.count("\n") == 1
    assert f'--executor={name} needs {package}. What to do: pip install -e ".[{name}]"' in told.stderr
    assert not (tmp_path / "out").exists()


def test_a_plan_larger_than_the_disk(small: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    usage = estimates.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(estimates.shutil, "disk_usage", lambda path: usage._replace(free=2**20))
    told = tell(small, f"--out={tmp_path / 'out'}")
    assert told.status == 2 and "GiB of disk at the most" in told.stderr and told.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_plan_tells_its_time_by_as_many_as_memory_allows(small: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (job, _) = plan.make([figures_of_paper.figures()[small]], "smoke", tmp_path / "out").jobs.values()
    assert job.spec is not None
    other = dataclasses.replace(job.spec, config=dataclasses.replace(job.spec.config, obs_noise=0.7))
    by_hand.write(other, tmp_path / "others" / "of its kind", pace=0.1)
    monkeypatch.setattr(paper.executors.machine, "cores", lambda: 8)
    words = (small, "--preset=smoke", f"--out={tmp_path / 'out'}", f"--runs={tmp_path / 'others'}", "--dry-run")
    # Two runs of two seeds of 100 steps, 0.05 s each.
    for memory, told in ((2**40, "2 at a time: 10 s"), (2**30, "1 at a time: 20 s")):
        monkeypatch.setattr(paper.executors.machine, "free_memory", lambda memory=memory: memory)
        assert f"left: 20 s of computing, {told}; up to " in tell(*words).stdout


def test_what_lies_there_is_not_overwritten(small: str, tmp_path: Path):
    (tmp_path / "index.html").write_text("mine")
    told = tell(small, f"--out={tmp_path}")
    assert told.status == 2 and "holds other files (index.html)" in told.stderr
    assert (tmp_path / "index.html").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


def test_a_second_planner_is_told_of_the_first(small: str, tmp_path: Path):
    with lock.claimed(tmp_path / "out"):
        told = tell(small, "--preset=smoke", f"--out={tmp_path / 'out'}")
    assert told.status == 1 and "belongs to process" in told.stderr


def test_only_the_report(small: str, tmp_path: Path):
    out = tmp_path / "out"
    figure = figures_of_paper.figures()[small]
    made = plan.make([figure], "smoke", out)
    plan.write_settings(made, plan.look_all(made))
    by_hand.finish(next(iter(made.jobs.values())))
    told = tell(small, "--preset=smoke", f"--out={out}", "--report")
    assert told.status == 0, told.stderr
    assert "| still |" in (out / "report.md").read_text()
    assert len(list((out / plan.RUNS).iterdir())) == 1


def test_the_report_alone_can_be_made_again_and_a_plan_after_it(small: str, tmp_path: Path):
    out, kept = tmp_path / "out", tmp_path / "kept"
    made = plan.make([figures_of_paper.figures()[small]], "smoke", tmp_path / "elsewhere")
    for job in made.jobs.values():
        by_hand.finish(job, path=kept / job.name)
    words = (small, "--preset=smoke", f"--out={out}", f"--runs={kept}")
    for more in (("--report",), ("--report",), ()):
        told = tell(*words, *more)
        assert told.status == 0, told.stderr
        assert "| still |" in (out / "report.md").read_text()
    with lock.claimed(out):
        told = tell(*words, "--report")
    assert told.status == 1 and "belongs to process" in told.stderr
    told = tell(small, "--preset=laptop", f"--out={out}", f"--runs={kept}", "--report")
    assert told.status == 2 and "holds the paper with preset=smoke" in told.stderr


def test_what_goes_wrong_with_runs_on_the_way_is_a_line(small: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def carry_out(*_):
        raise ValueError("config.json has been changed since it was written")

    monkeypatch.setattr(paper.conduct, "carry_out", carry_out)
    told = tell(small, "--preset=smoke", f"--out={tmp_path / 'out'}")
    assert told.status == 1 and told.stderr.endswith("error: config.json has been changed since it was written\n")


def test_a_damaged_run_that_was_kept_is_left_out(small: str, tmp_path: Path):
    kept = tmp_path / "kept"
    for job in plan.make([figures_of_paper.figures()[small]], "smoke", tmp_path / "out").jobs.values():
        by_hand.finish(job, path=kept / job.name)
    first = min(kept.iterdir())
    (first / "metrics.jsonl").write_text("{}\n")
    told = tell(small, "--preset=smoke", f"--out={tmp_path / 'out'}", f"--runs={kept}", "--report")
    assert told.status == 0, told.stderr
    text = (tmp_path / "out" / "report.md").read_text()
    assert text.count("is left out: line 1 of") == 1 and text.count("| 2: 0 to 1 |") == 1


def test_a_failed_run_is_an_error_and_the_rest_is_reported(small: str, tmp_path: Path):
    out = tmp_path / "out"
    made = plan.make([figures_of_paper.figures()[small]], "smoke", out)
    plan.write_settings(made, plan.look_all(made))
    first, second = made.jobs.values()
    by_hand.finish(first)
    second.path.mkdir()
    (second.path / "thesis.tex").write_text("")
    told = tell(small, "--preset=smoke", f"--out={out}")
    assert told.status == 1
    assert f"error: {second.name} is not finished: {second.path} holds other files than a run" in told.stderr
    assert "| still |" in (out / "report.md").read_text()


def test_watching_serves_the_page_while_the_plan_runs(small: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen, out = [], tmp_path / "out"
    made = plan.make([figures_of_paper.figures()[small]], "smoke", out)

    def carry_out(plan_, standings, executor, tell, again):
        for job in made.jobs.values():
            by_hand.finish(job)
            tell(plan.look_all(made), [], {}, 0)
            address = f"http://127.0.0.1:{ports[0]}/report.md"
            with urllib.request.urlopen(address) as answer:
                seen.append(answer.read().decode())
            growing.append((out / "index.html").read_text())
        return paper.conduct.Outcome(plan.look_all(made), {})

    ports, growing, ended = list[int](), list[str](), list[str]()
    serve = paper.watch.serve

    @contextlib.contextmanager
    def noting(directory: Path, port: int):
        with serve(directory, port) as address:
            ports.append(int(address.split(":")[2].split("/")[0]))
            yield address
            with urllib.request.urlopen(address) as answer:
                ended.append(answer.read().decode())

    monkeypatch.setattr(paper, "LINGER", 0.0)
    monkeypatch.setattr(paper.conduct, "carry_out", carry_out)
    monkeypatch.setattr(paper.watch, "serve", noting)
    told = tell(small, "--preset=smoke", f"--out={out}", "--watch", "--every=1e-9")
    assert told.status == 0, told.stderr
    assert f"http://127.0.0.1:{ports[0]}/index.html" in told.stderr
    assert "1 of 2 runs of these figures are finished" in seen[0] and "2 of 2 runs" in seen[1]
    # The finished page, which loads itself no more, is still served, for as long as an open one needs to come to it.
    assert "The report is finished, and served for 0 s more" in told.stderr
    assert 'data-refresh="' in growing[0] and len(ended) == 1 and 'data-refresh="' not in ended[0]


def test_whoever_watches_on_a_terminal_ends_it(small: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    out = tmp_path / "out"
    made = plan.make([figures_of_paper.figures()[small]], "smoke", out)
    plan.write_record(made)
    for job in made.jobs.values():
        by_hand.finish(job)
    waited: list[float] = []

    def sleep(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) > 200:
            raise KeyboardInterrupt

    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(paper.time, "sleep", sleep)
    told = tell(small, "--preset=smoke", f"--out={out}", "--watch", "--every=1")
    # Ctrl-C ends what is finished, and is no stop on the way.
    assert told.status == 0 and "served until Ctrl-C" in told.stderr and "To go on" not in told.stderr
    assert len(waited) == 201


@pytest.mark.slow
def test_the_whole_paper_with_the_smoke_preset(tmp_path: Path):
    command = [sys.executable, "-m", "experiments.paper", "--preset=smoke", f"--out={tmp_path / 'out'}"]
    # As a user's command: the tests' own switches for JAX are the same as the smoke preset's. Nothing is compiled yet.
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    began = time.monotonic()
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=3_600)
    minutes = (time.monotonic() - began) / 60
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "out" / "report.md").read_text()
    for name, figure in figures_of_paper.figures().items():
        assert figure.title in text and re.search(rf"(?m)^{name} +(holds|does not hold|undecided)$", done.stdout), name
    assert "not run" not in done.stdout
    print(f"{minutes:.1f} minutes without a compilation cache, on {machine.describe()}")
    assert minutes < 10 * max(1.0, 2 / machine.cores()), f"{minutes:.1f} minutes"
