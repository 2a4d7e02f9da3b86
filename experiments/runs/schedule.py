"""When the rounds of a run end, and whether its rows are all there."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from experiments.runs.config import RunConfig


def rounds(config: RunConfig, start: int) -> Iterator[tuple[int, int]]:
    """The steps `(first, end)` of each round from `start` on: at most `steps_per_round` long, ending with the warm-up,
    then at each multiple of `steps_per_round`, and with the run.
    """
    length, warm_up = config.explorer.steps_per_round, config.explorer.warm_up_steps
    while start < config.steps:
        end = min(warm_up, start + length) if start < warm_up else (start // length + 1) * length
        end = min(end, config.steps)
        yield start, end
        start = end


def on_schedule(config: RunConfig, steps: Sequence[int]) -> int | None:
    """The last of `steps` at which a round ends; None: there is none.

    A run that ended between two rounds' ends, and is then made longer, continues from before its last round: it is to
    be the run that was as long from the start.
    """
    ends = {end for _, end in rounds(config, 0)}
    return max((step for step in steps if step in ends), default=None)


def due(every: int, first: int, end: int, steps: int) -> bool:
    """Whether what happens every so many steps, and at the end of a run, happens at the end of a round. 0: never."""
    return every > 0 and (end // every > first // every or end == steps)


def gap(config: RunConfig, rows: Sequence[Mapping[str, Any]], until: int) -> tuple[int, str] | None:
    """Where the rows of a run are not as it wrote them: one for each round and seed, a seed's last the one that says
    that it diverged.

    Args:
        config: the run's.
        rows: as they were read.
        until: the step up to which they are looked at.

    Returns:
        The last step before the damage and what is wrong, or None.
    """
    wanted = [end for _, end in rounds(config, 0) if end <= until]
    seeds = range(config.seed, config.seed + config.num_seeds)
    own: dict[Any, list[Mapping[str, Any]]] = {seed: [] for seed in seeds}
    for row in rows:
        if row["step"] <= until:
            own.setdefault(row.get("seed"), []).append(row)
    found = [damage for seed, there in own.items() if (damage := _damage(seed, there, wanted, seed in seeds))]
    return min(found) if found else None


def _damage(seed: Any, rows: Sequence[Mapping[str, Any]], wanted: Sequence[int], known: bool) -> tuple[int, str] | None:
    if not known:
        return 0, f"has rows of seed {seed!r}, which the run does not have"
    steps = [row["step"] for row in rows]
    whole = next((i for i, pair in enumerate(zip(steps, wanted, strict=False)) if pair[0] != pair[1]), None)
    if whole is None and (len(steps) == len(wanted) or (rows and rows[-1].get("diverged"))):
        return None
    at = min(len(steps), len(wanted)) if whole is None else whole
    good = wanted[at - 1] if at else 0
    count = Counter(steps)
    missing = [step for step in wanted if step not in count]
    twice = sorted(step for step, num in count.items() if num > 1)
    parts = [f"lacks {_span(missing)}"] if missing else []
    parts += [f"has {_span(twice)} more than once"] if twice else []
    return good, f"{' and '.join(parts) or 'has rows that are out of order'} of seed {seed}"


def _span(steps: Sequence[int]) -> str:
    if len(steps) == 1:
        return f"the row of step {steps[0]:,}"
    return f"{len(steps):,} rows from step {steps[0]:,} to {steps[-1]:,}"
