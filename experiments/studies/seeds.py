"""Seeds of one configuration, each a run of its own in a process of its own: a core each, where one program would have
them share one.
"""

import dataclasses
import os
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax

from envs.base import Environment
from experiments import machine
from experiments.analysis import comparison, report
from experiments.analysis.load import scene_of
from experiments.analysis.tables import duration
from experiments.runs import lock
from experiments.runs.command import PROGRAM, CommandLine
from experiments.runs.config import RunConfig, check_room
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.metrics import Row, last_row
from experiments.runs.seeds import SeedRuns
from experiments.runs.spec import RunRef, RunSpec
from experiments.runs.status import Status
from experiments.studies.display import Display
from experiments.studies.execute import POLL, End, Job, run_all
from experiments.training import memory, parent
from experiments.training.programs import Programs, make_programs
from jaxplore.exploration import Explorer
from jaxplore.validate import FieldError

PROCESS = 3 * 2**29
"""Bytes of a process with everything imported, while it compiles: 1.4 to 1.5 GB were seen, whatever the preset."""
PER_STATE = 4
"""How often a run needs the size of its state: what a step of learning makes on the way is twice as large (laptop: 2.0,
paper: 2.1), and a checkpoint is a copy."""
UNWINDING = 60.0
"""Seconds to wait for processes of before, which were told to stop."""


class Plan(NamedTuple):
    """Several seeds, before anything is written."""

    spec: RunSpec
    """Of all."""
    new: list[RunSpec]
    """Of each that has no run yet."""
    processes: int
    """How many run at a time."""


def are_split(command: CommandLine, spec: RunSpec, env: Environment, *, is_command: bool) -> bool:
    """Whether each seed gets a process and a directory of its own.

    What is resumed stays as it was. Otherwise `--processes` decides, and without it what is quicker: in one program all
    seeds share the thread that steps an environment on the host. Seeds stay together, too, of which each
    continues another seed of a parent's program, and those of a function call: what a program has registered by hand,
    other processes do not know.

    Args:
        command: what was asked for.
        spec: the run.
        env: its environment.
        is_command: whether this process is the command line, and not a program that calls it.

    Raises:
        ValueError: processes are asked for where that cannot be, or a parent is several runs.
    """
    many = command.processes > 1 and spec.config.num_seeds > 1
    if command.resume and command.out is not None:
        if SeedRuns(command.out).exists():
            return True
        if RunDirectory(command.out).status() is not Status.ABSENT:
            if many:
                raise _refusal(command, f"the seeds in {command.out} share a program and a directory, and stay so")
            return False
    together = spec.parent is not None and _seeds_together(spec.parent)
    if many and together:
        raise _refusal(command, f"seeds that share a program in --parent={spec.parent} are continued side by side")
    split = is_command and not env.compiled and jax.devices()[0].platform == "cpu" and not together
    split = many if command.processes > 0 else split and spec.config.num_seeds > 1
    if spec.parent is not None and not split and not command.resume:
        _check_parent(spec.parent)
    return split


def _refusal(command: CommandLine, why: str) -> ValueError:
    return ValueError(f"--processes={command.processes} cannot be: {why}. Allowed: 1, or leave it out.")


def _seeds_together(ref: RunRef) -> bool:
    directory = RunDirectory(ref.directory)
    return directory.status() is not Status.ABSENT and directory.config().num_seeds > 1


def _check_parent(ref: RunRef) -> None:
    """One program has one parent."""
    found = SeedRuns(ref.directory)
    if found.exists():
        raise ValueError(
            f"--parent={ref} holds a run for each of several seeds. Allowed: one of them, such as "
            f"{found.run(found.seeds()[0])}, or --num-seeds and --processes of 2 or more, a process for each seed."
        )


