"""Who carries out jobs: processes of this machine, Slurm, or Ray.

All three start the same command, in a process that is held by the one that started it: a worker that is killed takes
its run with it, and the run resumes from its latest checkpoint wherever it is started again.
"""

import contextlib
import importlib
import os
import socket
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments import machine
from experiments.runs.errors import RunError
from experiments.studies import execute, plan
from experiments.studies.conduct import LOST, Executor
from experiments.studies.execute import End
from experiments.studies.plan import Job
from jaxplore import validate

NAMES = ("local", "slurm", "ray")
PATIENCE = 90.0
"""Seconds that a worker waits for a run that another one still owns."""
MINUTES = 24 * 60
"""Of a Slurm job; a run that does not get through in that time resumes in the next one."""
REACH = 10.0
"""Seconds in which a cluster must answer."""
ON_MACHINES = 1_000
"""Jobs at a time where a scheduler decides."""


def make(name: str, folder: Path, memory: int, *, variables: Mapping[str, str], on_cpu: bool) -> Executor:
    """The executor of a name; a cluster is asked whether it is there.

    Args:
        name: `local`, `slurm` or `ray`.
        folder: for what an executor itself writes.
        memory: bytes that the largest job needs.
        variables: of the jobs' environment, beside this process's.
        on_cpu: whether jobs compute on the CPU; on another device here they go one by one.

    Raises:
        FieldError: another name.
        RunError: its package is missing, or its cluster out of reach.
    """
    validate.one_of("executor", name, NAMES)
    if name == "local":
        return local(fitting(memory, on_cpu=on_cpu), variables)
    if name == "slurm":
        return slurm(folder, memory, variables)
    return ray(memory, variables)


