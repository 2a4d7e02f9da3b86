"""The jobs of a plan, carried out by whatever executor there is: each once, and parents before their children."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from experiments import process
from experiments.runs.errors import RunError
from experiments.studies import execute, plan
from experiments.studies.execute import End
from experiments.studies.plan import Job, Plan, Standing, State

TRIES = 3
"""How often a job is started that ends from outside without having come any further."""
LOST = -9
"""The status of a job whose worker went away with it: as after SIGKILL."""


class Executor(NamedTuple):
    """Starts jobs and says how they ended."""

    name: str
    at_a_time: int
    start: Callable[[Job], Any]
    """Start a job, or go on with it; gives a handle."""
    poll: Callable[[Any], End | None]
    """How the job of a handle ended; None: it has not."""
    stop: Callable[[Sequence[Any]], None]
    """Stop jobs, and wait until they have."""


class Outcome(NamedTuple):
    """What became of a plan."""

    standings: dict[str, Standing]
    failed: dict[str, str]
    """Key -> why it is not finished."""


Tell = Callable[[Mapping[str, Standing], Sequence[str], Mapping[str, str], int], Any]
"""`(standings, keys of those at work, those that failed and why, seconds since the start)`."""

Again = Callable[[str, str], Any]
"""`(key, why it ended from outside)` of a job that is about to be started again."""


def carry_out(
    plan_: Plan,
    standings: Mapping[str, Standing],
    executor: Executor,
    tell: Tell,
    again: Again = lambda key, why: None,
) -> Outcome:
    """Carry out what is not finished.

    A job that ends from outside (its worker was killed, its machine went away) is started again and resumes from its
    latest checkpoint; one that ends by its own error is not. A job whose parent fails is left out. One that fails
    leaves the others alone.

    What interrupts this stops all that is at work before it goes on.

    Args:
        plan_: what there is to do.
        standings: where each job stands.
        executor: who does it.
        tell: called time and again.
        again: called for each job that its worker lost.

    Raises:
        RunError: a directory cannot be read any more.
    """
    now, failed = dict(standings), {key: one.reason for key, one in standings.items() if one.state is State.DIVERGED}
    waiting = [key for key, one in now.items() if one.state in (State.TO_DO, State.PARTIAL)]
    working, tries = dict[str, Any](), dict[str, int]()
    try:
        while waiting or working:
            for key in [key for key in waiting if plan_.jobs[key].parent in failed]:
                waiting.remove(key)
                failed[key] = f"{plan_.jobs[str(plan_.jobs[key].parent)].name}, which it starts from, is not finished"
            ready = (key for key in waiting if _is_ready(plan_.jobs[key], now))
            for key in list(ready):
                if len(working) >= executor.at_a_time:
                    break
                job = plan_.jobs[key]
                # Processes of before stop by themselves once whoever started them is gone, and own it until then.
                if not plan.is_free(job):
                    continue
                waiting.remove(key)
                try:
                    working[key] = executor.start(job)
                except (OSError, RunError, ValueError) as error:
                    failed[key] = str(error)
            tell(now, list(working), failed, len(waiting))
            time.sleep(execute.POLL)
            for key, handle in list(working.items()):
                end = executor.poll(handle)
                if end is None:
                    now[key] = now[key]._replace(step=max(now[key].step, plan.step_of(plan_.jobs[key])))
                    continue
                del working[key]
                before, now[key] = now[key], plan.look(plan_.jobs[key])
                why = _after(now[key], end)
                if why is None:
                    if now[key].state is not State.FINISHED:
                        tries[key] = 1 if now[key].step > before.step else tries.get(key, 0) + 1
                        if tries[key] < TRIES:
                            waiting.insert(0, key)
                            again(key, end.error or "it ended from outside")
                        else:
                            failed[key] = end.error or "it ended from outside, time and again"
                    continue
                failed[key] = why
        tell(now, [], failed, 0)
    finally:
        if working:
            executor.stop(list(working.values()))
    return Outcome(now, failed)


def _is_ready(job: Job, now: Mapping[str, Standing]) -> bool:
    return job.parent is None or now[job.parent].state is State.FINISHED


def _after(standing: Standing, end: End) -> str | None:
    """Why a job that ended failed for good; None: it did not."""
    if standing.state is State.FINISHED:
        return None
    if standing.state is State.DIVERGED:
        return standing.reason
    outside = end.status < 0 or end.status in (process.INTERRUPTED, process.TERMINATED)
    taken = end.error is not None and "belongs to process" in end.error
    if outside or taken:
        return None
    return end.error or "it ended without having finished"
