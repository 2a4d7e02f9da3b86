"""`python -m experiments.paper [FIGURE ...]`: the paper's figures and its table, from the runs to the page.

Each run is made once, however many figures need it. What is finished stays, what is not resumes: the same command goes
on where it was stopped, and ends with the same report.
"""

import argparse
import contextlib
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import jax

from experiments import process, runtime
from experiments.analysis import page
from experiments.runs import lock, modules
from experiments.runs.config import PRESETS
from experiments.runs.errors import RunError, disk_error
from experiments.studies import conduct, estimates, executors, figures_of_paper, plan, report, watch
from experiments.studies.board import Board
from experiments.studies.estimates import Rates
from experiments.studies.found import runs_in
from experiments.studies.plan import Plan, Standing, State
from jaxplore import validate
from jaxplore.validate import FieldError

PROGRAM = "python -m experiments.paper"
KEPT = Path(__file__).parent / "results" / "runs"
"""Runs that come with the project; seeds of theirs whose settings are those of the plan count as done."""

LINGER = 5.0
"""Seconds that a page which loads itself has to do so for the last time."""


class _Arguments(NamedTuple):
    """What was asked for, checked."""

    names: tuple[str, ...]
    preset: str
    executor: str
    out: Path
    places: list[Path]
    every: float
    words: tuple[str, ...]
    """Flags for the commands that the report shows."""


def main(argv: Sequence[str] | None = None) -> int:
    """Carry out a plan and write its report.

    Returns:
        The exit status: 0, 1 (a run failed or diverged, or the disk), 2 (bad input), 130 or 143 (stopped).
    """
    parser = _parser()
    parsed = parser.parse_args(argv)
    again = f"{PROGRAM} {shlex.join(sys.argv[1:] if argv is None else argv)}".rstrip()
    try:
        try:
            modules.load(parsed.imports)
            asked = _check(parsed)
            runtime.share_device()
            plan.check_out(asked.out, asked.preset)
            made, standings = _plan(asked)
            rates = _rates(asked, made)
            if parsed.dry_run:
                print(estimates.describe(made, standings, rates, _at_a_time(asked, made, standings)))
                return 0
            if parsed.report:
                _check_any(made, standings)
            else:
                estimates.check_disk(made, standings)
            executor = None if parsed.report else _executor(asked, made, standings)
        except (ValueError, RunError) as error:
            print(f"error: {error}", file=sys.stderr)
            process.show_cause(error, debug=parsed.debug)
            return 2
        with lock.claimed(asked.out):
            made, standings = _plan(asked)  # Whoever had the directory until now has gone on.
            if executor is None:
                return _only_report(asked, made, standings, rates)
            return _carry_out(asked, made, standings, rates, executor, parsed.watch, parsed.port)
    except (ValueError, RunError) as error:
        print(f"\nerror: {error}", file=sys.stderr)
        process.show_cause(error, debug=parsed.debug)
        return 1
    except KeyboardInterrupt as stop:
        print(f"\nStopped. To go on: {again}", file=sys.stderr)
        return process.status_of(stop)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=PROGRAM, description=__doc__, allow_abbrev=False)
    known = ", ".join(figures_of_paper.figures())
    parser.add_argument("names", nargs="*", metavar="FIGURE", help=f"which (default: all): {known}")
    parser.add_argument("--preset", default="laptop", help="laptop (default), paper, or smoke: minutes, shows it runs")
    parser.add_argument("--executor", default="local", help="local (default), slurm or ray: who carries out the runs")
    parser.add_argument("--out", type=Path, help="directory of the runs and the page (default: runs/paper-PRESET)")
    parser.add_argument(
        "--runs",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="a directory of runs: finished ones whose settings are those of the plan count, too",
    )
    parser.add_argument("--dry-run", action="store_true", help="print the plan with its time and memory, and stop")
    parser.add_argument("--report", action="store_true", help="only write the page, of what is finished by now")
    parser.add_argument("--watch", action="store_true", help="serve the page on this machine while the plan runs")
    parser.add_argument("--port", type=int, default=0, help="of --watch (default: a free one)")
    parser.add_argument("--every", type=float, default=60.0, help="seconds between two pages of --watch (default: 60)")
    modules.add_flag(parser)
    process.add_flag(parser)
    return parser


def _check(parsed: argparse.Namespace) -> _Arguments:
    try:
        validate.one_of("preset", parsed.preset, PRESETS)
        validate.one_of("executor", parsed.executor, executors.NAMES)
        figures_of_paper.choose(tuple(parsed.names))
        validate.in_range("every", parsed.every, 0.0, open_low=True)
        if not 0 <= parsed.port < 2**16:
            raise FieldError("port", parsed.port, "a whole number, 0 to 65535", "is out of range")
        for place in parsed.runs:
            if not place.is_dir():
                raise FieldError("runs", str(place), "a directory of runs", "is none")
    except FieldError as error:
        raise ValueError(error.spell("FIGURE" if error.field == "figure" else f"--{error.field}")) from error
    out = parsed.out or Path("runs") / f"paper-{parsed.preset}"
    words = [f"--out={parsed.out}"] if parsed.out else []
    words += [f"--executor={parsed.executor}"] if parsed.executor != "local" else []
    words += [*(f"--runs={place}" for place in parsed.runs), *(f"--import={name}" for name in parsed.imports)]
    words += ["--report"] if parsed.report else []
    names, places = tuple(parsed.names), [*parsed.runs, KEPT]
    return _Arguments(names, parsed.preset, parsed.executor, out, places, parsed.every, tuple(words))


