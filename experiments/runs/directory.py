"""The directory of a run: the only place that knows what its files are called.

| file | what |
| --- | --- |
| `config.json` | the specification: settings, format, parent, identity |
| `versions.json` | versions of everything that results depend on, and the machine, when the run began |
| `scene.json` | what coverage counts, the floor plan, units: what reports need of the environment |
| `metrics.jsonl` | a row per round and seed; compressed, `metrics.jsonl.gz`, in a run that was kept |
| `checkpoints/` | the latest states, whole, and those of `keep_at` |
| `tensorboard/`, `wandb/` | the rows as TensorBoard events, and in Weights & Biases |
| `walk.npz` | where each step began |
| `outcome.json` | how the run ended; the last file to be written |
| `calibration.json` | what its belief knows, if that was asked |
| `*.png` | pictures |
"""

import gzip
import json
import os
import zipfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments import machine, runtime
from experiments.runs import lock
from experiments.runs import scene as scenes
from experiments.runs import spec as specs
from experiments.runs.asked import is_calibration
from experiments.runs.checkpoint import Checkpoints
from experiments.runs.config import RunConfig, to_dict
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import read_json, read_text, replacing, sweep, write_text
from experiments.runs.metrics import MetricsLog, read_metrics
from experiments.runs.scene import Scene
from experiments.runs.spec import RunSpec
from experiments.runs.status import Status
from experiments.runs.tensorboard import TensorBoardLog
from experiments.runs.wandb import WandbLog

CONFIG, VERSIONS, SCENE, OUTCOME = "config.json", "versions.json", "scene.json", "outcome.json"
METRICS, PACKED_METRICS, WALK = "metrics.jsonl", "metrics.jsonl.gz", "walk.npz"
CHECKPOINTS, TENSORBOARD, WANDB = "checkpoints", "tensorboard", "wandb"
MACHINE = "machine"
"""Of `VERSIONS`, what the run began on."""
CALIBRATION, OLD_CALIBRATION = "calibration.json", "posterior.json"
KEPT = (CONFIG, VERSIONS, SCENE, OUTCOME, CALIBRATION, OLD_CALIBRATION, WALK)
"""Files that `RunDirectory.keep` copies as they are, those that there are."""


