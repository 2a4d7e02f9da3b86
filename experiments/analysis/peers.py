"""Whole runs of other libraries, as `benchmarks.peers.returns` writes them, to hold beside ours."""

import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.analysis.statistics import Returns
from experiments.runs.errors import RunError
from experiments.runs.files import read_json

OURS = {"HalfCheetah-v5": "half_cheetah_task"}
"""Environments of Gymnasium's that are also ours: its name and ours."""


class Peer(NamedTuple):
    """One run of another library."""

    path: Path
    library: str
    version: str
    environment: str
    """As Gymnasium calls it."""
    seed: int
    warm_up_steps: int
    steps: tuple[int, ...]
    """Of the evaluations."""
    returns: tuple[float, ...]
    """Mean return of each evaluation."""


def read(path: Path) -> Peer:
    """A run of another library from its file.

    Raises:
        RunError: it cannot be read, or holds something else.
    """
    try:
        data = read_json(path)
        rows = data["rows"]
        who = {name: _typed(data, name, str) for name in ("library", "version", "environment")}
        who |= {name: _typed(data, name, int) for name in ("seed", "warm_up_steps")}
        steps = tuple(_typed(row, "env_steps", int) for row in rows)
        found = Peer(path, **who, steps=steps, returns=tuple(float(_typed(row, "return", int, float)) for row in rows))
        _check(found)
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else getattr(error, "strerror", None) or error
        raise RunError(
            f"{path} holds no run of another library ({reason}). What to do: give a file that "
            "`python -m benchmarks.peers.returns --out=FILE.json` wrote, or the directory of a run."
        ) from error
    return found


def _typed(data: Mapping[str, Any], name: str, *kinds: type) -> Any:
    if type(data[name]) not in kinds:
        raise ValueError(f"{name} is {data[name]!r}")
    return data[name]


def _check(peer: Peer) -> None:
    """Raise `ValueError` for what is no curve."""
    if not peer.library:
        raise ValueError("library is ''")
    if not peer.steps:
        raise ValueError("it has no rows")
    if any(later <= sooner for sooner, later in zip((0, *peer.steps), peer.steps, strict=False)):
        raise ValueError("env_steps do not rise from row to row")
    if not all(map(math.isfinite, peer.returns)):
        raise ValueError("a return is not finite")


def group(peers: Sequence[tuple[str | None, Path]], env: str, steps: int) -> dict[str, list[Peer]]:
    """The first `steps` steps of other libraries' runs, by name, in the order in which the names come.

    Args:
        peers: of each what it counts under, None being its library, and its file.
        env: where the runs that they are held beside took place.
        steps: how long these are.

    Raises:
        RunError: a file is damaged, of another environment, shorter, or without an evaluation by then; or a seed of a
            library comes twice.
    """
    groups: dict[str, list[Peer]] = {}
    for name, path in peers:
        peer = read(path)
        fitting = [f"gymnasium:{peer.environment}", *filter(None, [OURS.get(peer.environment)])]
        if env not in fitting:
            raise RunError(f"{path} is of {peer.environment}, and the runs of {env}. Allowed: {' or '.join(fitting)}.")
        if peer.steps[-1] < steps:
            last = peer.steps[-1]
            raise RunError(f"{path} ends at step {last}, before step {steps}. Compare with --until={last} or less.")
        count = sum(step <= steps for step in peer.steps)
        if not count:
            first = peer.steps[0]
            raise RunError(f"{path} was first evaluated at step {first}. Compare with --until={first} or more.")
        cut = peer._replace(steps=peer.steps[:count], returns=peer.returns[:count])
        groups.setdefault(name or peer.library, []).append(cut)
    for label, own in groups.items():
        seeds = [peer.seed for peer in own]
        if len(set(seeds)) < len(seeds):
            raise RunError(f"{label}: seed {statistics.mode(seeds)} comes twice. Give each once, or NAME=FILE.")
    return groups


def returns_of(label: str, peers: Sequence[Peer]) -> Returns:
    """Their evaluations on common steps, straight lines between them."""
    first, last = max(peer.steps[0] for peer in peers), min(peer.steps[-1] for peer in peers)
    steps = np.unique(np.concatenate([peer.steps for peer in peers]))
    steps = steps[(steps >= first) & (steps <= last)]
    values = np.stack([np.interp(steps, peer.steps, peer.returns) for peer in peers])
    return Returns(label, tuple(peer.seed for peer in peers), steps, values)
