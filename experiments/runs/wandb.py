"""The numbers of a run in Weights & Biases."""

import importlib
import secrets
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import read_text, write_text
from experiments.runs.metrics import Row, plain
from experiments.runs.rows import tensorboard_tag

STEP = "step"
"""The axis of all curves: environment steps."""


class WandbLog:
    """The numbers of a run in Weights & Biases, named and grouped as TensorBoard has them. See `TensorBoardLog`.

    What W&B itself reads from the environment holds: with `WANDB_MODE=offline` nothing leaves this machine, and
    `wandb sync` sends it later. A run that is resumed goes on in its own curves; rounds that are done again give the
    same points again.

    Args:
        directory: the run's own for W&B, `RUN/wandb`, which must be called so, as W&B writes to a directory of this
            name. Its file `id` is what W&B knows the run by.
        project: of W&B; made by it where there is none. None: nothing is written.
        num_seeds: how many seeds the rows are of.
        after_step: of the checkpoint that the run is resumed from. None for a new run.
        config: what W&B shows as the run's configuration.

    Raises:
        RunError: W&B is not installed, or does not start.
    """

    def __init__(
        self,
        directory: Path,
        project: str | None,
        *,
        num_seeds: int = 1,
        after_step: int | None = None,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        self._many, self._run = num_seeds > 1, None
        if project is None:
            return
        try:
            wandb: Any = importlib.import_module("wandb")  # Which this file is called, too.
        except ImportError as error:
            raise RunError(f'--wandb needs wandb ({error}). What to do: pip install -e ".[wandb]".') from error
        own_id = _own_id(directory, new=after_step is None)
        try:
            self._run: Any = wandb.init(
                project=project,
                dir=directory.parent,
                id=own_id,
                name=directory.parent.resolve().name,
                resume="allow",
                config=dict(config or {}),
                # What is printed is the console's; W&B would read along.
                settings=wandb.Settings(console="off"),
            )
            self._run.define_metric(STEP, hidden=True)
            self._run.define_metric("*", step_metric=STEP)
        except Exception as error:  # No network, no account, no project: errors of many types.
            raise _failed("start", error) from error

    @property
    def available(self) -> bool:
        """Whether numbers are written."""
        return self._run is not None

    def append(self, rows: Iterable[Row]) -> None:
        """Sends the numbers of rows, null and non-finite ones left out; rows of one step in one go.

        Raises:
            ValueError: a field is not a scalar, or `step` or `seed` is missing.
            RunError: W&B does not take them.
        """
        if self._run is None:
            return
        steps: dict[int, dict[str, Any]] = {}
        for row in map(plain, rows):
            suffix = f"/seed_{row['seed']}" if self._many else ""
            numbers = {n: v for n, v in row.items() if n not in ("step", "seed") and isinstance(v, int | float)}
            named = {tensorboard_tag(name) + suffix: value for name, value in numbers.items()}
            steps.setdefault(row["step"], {}).update(named)
        try:
            for step, values in steps.items():
                self._run.log({STEP: step, **values})
        except Exception as error:
            raise _failed("log", error) from error

    def close(self) -> None:
        """Has W&B finish what it is sending."""
        if self._run is not None:
            self._run.finish()
            self._run = None


def _own_id(directory: Path, *, new: bool) -> str:
    """What W&B knows the run by: the same when it is resumed, another in another directory."""
    path = directory / "id"
    try:
        if not new and path.exists():
            return read_text(path).strip()
        directory.mkdir(parents=True, exist_ok=True)
        own_id = secrets.token_hex(4)
        write_text(path, f"{own_id}\n")
        return own_id
    except OSError as error:
        raise disk_error("write what Weights & Biases needs", directory, error, "continue with --resume") from error


def _failed(what: str, error: Exception) -> RunError:
    text = str(error).strip().splitlines()
    return RunError(
        f"Weights & Biases cannot {what}: {type(error).__name__}{f': {text[0]}' if text else ''}. What to do: set "
        "WANDB_MODE=offline and send the run later with `wandb sync`, or continue with --resume without --wandb."
    )
