"""Our kernels beside other libraries', in one process, in turn, on one core: `python -m benchmarks.run --only=peers`.

The other libraries are an extra, `pip install -e ".[peers]"`: nothing else needs them.
"""

import importlib.util
import os
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from benchmarks.peers import ensemble, sac, search, vector
from benchmarks.peers.common import Line

EXTRA = 'pip install -e ".[peers]"'


class Peer(NamedTuple):
    """A library that is compared with."""

    name: str
    package: str
    """What pip calls it."""
    module: str
    """What Python calls it."""
    lines: Callable[[], Iterator[Line]]


PEERS = (
    Peer("SBX", "sbx-rl", "sbx", sac.sbx_lines),
    Peer("Stable-Baselines3", "stable-baselines3", "stable_baselines3", sac.sb3_lines),
    Peer("PyTorch", "torch", "torch", ensemble.lines),
    Peer("mctx", "mctx", "mctx", search.lines),
    Peer("Gymnasium", "gymnasium", "gymnasium", vector.lines),
)
REQUIRED = "gymnasium"
"""Which is there whether the extra is or not."""


def present() -> tuple[Peer, ...]:
    """The peers that are installed."""
    return tuple(peer for peer in PEERS if importlib.util.find_spec(peer.module) is not None)


def missing_message(there: tuple[Peer, ...]) -> str | None:
    """What to say of the peers that are not `there`, in one line; None if all are."""
    missing = [peer.package for peer in PEERS if peer not in there]
    return f"peers not installed: {', '.join(missing)}. What to do: {EXTRA}." if missing else None


def any_of_extra(there: tuple[Peer, ...]) -> bool:
    """Whether there is a peer that the extra brings."""
    return any(peer.package != REQUIRED for peer in there)


def peers(there: tuple[Peer, ...]) -> Iterator[Line]:
    """Every line of the table of peers."""
    for peer in there:
        yield from peer.lines()


def peer_versions(there: tuple[Peer, ...]) -> dict[str, str]:
    """Versions of the peers."""
    return {peer.package: metadata.version(peer.package) for peer in there}


def stay_on_one_core() -> list[int] | None:
    """Keep this process and those that it starts on one of its processors, where Linux can; which, or None.

    How many threads a library starts is its own affair; none of them can take a second core.
    """
    tasks = Path("/proc/self/task")
    if not hasattr(os, "sched_setaffinity") or not tasks.is_dir():
        return None
    one = {max(os.sched_getaffinity(0))}
    for task in tasks.iterdir():  # Those that are there already do not follow the process.
        os.sched_setaffinity(int(task.name), one)
    return sorted(one)
