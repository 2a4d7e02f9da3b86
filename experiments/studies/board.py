"""What a plan prints while it is carried out: a table of all that runs on a terminal, plain lines elsewhere."""

import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TextIO

from experiments.analysis.tables import duration
from experiments.studies.display import Screen
from experiments.studies.estimates import Rates, seconds_left
from experiments.studies.plan import Plan, Standing, State

RECENT = 20
"""Looks at a run that its pace is taken from."""
EVERY = 60.0
"""Seconds between two lines about all, where lines are not drawn over."""


class Board(Screen):
    """How far a plan is, on stderr.

    Args:
        plan: what is carried out.
        rates: what steps took in runs of before.
        at_a_time: how many run at once, at most.
        stream: where to write, stderr by default.
        live: whether lines are drawn over; by default, whether `stream` is a terminal that can do that.
    """

    def __init__(
        self, plan: Plan, rates: Rates, at_a_time: int, *, stream: TextIO | None = None, live: bool | None = None
    ) -> None:
        super().__init__(stream, live)
        self._plan, self._rates, self._at_a_time = plan, rates, at_a_time
        self._recent: dict[str, deque[tuple[float, int]]] = {}
        self._told: set[str] = set()
        self._last = float("-inf")
        self._first = True

    def again(self, key: str, why: str) -> None:
        """Says that a job's worker was lost, and that the job is not."""
        self.say(f"{self._plan.jobs[key].name}: {why.rstrip('.')}; it goes on from its latest checkpoint")

    def update(
        self, standings: Mapping[str, Standing], working: Sequence[str], failed: Mapping[str, str], waiting: int
    ) -> None:
        """Shows where all is: where each job stands, who is at work, who failed and why, how many wait."""
        jobs = self._plan.jobs
        for key, one in standings.items():
            ended = one.state is State.FINISHED or key in failed
            if ended and key not in self._told:
                self._told.add(key)
                if not self._first or key in failed:
                    self.say(f"{jobs[key].name} " + (f"failed: {failed[key]}" if key in failed else "is done"))
        self._first = False
        for key in working:
            seen = self._recent.setdefault(key, deque(maxlen=RECENT))
            if not seen or seen[-1][1] != standings[key].step:
                seen.append((time.monotonic(), standings[key].step))
        if self.live:
            width = max((len(jobs[key].name) for key in working), default=0)
            self.draw([*(self._line(key, standings[key], width) for key in working), self._all(standings, working)])
        elif time.monotonic() - self._last > EVERY:
            self._last = time.monotonic()
            self.say(self._all(standings, working))

    def _line(self, key: str, standing: Standing, width: int) -> str:
        spec, left = self._plan.jobs[key].spec, self._left(key, standing)
        head = self._plan.jobs[key].name.ljust(width)
        if spec is None:
            return f"{head}  at work"
        steps = spec.config.steps
        text = f"{head}  {100 * standing.step / steps:3.0f}% | {standing.step:>{len(f'{steps:,}')},}/{steps:,}"
        return text if left is None else f"{text}  {duration(left)} left"

    def _left(self, key: str, standing: Standing) -> float | None:
        """Seconds: by the job's own pace, or by that of runs of before; None: nothing tells."""
        seen, job = self._recent.get(key, ()), self._plan.jobs[key]
        if job.spec is not None and len(seen) > 2 and seen[-1][1] > seen[1][1]:
            # From the second look on: the first round waits for the compiler.
            pace = (seen[-1][0] - seen[1][0]) / (seen[-1][1] - seen[1][1])
            return pace * (job.spec.config.steps - standing.step)
        return seconds_left(job, standing, self._rates)

    def _all(self, standings: Mapping[str, Standing], working: Sequence[str]) -> str:
        done = sum(one.state is State.FINISHED for one in standings.values())
        text = f"{done} of {len(standings)} runs done, {len(working)} at work"
        failures = len(self._told) - done
        if failures:
            text += f", {failures} failed"
        open_ones = [key for key, one in standings.items() if one.state is not State.FINISHED and key not in self._told]
        left = [self._left(key, standings[key]) for key in open_ones]
        known = [one for one in left if one is not None]
        if known:
            at_a_time = min(self._at_a_time, max(1, len(open_ones)))
            least = "at least " if len(known) < len(left) else ""
            text += f"; {least}{duration(sum(known) / at_a_time)} left"
        return text