def plan(command: CommandLine, spec: RunSpec, env: Environment, agent: Explorer) -> Plan:
    """What is to be run, checked as one run is checked: nothing is written.

    Raises:
        ValueError: a seed does not fit into memory, or the parent is refused.
        RunError: the parent cannot be read.
    """
    config = spec.config
    first = dataclasses.replace(config, num_seeds=1)
    memory.check_steps(first)
    programs = make_programs(first, env, agent)
    if not command.resume:
        check_room(first)
        memory.check_arrays(first, env, programs)
    there = SeedRuns(command.out) if command.resume and command.out is not None else None
    seeds = range(config.seed, config.seed + config.num_seeds)
    new = [seed for seed in seeds if there is None or there.run(seed).status() is Status.ABSENT]
    parents = dict.fromkeys(seeds, spec.parent)
    if spec.parent is not None and SeedRuns(spec.parent.directory).exists():
        refs = _parents(spec.parent, config)
        try:
            parents |= {seed: parent.resolve(refs[seed], env, agent, first) for seed in new}
        except FieldError as error:
            raise ValueError(error.spell("--parent")) from error
        if there is None:
            identity = SeedRuns(spec.parent.directory).spec().identity
            own = parents[config.seed] or spec.parent
            ref = dataclasses.replace(spec.parent, identity=identity, before=own.before)
            spec = dataclasses.replace(spec, parent=ref)
    runs = [RunSpec(dataclasses.replace(first, seed=seed), parents[seed], spec.imports) for seed in new]
    return Plan(spec, runs, min(command.processes or _at_a_time(programs), config.num_seeds))