def fitting(memory: int, *, on_cpu: bool) -> int:
    """How many jobs of so many bytes this machine has cores and memory for; on another device than the CPU one."""
    return max(1, min(machine.cores(), machine.free_memory() // memory)) if on_cpu else 1


def local(at_a_time: int, variables: Mapping[str, str]) -> Executor:
    """Processes of this machine, so many at a time."""

    def start(job: Job) -> execute.Process:
        return execute.start(execute.Job(0, plan.command(job), plan.log_of(job)), variables)

    def poll(one: execute.Process) -> End | None:
        return None if one.popen.poll() is None else execute.end(one)

    return Executor("local", at_a_time, start, poll, execute.stop)


class Work(NamedTuple):
    """A job for a worker elsewhere, which finds the same files."""

    job: Job
    variables: dict[str, str]


def work(task: Work) -> End:
    """What a worker does: start a job's command, or go on with it, and wait for its end."""
    deadline = time.monotonic() + PATIENCE
    while not plan.is_free(task.job) and time.monotonic() < deadline:
        time.sleep(execute.POLL)
    try:
        one = execute.start(execute.Job(0, plan.command(task.job), plan.log_of(task.job)), task.variables)
    except (OSError, RunError, ValueError) as error:
        return End(1, str(error))
    try:
        one.popen.wait()
    except BaseException:
        execute.stop([one])
        raise
    return execute.end(one)


def slurm(folder: Path, memory: int, variables: Mapping[str, str], cluster: str | None = None) -> Executor:
    """Jobs of Slurm, by `submitit`, as many as the cluster takes.

    Tried with Slurm 22.05 and its accounting, which submitit asks whether a job is still there: jobs cancelled by
    `scancel`, and jobs whose processes were killed, were submitted again and went on.

    Args:
        folder: where submitit writes; all machines must see it, and the runs.
        memory: bytes of a job.
        variables: of the jobs' environment.
        cluster: `local`: processes in Slurm's place, for tests. None: Slurm.

    Raises:
        RunError: the package is missing, there is no Slurm, or it does not answer.
    """
    submitit = _package("submitit", "slurm")
    try:
        if cluster is None:
            _ask_slurm()
        executor = submitit.AutoExecutor(folder=str(folder.resolve()), cluster=cluster or "slurm")
    except (RuntimeError, OSError, subprocess.TimeoutExpired) as error:
        raise RunError(
            f"--executor=slurm: {_line(error)}. What to do: start it where sbatch works, or --executor=local."
        ) from error
    executor.update_parameters(name="jaxplore", timeout_min=MINUTES, mem_gb=-(-memory // 2**30), cpus_per_task=1)

    def start(job: Job) -> Any:
        try:
            return executor.submit(work, Work(job, dict(variables)))
        except Exception as error:  # submitit's own, with what sbatch said.
            raise RunError(f"Slurm has not taken it: {_line(error)}") from error

    def poll(submitted: Any) -> End | None:
        try:
            if not submitted.done():
                return None
        except Exception:  # Slurm does not answer now; the job may well go on.
            return None
        try:
            return submitted.result()
        except Exception:  # submitit's own, one for each way in which a job can go away.
            return End(LOST, f"its Slurm job {submitted.job_id} went away ({submitted.state})")

    def stop(jobs: Sequence[Any]) -> None:
        for one in jobs:
            with contextlib.suppress(Exception):
                one.cancel()
        deadline = time.monotonic() + execute.GRACE
        while time.monotonic() < deadline and not all(one.done() for one in jobs):
            time.sleep(execute.POLL)

    return Executor("slurm", ON_MACHINES, start, poll, stop)


def _ask_slurm() -> None:
    """Raise unless Slurm's controller answers: `sbatch` may be there without one.

    Raises:
        RuntimeError: it does not; says what Slurm says.
        OSError: there is no Slurm.
        subprocess.TimeoutExpired: it takes too long.
    """
    asked = subprocess.run(["sinfo", "--noheader"], capture_output=True, text=True, timeout=REACH, check=False)
    if asked.returncode != 0:
        raise RuntimeError(asked.stderr.strip() or f"sinfo ended with status {asked.returncode}")


def ray(memory: int, variables: Mapping[str, str], address: str | None = None) -> Executor:
    """Tasks of a Ray cluster: the one at `RAY_ADDRESS`, or one of this machine's own.

    Args:
        memory: bytes of a job.
        variables: of the jobs' environment.
        address: of the cluster; None: as `RAY_ADDRESS` says.

    Raises:
        RunError: the package is missing, or the cluster out of reach.
    """
    package = _package("ray", "ray")
    address = address or os.environ.get("RAY_ADDRESS")
    try:
        _knock(address)
        if not package.is_initialized():
            # A job waits in a process of its own; what computes is the process that it starts.
            more = {} if address else {"num_cpus": machine.cores(), "include_dashboard": False}
            package.init(address=address, log_to_driver=False, logging_level="ERROR", **more)
    except Exception as error:  # ConnectionError, ValueError, and what is wrong with a local one.
        raise RunError(
            f"--executor=ray: no cluster at RAY_ADDRESS={address} ({_line(error)}). What to do: start one there, or "
            "leave RAY_ADDRESS unset for one on this machine."
        ) from error
    # A job that goes away is started again by whoever follows the plan, who knows how far it has come.
    task = package.remote(max_retries=0, num_cpus=1, memory=memory)(work)

    def start(job: Job) -> Any:
        return task.remote(Work(job, dict(variables)))

    def poll(ref: Any) -> End | None:
        if not package.wait([ref], timeout=0)[0]:
            return None
        try:
            return package.get(ref)
        except Exception as error:  # RayError, one for each way in which a worker can go away.
            return End(LOST, f"its worker went away ({_line(error)})")

    def stop(refs: Sequence[Any]) -> None:
        for ref in refs:
            with contextlib.suppress(Exception):
                package.cancel(ref, force=True)
        package.wait(list(refs), num_returns=len(refs), timeout=execute.GRACE)

    return Executor("ray", ON_MACHINES, start, poll, stop)


def _knock(address: str | None) -> None:
    """Raise `OSError` where nobody answers at an address; Ray itself asks for minutes."""
    host, _, port = (address or "").rpartition("://")[2].rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=REACH).close()


def _package(name: str, extra: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise RunError(
            f'--executor={extra} needs {name}. What to do: pip install -e ".[{extra}]", or --executor=local.'
        ) from error


def _line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