def _plan(asked: _Arguments) -> tuple[Plan, dict[str, Standing]]:
    """What there is to do, and where it stands by now."""
    made = plan.make(figures_of_paper.choose(asked.names), asked.preset, asked.out, asked.places)
    return made, plan.look_all(made)


def _rates(asked: _Arguments, made: Plan) -> Rates:
    return estimates.rates(runs_in([*asked.places, made.out / plan.RUNS]), made)


def _memory(made: Plan, standings: Mapping[str, Standing]) -> int:
    """Bytes that the largest job needs."""
    return max((estimates.size(job).memory for job in plan.open_jobs(made, standings)), default=1)


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def _at_a_time(asked: _Arguments, made: Plan, standings: Mapping[str, Standing]) -> int | None:
    """How many jobs go side by side; of a cluster, which is not asked for a plan alone, nobody knows."""
    return executors.fitting(_memory(made, standings), on_cpu=_on_cpu()) if asked.executor == "local" else None


def _executor(asked: _Arguments, made: Plan, standings: Mapping[str, Standing]) -> conduct.Executor:
    variables, memory = _quick() if asked.preset == "smoke" else {}, _memory(made, standings)
    return executors.make(asked.executor, made.out / "workers", memory, variables=variables, on_cpu=_on_cpu())


def _quick() -> dict[str, str]:
    """Variables that have XLA compile in half the time: programs of the smoke preset run for moments."""
    found = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    # A flag that XLA does not know ends the process, so only the versions that are known to have it get it.
    if version("jaxlib").startswith("0.10."):
        found["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false"
    return found


def _check_any(made: Plan, standings: Mapping[str, Standing]) -> None:
    if not any(one.state is State.FINISHED for one in standings.values()):
        raise ValueError(f"--report: no run of these figures is finished in --out={made.out}. Leave --report out.")


def _only_report(asked: _Arguments, made: Plan, standings: Mapping[str, Standing], rates: Rates) -> int:
    plan.write_record(made)
    print(_summary(_write(asked, made, standings, {}, rates), made))
    return 0


def _write(
    asked: _Arguments,
    made: Plan,
    standings: Mapping[str, Standing],
    failed: Mapping[str, str],
    rates: Rates,
    refresh: float | None = None,
) -> page.Report:
    found = report.make(made, standings, failed, rates, asked.words)
    try:
        page.write(found, made.out, refresh)
    except OSError as error:
        raise disk_error("write the report", made.out, error, "start it again") from error
    return found


def _summary(found: page.Report, made: Plan) -> str:
    width = max(len(one.name) for one in found.sections)
    lines = [f"{one.name.ljust(width)}  {one.verdict}" for one in found.sections]
    return "\n".join([*lines, "", f"written to {made.out / 'index.html'}"])


def _carry_out(
    asked: _Arguments,
    made: Plan,
    standings: Mapping[str, Standing],
    rates: Rates,
    executor: conduct.Executor,
    watched: bool,
    port: int,
) -> int:
    plan.write_settings(made, standings)
    board = Board(made, rates, executor.at_a_time)
    todo = plan.open_jobs(made, standings)
    board.say(
        f"{len(made.figures)} figures, preset {made.preset}: {len(made.jobs)} runs, {len(todo)} of them left, "
        f"{min(executor.at_a_time, max(1, len(todo)))} at a time by {executor.name}; writing to {made.out}"
    )
    last = [float("-inf")]

    def tell(now: Mapping[str, Standing], working: Sequence[str], failed: Mapping[str, str], waiting: int) -> None:
        board.update(now, working, failed, waiting)
        if watched and time.monotonic() - last[0] > asked.every:
            last[0] = time.monotonic()
            with contextlib.suppress(RunError, ValueError):  # of a run that is being written
                _write(asked, made, now, failed, rates, asked.every)

    with _served(made.out, port, board) if watched else contextlib.nullcontext():
        found = conduct.carry_out(made, standings, executor, tell, board.again)
        board.clear()
        written = _write(asked, made, found.standings, found.failed, rates)
        print(f"\n{_summary(written, made)}", flush=True)
        for key, why in found.failed.items():
            log = plan.log_of(made.jobs[key])
            see = f" (see {log})" if log.exists() else ""
            print(f"error: {made.jobs[key].name} is not finished: {why}{see}", file=sys.stderr)
        if watched:
            _stay(asked, board)
    return 1 if found.failed else 0


@contextlib.contextmanager
def _served(out: Path, port: int, board: Board) -> Iterator[None]:
    with watch.serve(out, port) as address:
        board.say(f"the report as it grows: {address}")
        yield


def _stay(asked: _Arguments, board: Board) -> None:
    """Go on serving what is finished: on a terminal until Ctrl-C, elsewhere until an open page has loaded itself."""
    person = sys.stdin is not None and sys.stdin.isatty()
    seconds = asked.every + LINGER
    board.say(f"The report is finished, and served {'until Ctrl-C' if person else f'for {seconds:.0f} s more'}.")
    with contextlib.suppress(KeyboardInterrupt):
        time.sleep(seconds)
        while person:
            time.sleep(1.0)


if __name__ == "__main__":
    process.carry_out(main)