def _at_a_time(programs: Programs) -> int:
    """How many processes the machine has cores and memory for; of another device than the CPU each would take all."""
    if jax.devices()[0].platform != "cpu":
        return 1
    state = jax.tree.leaves(programs.trace_init())
    # A key's dtype has no size in bytes that NumPy knows.
    need = PROCESS + PER_STATE * sum(leaf.size * getattr(leaf.dtype, "itemsize", 8) for leaf in state)
    return max(1, min(machine.cores(), machine.free_memory() // need))


def _parents(ref: RunRef, config: RunConfig) -> dict[int, RunRef]:
    """The parent of each seed: of several seeds' runs the one with the same place among them."""
    found = SeedRuns(ref.directory)
    runs = [str(found.run(seed)) for seed in found.seeds()]
    return {config.seed + i: RunRef(runs[i % len(runs)], ref.step) for i in range(config.num_seeds)}


def carry_out(plan: Plan, directory: SeedRuns, env: Environment, command: CommandLine) -> int:
    """Run what is not finished yet, and close with the tables of all; the exit status is 0, or 1 if a seed failed.

    Raises:
        RunError: the disk fails.
    """
    config, began = plan.spec.config, time.monotonic()
    directory.begin(plan.spec, plan.new)
    runs = {seed: directory.run(seed) for seed in directory.seeds()}
    todo = [seed for seed, run in runs.items() if _is_open(run, config)]
    at_a_time = min(plan.processes, len(todo))
    if todo:
        print(
            f"{config.method} on {config.env}: {config.preset} preset, seeds {min(runs)} to {max(runs)}, "
            f"{config.steps:,} steps\n"
            f"physics: {env.backend}, learning: {jax.devices()[0].device_kind}, a process for each seed, "
            f"{at_a_time} at a time\n"
            f"writing to {directory}",
            flush=True,
        )
        _run(plan, directory, todo, command, env.coverage.num_cells)
    else:
        print(f"The runs in {directory} have nothing left to do: drawing them again.", flush=True)
    finished = [run for run in runs.values() if run.status() is Status.FINISHED]
    if finished:
        took = f"{len(todo)} seeds, {at_a_time} at a time, took {duration(time.monotonic() - began)}" if todo else ""
        print(f"\n{_report(directory, finished, took)}", flush=True)
    return _close(plan, directory)


def _is_open(run: RunDirectory, config: RunConfig) -> bool:
    """Whether a seed has anything to do."""
    status = run.status()
    return status is Status.PARTIAL or (status is Status.FINISHED and run.config().steps < config.steps)


def _run(plan: Plan, directory: SeedRuns, todo: Sequence[int], command: CommandLine, num_cells: int) -> None:
    """Run seeds, and show how far they are."""
    logs = {seed: directory.run(seed).metrics_path for seed in directory.seeds()}
    display = Display(plan.spec.config, plan.processes, num_cells)
    before = {seed: row["step"] for seed, path in logs.items() if (row := last_row(path))}
    display.begin(before, [seed for seed in logs if seed not in todo])
    if command.resume:
        _wait_for([directory.run(seed) for seed in todo], display)
    display.say("Each process compiles its own programs: up to a minute the first time, seconds from the cache later")
    told: set[int] = set()

    def tell(running: Sequence[int], ended: Mapping[int, End]) -> None:
        for seed in [seed for seed in ended if seed not in told]:
            told.add(seed)
            display.end(seed, last_row(logs[seed]), ended[seed].error)
        display.update({seed: last_row(logs[seed]) for seed in running})

    words = ["-m", "experiments.run", "--resume", f"--steps={plan.spec.config.steps}"]
    words += [f"--import={name}" for name in plan.spec.imports]
    words += [f"--wandb={command.wandb}"] if command.wandb else []
    words += ["--debug"] if command.debug else []
    jobs = [Job(seed, [*words, f"--out={directory.run(seed)}"], directory.log(seed)) for seed in todo]
    # Weights & Biases shows a group's runs together; each is called by its own directory, `seed-0` and so on.
    group = os.environ.get("WANDB_RUN_GROUP") or directory.path.resolve().name
    run_all(jobs, plan.processes, tell, {"WANDB_RUN_GROUP": group})
    display.clear()


def _wait_for(runs: Sequence[RunDirectory], display: Display) -> None:
    """Wait for processes of before, which stop once whoever started them has been killed: they have these directories
    until then.
    """
    deadline, said = time.monotonic() + UNWINDING, False
    for run in runs:
        while time.monotonic() < deadline:
            try:
                with lock.claimed(run.path):
                    break
            except RunError as error:
                if not said:
                    display.say(f"Waiting: {str(error).partition('. ')[0]}")
                said = True
                time.sleep(POLL)


def _report(directory: SeedRuns, finished: Sequence[RunDirectory], took: str) -> str:
    """The table of a line per seed, what they took, and the tables and pictures of a comparison."""
    rows: list[Row] = [row for run in finished for row in run.rows()]
    scene = scene_of(finished[0])
    tables = comparison.write([run.path for run in finished], [None] * len(finished), directory.path)
    told = [took] if took else []
    return "\n\n".join(
        [report.summary(rows, scene.coverage), *told, tables, *report.hints(directory.path, rows, scene)]
    )


def _close(plan: Plan, directory: SeedRuns) -> int:
    """Name the seeds that are in no table; the exit status."""
    open_ones, diverged = [], []
    for seed in directory.seeds():
        run = directory.run(seed)
        status, row = run.status(), last_row(run.metrics_path) or {"step": 0}
        if status is Status.DIVERGED:
            diverged.append(f"seed {seed} diverged at step {row['step']:,} (not finite: {row.get('diverged')})")
        elif status is not Status.FINISHED:
            open_ones.append(f"seed {seed} stands at step {row['step']:,} (see {directory.log(seed)})")
    left = [*open_ones, *diverged]
    if not left:
        return 0
    words = shlex.join([f"--out={directory}", "--resume", *(f"--import={name}" for name in plan.spec.imports)])
    which = "those that did not diverge" if diverged else "them"
    again = (
        f"To continue {which}: {PROGRAM} {words}" if open_ones else "Start them with other settings in another --out."
    )
    count = len(directory.seeds())
    print(f"\nerror: {len(left)} of {count} seeds are not in the tables: {'; '.join(left)}. {again}", file=sys.stderr)
    return 1
