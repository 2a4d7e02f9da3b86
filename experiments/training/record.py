"""What a round leaves in a run's state and in its rows; all of it NumPy, on the host."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.metrics import Row
from experiments.runs.spec import RunSpec
from experiments.training.programs import RunState


def broken(finite: Mapping[str, np.ndarray], alive: np.ndarray) -> list[list[str]]:
    """By seed the names of what is not finite; none of those that were not alive.

    Example:
        >>> import numpy as np
        >>> broken({"loss": np.array([True, False, False])}, np.array([True, True, False]))
        [[], ['loss'], []]
    """
    return [[name for name, good in finite.items() if was and not good[i]] for i, was in enumerate(alive)]


def steps_of_episodes(start: np.ndarray, done: np.ndarray) -> np.ndarray:
    """The step of its episode that each step was, `[S, T]`, from that of the first `[S]` and where episodes ended.

    Example:
        >>> import numpy as np
        >>> steps_of_episodes(np.array([7]), np.array([[False, True, False]]))
        array([[7, 8, 0]])
    """
    found, now = [], start
    for t in range(done.shape[1]):
        found.append(now)
        now = np.where(done[:, t], 0, now + 1)
    return np.stack(found, axis=1)


def walk(state: RunState, positions: np.ndarray, episode_steps: np.ndarray, span: tuple[int, int]) -> None:
    """Note where the steps of `span` began, `[S, T, 2]`, and which of their episodes they were, of seeds alive."""
    first, end = span
    state.positions[state.alive, first:end] = positions[state.alive]
    state.episode_steps[state.alive, first:end] = episode_steps[state.alive]


def episodes(state: RunState, reward: np.ndarray, done: np.ndarray) -> list[list[tuple[float, int]]]:
    """Return and length of each episode that ended, by seed, from rewards and ends `[S, T]`; of seeds alive.

    What the episode under way has earned so far is noted in the state. A reward that is not finite counts as 0.
    """
    found: list[list[tuple[float, int]]] = [[] for _ in state.alive]
    alive = state.alive
    reward = np.where(np.isfinite(reward), reward, 0.0)
    for t in range(reward.shape[1]):
        state.episode_return[alive] += reward[alive, t]
        state.episode_length[alive] += 1
        for i in np.flatnonzero(done[:, t] & alive):
            found[i].append((float(state.episode_return[i]), int(state.episode_length[i])))
            state.episode_return[i], state.episode_length[i] = 0.0, 0
    return found


def earned(ended: Sequence[tuple[float, int]]) -> dict[str, float]:
    """The fields of a row that say what the episodes earned which ended in the round; none where none did."""
    if not ended:
        return {}
    returns, lengths = zip(*ended, strict=True)
    return {"episode_return": float(np.mean(returns)), "episode_length": float(np.mean(lengths))}


def rows(
    first_seed: int, step: int, visited: np.ndarray, alive: np.ndarray, parts: tuple[Any, Any, Any, Any]
) -> list[Row]:
    """The round's rows, one for each seed that was alive in it.

    Args:
        first_seed: of the run.
        step: end of the round.
        visited: cells seen, bool `[S, cells]`.
        alive: whose rows there are, bool `[S]`.
        parts: by seed the fields of its own, metrics `[S]` by name, by seed the names of what was not finite, and the
            round's times.
    """
    own, metrics, broken_by_seed, times = parts
    found = []
    for i in np.flatnonzero(alive):
        cells = int(np.sum(visited[i]))
        row: dict[str, Any] = {"step": step, "seed": first_seed + int(i)}
        row |= {"coverage": cells / visited.shape[1], "cells": cells, **own[i]}
        row |= {name: values[i] for name, values in metrics.items()}
        if broken_by_seed[i]:
            row["diverged"] = ", ".join(broken_by_seed[i])
        found.append({**row, **times})
    return found


def meta(spec: RunSpec, step: int, wall_time: float) -> dict[str, Any]:
    """What a checkpoint says of itself: what resuming checks, and what it holds, for people who find it alone."""
    config = spec.config
    seeds = f"seed {config.seed}" if config.num_seeds == 1 else f"{config.num_seeds} seeds from {config.seed} on"
    return {
        "wall_time": wall_time,
        "identity": spec.identity,
        "steps": config.steps,
        "data_capacity": config.explorer.data_capacity,
        "holds": f"{config.method} on {config.env} after {step} steps, {seeds}",
        "parts": [field.name for field in dataclasses.fields(RunState)],
    }


def diverged_error(directory: RunDirectory, names: list[str], seeds: list[int], span: tuple[int, int]) -> RunError:
    """What to say of a round that no seed survived."""
    return RunError(
        f"the round of steps {span[0]:,} to {span[1]:,} came out with numbers that are not finite: {', '.join(names)} "
        f"(seed {', '.join(map(str, seeds))}). The state before it is saved in {directory.checkpoints().directory}. "
        "What to do: --resume would repeat this round to the bit, so start again in a new --out with a smaller "
        "learning rate, such as --fit.lr or --sac.lr, or with --imagination.bound set."
    )


MANY_DEAD = 0.5
"""Share of the generator's features without effect from which on the console says so."""
FEW_WITHIN = 0.05
"""Share of the variance among networks of one generator below which the console says so."""


def dying(rows: Sequence[Mapping[str, Any]]) -> str:
    """What to warn of where the generator is dying, so that its networks differ by little; empty where it is not."""
    dead = max((row.get("fit/dead_features", 0.0) for row in rows), default=0.0)
    if dead >= MANY_DEAD:
        return (
            f"warning: {dead:.0%} of the generator's features are the same for every z (fit/dead_features), so that "
            "its networks are nearly one. ReLU's, which the paper has, die; with --generator.activation=tanh and "
            "--svgd.batches=shared none do."
        )
    told = [row for row in rows if row.get("variance_within") is not None and row.get("variance")]
    shares = [row["variance_within"] / row["variance"] for row in told]
    if min(shares, default=1.0) < FEW_WITHIN:
        return (
            f"warning: networks of one generator make {min(shares):.1%} of the variance of all (variance_within), so "
            "that each generator stands for one network. With --svgd.batches=own nothing keeps them apart; with "
            "--svgd.batches=shared the repulsion of SVGD does, the more, the higher --svgd.temperature is."
        )
    return ""