class RunDirectory:
    """The directory of a run.

    Args:
        path: where it is; nothing is made until something is written.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    def __str__(self) -> str:
        """The path."""
        return str(self.path)

    def status(self) -> Status:
        """How far the run has come.

        Raises:
            RunError: its files cannot be read.
            ValueError: its configuration is damaged.
        """
        if not (self.path / CONFIG).is_file():
            return Status.ABSENT
        try:
            found = Status(read_json(self.path / OUTCOME)["status"])
        except FileNotFoundError:
            # Before there were outcomes and scenes the walk was a run's last file; a run kept then has neither.
            is_old = self.has_walk() and not (self.path / SCENE).exists()
            last = max((row["step"] for row in self.rows()), default=0) if self.is_kept() or is_old else 0
            found = Status.FINISHED if last >= self.config().steps else Status.PARTIAL
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise self._unreadable(OUTCOME, error, "remove it, and finish with --resume") from error
        # Somebody has removed the walk, perhaps because it was damaged: it is written again by --resume.
        lacks_walk = found is Status.FINISHED and not self.is_kept() and not self.has_walk()
        return Status.PARTIAL if lacks_walk else found

    def has_walk(self) -> bool:
        """Whether where each step began is there: of a run that has ended, unless it was kept before walks were."""
        return (self.path / WALK).is_file()

    def is_kept(self) -> bool:
        """Whether this is what `keep` left of a run: it can be read, and not resumed."""
        return (self.path / PACKED_METRICS).exists() and not (self.path / METRICS).exists()

    def entries(self) -> set[str] | None:
        """Names of what lies here, but for the lock; None: there is no directory.

        Raises:
            RunError: it cannot be read.
        """
        try:
            return {entry.name for entry in self.path.iterdir()} - {lock.NAME} if self.path.is_dir() else None
        except OSError as error:
            raise disk_error("look for a run", self.path, error) from error

    def holds_only_scraps(self) -> bool:
        """Whether what lies here is what a run that was killed while it started may have left."""
        return not {name for name in self.entries() or () if ".tmp" not in name and name not in (VERSIONS, SCENE)}

    # What a run is.

    def spec(self) -> RunSpec:
        """The specification.

        Raises:
            RunError: there is no run, or one of a newer format.
            ValueError: its `config.json` is damaged, or has been changed.
        """
        path = self.path / CONFIG
        try:
            text = read_text(path)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RunError(f"{self.path} holds no run: cannot read {path} ({reason}).") from error
        return specs.from_json(text, str(path), as_written=True)

    def config(self) -> RunConfig:
        """The configuration. Raises as `spec`."""
        return self.spec().config

    def scene(self) -> Scene | None:
        """What reports must know of the environment; None in a run of before that was saved.

        Raises:
            RunError: the file is damaged.
        """
        try:
            return scenes.from_json(read_json(self.path / SCENE))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise self._unreadable(SCENE, error, "put back a copy of the file") from error

    def versions(self) -> dict[str, Any]:
        """Versions that the run began with; empty where they cannot be read."""
        try:
            return read_json(self.path / VERSIONS)
        except (OSError, ValueError):
            return {}

    def machine(self) -> str:
        """What the run began on, in words; empty in a run of before that was saved. Resumed elsewhere it goes on."""
        found = self.versions().get(MACHINE)
        return found if isinstance(found, str) else ""

    def changed_versions(self) -> list[str]:
        """What has another version now than when the run began, as `name: then -> now`."""
        then, now = self.versions(), runtime.versions()
        return [f"{name}: {then[name]} -> {new}" for name, new in now.items() if then.get(name, new) != new]

    # What it came to.

    def rows(self) -> list[dict[str, Any]]:
        """All rows. Raises `RunError` if they cannot be read."""
        return read_metrics(self.path / METRICS)

    def diverged(self) -> dict[int, dict[str, Any]]:
        """Of each seed that diverged, `step` and `what` was not finite.

        Raises:
            RunError: its files cannot be read.
        """
        try:
            found = read_json(self.path / OUTCOME)["diverged"]
            return {int(seed): {"step": how.get("step"), "what": how.get("what")} for seed, how in found.items()}
        except FileNotFoundError:  # It is not finished, or from before there were outcomes.
            rows = [row for row in self.rows() if row.get("diverged")] if self.has_rows() else []
            return {row["seed"]: {"step": row["step"], "what": row["diverged"]} for row in rows}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise self._unreadable(OUTCOME, error, "remove it, and finish with --resume") from error

    def has_rows(self) -> bool:
        """Whether a row has been written."""
        return (self.path / METRICS).exists() or (self.path / PACKED_METRICS).exists()

    def walk(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each step began, `[S, steps, 2]` [m], and the step of its episode that it was, `[S, steps]`.

        Raises:
            RunError: the file cannot be read.
        """
        try:
            with np.load(self.path / WALK) as walk:
                return walk["positions"], walk["episode_steps"]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise self._unreadable(WALK, error, "remove it, and finish with --resume") from error

    def calibration(self) -> dict[str, Any] | None:
        """What `experiments.calibrate` found; None: it has not been asked.

        Raises:
            RunError: the file cannot be read.
        """
        for name in (CALIBRATION, OLD_CALIBRATION):
            if (self.path / name).exists():
                try:
                    found = read_json(self.path / name)
                    if not is_calibration(found):
                        raise ValueError("it is not what a belief was asked")
                    return found
                except (OSError, ValueError) as error:
                    again = f"python -m experiments.calibrate {self.path}"
                    raise self._unreadable(name, error, again) from error
        return None

    def checkpoints(self, keep_at: Collection[int] = ()) -> Checkpoints:
        """Its checkpoints; when one is saved, those of the steps `keep_at` stay."""
        return Checkpoints(self.path / CHECKPOINTS, keep_at=keep_at)

    # Writing.

    def extend(self, spec: RunSpec) -> None:
        """Make the run longer: it is then partial. Raises `RunError` if it cannot be written."""
        try:
            (self.path / OUTCOME).unlink(missing_ok=True)
            write_text(self.path / CONFIG, specs.to_json(spec))
        except OSError as error:
            raise disk_error("make the run longer", self.path, error) from error

    def begin(self, spec: RunSpec, scene: Scene) -> None:
        """Save what the run is; what is there already stays as it is.

        Raises:
            RunError: the disk is full or cannot be written.
        """
        texts = {
            VERSIONS: json.dumps({**runtime.versions(), MACHINE: machine.describe()}, indent=2) + "\n",
            SCENE: scenes.to_json(scene),
            CONFIG: specs.to_json(spec),  # Last: with it, this is a run.
        }
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            sweep(self.path)
            for name, text in texts.items():
                if not (self.path / name).exists():
                    write_text(self.path / name, text)
        except OSError as error:
            raise disk_error("start the run", self.path, error, "start it again") from error

    def metrics_log(self) -> MetricsLog:
        """The log that rows are appended to."""
        return MetricsLog(self.path / METRICS)

    def sinks(self, after_step: int | None, project: str | None) -> list[TensorBoardLog | WandbLog]:
        """What rows are also written to: TensorBoard events, and a project of Weights & Biases where one is named;
        `after_step` as `TensorBoardLog` has it.
        """
        config, seeds = self.config(), {"num_seeds": self.config().num_seeds, "after_step": after_step}
        tensorboard = TensorBoardLog(self.path / TENSORBOARD, **seeds)
        return [tensorboard, WandbLog(self.path / WANDB, project, **seeds, config=to_dict(config))]

    def write_walk(self, positions: np.ndarray, episode_steps: np.ndarray) -> None:
        """Save where each step began. Raises `RunError` if it cannot be written."""

        def write(draft: Path) -> None:
            with draft.open("wb") as file:
                np.savez_compressed(file, positions=positions, episode_steps=episode_steps)

        self._write(WALK, write, "write the walk", "finish with --resume")

    def write_outcome(self, status: Status, seeds: Mapping[int, Mapping[str, Any]]) -> None:
        """Save how the run ended.

        Args:
            status: finished or diverged.
            seeds: of each seed that diverged, `step` and `what`.

        Raises:
            RunError: it cannot be written.
        """
        text = json.dumps({"status": status.value, "diverged": {str(seed): dict(how) for seed, how in seeds.items()}})
        self._write(OUTCOME, lambda draft: draft.write_text(text + "\n"), "write the outcome", "finish with --resume")

    def write_calibration(self, found: Mapping[str, Any]) -> Path:
        """Save what the belief knows, and give the file. Raises `RunError` if it cannot be written."""
        text = json.dumps(found, indent=2) + "\n"
        self._write(CALIBRATION, lambda draft: draft.write_text(text), "write what the belief knows", "")
        return self.path / CALIBRATION

    def picture(self, name: str) -> Path:
        """Where the picture called `name` is."""
        return self.path / f"{name}.png"

    @property
    def metrics_path(self) -> Path:
        """Where the rows are, for people."""
        return self.path / METRICS

    def keep(self, directory: Path) -> None:
        """Copy what comparisons and pictures read, the rows compressed, to a directory of the run's name.

        Some 30 kB, and 8 bytes of walk a step where there is a floor plan.

        Raises:
            OSError: it cannot be read or written.
        """
        to = directory / self.path.resolve().name
        to.mkdir(parents=True, exist_ok=True)
        if to.resolve() == self.path.resolve():
            return
        for name in KEPT:
            if (self.path / name).exists():
                with replacing(to / name) as draft:
                    draft.write_bytes((self.path / name).read_bytes())
        with replacing(to / PACKED_METRICS) as draft:
            if self.is_kept():
                draft.write_bytes((self.path / PACKED_METRICS).read_bytes())
            else:
                # Without the time of day, so that the same run gives the same bytes.
                draft.write_bytes(gzip.compress((self.path / METRICS).read_bytes(), mtime=0))

    def _write(self, name: str, write: Callable[[Path], Any], doing: str, then: str) -> None:
        try:
            with replacing(self.path / name) as draft:
                write(draft)
        except OSError as error:
            raise disk_error(doing, self.path, error, then) from error

    def _unreadable(self, name: str, error: BaseException, remedy: str) -> RunError:
        return RunError(f"cannot read {self.path / name}: {error}. What to do: {remedy}.")
