"""The directory of several seeds, each of them a run of its own in it.

| file | what |
| --- | --- |
| `seeds.json` | the specification of all, as a `config.json` has it |
| `seed-K/` | the run of seed K |
| `seed-K.log` | what its process printed |
"""

import os
from collections.abc import Iterable
from pathlib import Path

from experiments.runs import spec as specs
from experiments.runs.directory import CONFIG, RunDirectory
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import read_text, sweep, write_text
from experiments.runs.spec import RunSpec
from jaxplore.validate import FieldError

SEEDS = "seeds.json"


class SeedRuns:
    """The directory of several seeds.

    Args:
        path: where it is; nothing is made until something is written.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    def __str__(self) -> str:
        """The path."""
        return str(self.path)

    def exists(self) -> bool:
        """Whether there is such a directory."""
        return (self.path / SEEDS).is_file()

    def spec(self) -> RunSpec:
        """What all seeds have in common: the first seed, and how many.

        Raises:
            RunError: there is none, or one of a newer format.
            ValueError: it is damaged, or has been changed.
        """
        path = self.path / SEEDS
        try:
            text = read_text(path)
        except (OSError, ValueError) as error:
            raise RunError(f"{self.path} holds no runs: cannot read {path} ({error}).") from error
        return specs.from_json(text, str(path), as_written=True)

    def seeds(self) -> range:
        """The seeds. Raises as `spec`."""
        config = self.spec().config
        return range(config.seed, config.seed + config.num_seeds)

    def run(self, seed: int) -> RunDirectory:
        """The run of a seed, whether it is there yet or not."""
        return RunDirectory(self.path / f"seed-{seed}")

    def log(self, seed: int) -> Path:
        """What the process of a seed prints to."""
        return self.path / f"seed-{seed}.log"

    def begin(self, spec: RunSpec, runs: Iterable[RunSpec]) -> None:
        """Save what all are, and what each is; what is there already of a run stays as it is.

        Args:
            spec: of all.
            runs: of each seed.

        Raises:
            RunError: the disk is full or cannot be written.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            sweep(self.path)
            write_text(self.path / SEEDS, specs.to_json(spec))
            for one in runs:
                path = self.run(one.config.seed).path
                if not (path / CONFIG).exists():
                    path.mkdir(exist_ok=True)
                    write_text(path / CONFIG, specs.to_json(one))
        except OSError as error:
            raise disk_error("start the runs", self.path, error, "start them again") from error


def one(path: str | os.PathLike[str], seed: int | None = None) -> RunDirectory:
    """The run that a person names; of the directory of several seeds that of one, by default of the first.

    Raises:
        RunError: what the seeds have in common cannot be read.
        ValueError: it is damaged.
        FieldError: `seed` is none of them.
    """
    found = SeedRuns(path)
    if not found.exists():
        return RunDirectory(path)
    seeds = found.seeds()
    if seed is not None and seed not in seeds:
        raise FieldError("seed", seed, f"the run's seeds, {', '.join(map(str, seeds))}", "is none of the run's")
    return found.run(seeds[0] if seed is None else seed)


def expand(path: Path) -> list[Path]:
    """The runs that a person names: the directory of a run, or in place of that of several seeds, those of each seed.

    Raises:
        RunError: what the seeds have in common cannot be read.
        ValueError: it is damaged.
    """
    found = SeedRuns(path)
    return [found.run(seed).path for seed in found.seeds()] if found.exists() else [path]
