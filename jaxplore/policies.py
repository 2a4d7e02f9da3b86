"""The policy of a finished run, to act with."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxplore.experiments.training.policy import Policy  # pyright: ignore[reportMissingImports]


def load_policy(run: str | os.PathLike[str], *, step: int | None = None, seed: int | None = None) -> Policy:
    """The policy that a run has learned, as its latest checkpoint holds it.

    It acts in every kind of loop. In Gymnasium's, `policy.act(obs)` takes and gives what the environment does, NumPy
    arrays or choices. In Brax's and any other in JAX, `policy.act_jax(key, obs)` is a pure function to jit, vmap and
    scan. Stable-Baselines3's `evaluate_policy(policy, env)` takes it for a model: it has `predict`.

    Loading builds the run's environment and agent, so it takes what they take, and sets two of JAX's switches for CPUs,
    as the command lines do.

    Args:
        run: the run's directory.
        step: the latest checkpoint up to this step; None: the latest.
        seed: which of the run's seeds; None: its first.

    Returns:
        A `Policy`. One of a method that has none, `random`, acts uniformly.

    Raises:
        RunError: there is no run, no checkpoint, or one that is damaged; or the run needs a module that has not been
            imported.
        ValueError: `seed` is none of the run's, or its environment cannot be built here.

    Example:
        >>> load_policy("runs/none")  # doctest: +IGNORE_EXCEPTION_DETAIL
        Traceback (most recent call last):
        RunError: runs/none holds no run (no config.json). Give the --out of a run.
    """
    # The library knows nothing of runs before this is called.
    return importlib.import_module("jaxplore.experiments.training.policy").load(run, step=step, seed=seed)
