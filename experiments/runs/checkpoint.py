"""Checkpoints: a whole state on disk that comes back to the bit, or not at all.

A checkpoint is a directory named by its step. Orbax writes the arrays, we write the manifest:

    checkpoints/
      8000/
      9000/
        state/          the arrays, as Orbax keeps them, named by their path in the state
        manifest.json   the rest (kinds of leaves, Python scalars, `meta`) and the SHA-256 of every file

It is prepared as `saving-9000`, flushed to the disk, and then renamed: the rename is the one instant at which the
checkpoint comes to be, so a process killed at any other instant leaves a directory that is not a checkpoint. Older ones
are removed only after it. Orbax does not notice every damaged byte, hence the checksums: nothing is restored whose
bytes differ from those saved.
"""

import hashlib
import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from experiments.runs.codec import NONE, Allowances, Misfit, decode, encode
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import sync

_FORMAT = 1


class Restored(NamedTuple):
    """What `Checkpoints.restore_latest` gives back."""

    step: int
    state: Any
    meta: dict[str, Any]


class _Damaged(Exception):
    """A checkpoint on disk is not what was saved."""


class Checkpoints:
    """The checkpoints of one run.

    Args:
        directory: where they lie; made by the first `save`.
        keep: how many of the newest are kept.
        keep_at: steps whose checkpoints are kept beside them, for good.
        warn: gets a sentence about every checkpoint that could not be used. Default: prints to stderr.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        keep: int = 2,
        keep_at: Collection[int] = (),
        warn: Callable[[str], None] | None = None,
    ) -> None:
        if keep < 1:
            raise ValueError(f"keep: must be at least 1, got {keep}")
        self.directory = Path(directory).absolute()
        self._keep, self._keep_at = keep, frozenset(keep_at)
        self._warn = warn or (lambda text: print(text, file=sys.stderr))

    def steps(self) -> list[int]:
        """The steps of the checkpoints on disk, oldest first, damaged ones among them."""
        try:
            return sorted(int(entry.name) for entry in self.directory.iterdir() if entry.name.isdecimal())
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise disk_error("look for checkpoints", self.directory, error) from error

    def check(self, step: int) -> dict[str, Any]:
        """The meta of the checkpoint of a step, every byte of which is found to be as it was saved.

        Raises:
            RunError: it is damaged; names the steps of those that are whole.
        """
        path = self.directory / str(step)
        try:
            return _verify(path)["meta"]
        except _Damaged as damage:
            whole = [str(other) for other in self.steps() if other != step and _is_whole(self.directory / str(other))]
            others = f", or take another one: whole are those of step {', '.join(whole)}" if whole else ""
            raise RunError(
                f"the checkpoint {path} is damaged ({damage}). What to do: put back a copy of it{others}."
            ) from None

    def save(self, step: int, state: Any, meta: dict[str, Any] | None = None) -> None:
        """Saves a state; when this returns it is on the disk, and the `keep` newest checkpoints are all that is left,
        beside those of `keep_at`.

        Args:
            step: names the checkpoint. One of the same step is replaced; later ones are of a future that was given up
                (a resume fell back behind them) and go.
            state: any pytree of JAX arrays, typed keys, NumPy arrays and Python scalars. Read before this returns, so
                it may be donated afterwards.
            meta: anything JSON can hold.

        Raises:
            TypeError: a leaf of the state is none of those, or `meta` is not JSON.
            RunError: the disk is full or cannot be written. The checkpoints saved before are untouched.
        """
        arrays, leaves = encode(state)
        manifest = {"format": _FORMAT, "step": step, "meta": meta or {}, "leaves": leaves, "files": {}}
        json.dumps(manifest)  # A meta that is not JSON is refused before anything is written.
        staging = self.directory / f"saving-{step}"
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._clean_up(step)
            staging.mkdir()
            if arrays:
                with _quiet(), ocp.Checkpointer(ocp.StandardCheckpointHandler()) as checkpointer:
                    checkpointer.save(staging / "state", args=ocp.args.StandardSave(arrays))
            manifest["files"] = {str(file.relative_to(staging)): _digest(file) for file in _files(staging)}
            (staging / "manifest.json").write_bytes(_signed(manifest))
            for path in (*staging.rglob("*"), staging):
                sync(path)
            final = self.directory / str(step)
            if final.exists():
                self._discard(final)
            staging.rename(final)
            sync(self.directory)
        except Exception as error:  # Orbax and TensorStore wrap the system's errors in errors of many types.
            shutil.rmtree(staging, ignore_errors=True)
            then = "continue with --resume" if self.steps() else "start the run again"
            raise disk_error(f"write the checkpoint of step {step}", self.directory, error, then) from error
        try:
            for old in self.steps()[: -self._keep]:
                if old not in self._keep_at:
                    self._discard(self.directory / str(old))
        except OSError as error:
            self._warn(f"cannot remove old checkpoints in {self.directory}: {error.strerror}")

    def restore_latest(
        self, abstract_state: Any, until: int | None = None, allowed: Allowances = NONE
    ) -> Restored | None:
        """Reads the newest checkpoint that is whole. Deletes nothing, so another process may look at a running run.

        Args:
            abstract_state: a state with the structure, shapes and dtypes of the saved one: a fresh one, or what
                `jax.eval_shape` makes of it. JAX arrays come back as JAX arrays (spread over devices like those given
                here), NumPy arrays as NumPy arrays whatever `jax_enable_x64` says, typed keys as typed keys.
            until: a step; checkpoints of later ones are passed over.
            allowed: in what the saved state may differ from `abstract_state`.

        Returns:
            The step, the state and the meta; None if there is no checkpoint.

        Raises:
            RunError: there are checkpoints but none is whole, or the saved state does not fit `abstract_state`.
        """
        reasons = []
        for step in reversed([step for step in self.steps() if until is None or step <= until]):
            path = self.directory / str(step)
            try:
                manifest = _verify(path)
                arrays = _read_arrays(path, manifest["leaves"])
            except _Damaged as damage:
                reasons.append(f"the checkpoint of step {step} is damaged ({damage})")
                continue
            for reason in reasons:
                self._warn(f"{reason}; continuing from the one of step {step}")
            try:
                state = decode(abstract_state, manifest["leaves"], arrays, allowed)
            except Misfit as misfit:
                raise RunError(
                    f"the checkpoint {path} does not fit this run: {misfit}. What to do: resume with the code and "
                    "the configuration that it was saved with, or start a new run with another --out."
                ) from None
            return Restored(step, state, manifest["meta"])
        if reasons:
            raise RunError(
                f"no checkpoint in {self.directory} can be used: {'; '.join(reasons)}. What to do: put back a copy of "
                "that directory, or start a new run with another --out."
            )
        return None

    def _clean_up(self, step: int) -> None:
        """Removes what a killed process left half done, and checkpoints later than `step`."""
        for entry in self.directory.iterdir():
            if entry.name.startswith(("saving-", "deleting-")):
                shutil.rmtree(entry)
            elif entry.name.isdecimal() and int(entry.name) > step:
                self._discard(entry)

    def _discard(self, checkpoint: Path) -> None:
        # Renamed first: killed half-way through, it must not look like a damaged checkpoint.
        doomed = checkpoint.with_name(f"deleting-{checkpoint.name}")
        checkpoint.rename(doomed)
        shutil.rmtree(doomed)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silences Orbax, whose threads log long stack traces of errors that it also raises and we report in a sentence."""
    logger = logging.getLogger("absl")
    logger.addFilter(_nothing)
    try:
        yield
    finally:
        logger.removeFilter(_nothing)


def _nothing(_: logging.LogRecord) -> bool:
    return False


def _read_arrays(path: Path, records: dict[str, dict[str, Any]]) -> dict[str, np.ndarray]:
    """Reads the arrays that `encode` made, those without entries included.

    Raises:
        _Damaged: Orbax cannot read them, or reads something else than the manifest says.
    """
    blank = {n: np.empty(r["shape"], jnp.dtype(r["dtype"])) for n, r in records.items() if r["kind"] != "python"}
    target = {name: array for name, array in blank.items() if array.size}
    if not target:
        return blank
    try:
        with _quiet(), ocp.Checkpointer(ocp.StandardCheckpointHandler()) as checkpointer:
            arrays = checkpointer.restore(path / "state", args=ocp.args.StandardRestore(target))
    except Exception as error:  # Whatever it is, an older checkpoint is to be tried.
        raise _Damaged(f"Orbax cannot read it: {str(error).strip().splitlines()[0]}") from error
    for name, wanted in target.items():
        if (arrays[name].shape, arrays[name].dtype) != (wanted.shape, wanted.dtype):
            raise _Damaged(f"{name} does not have the shape and dtype of the manifest")
    return blank | arrays


def _verify(path: Path) -> dict[str, Any]:
    """Reads a checkpoint's manifest and compares every file with it.

    Raises:
        _Damaged: anything is missing, altered or unreadable.
    """
    try:
        manifest = _unsigned((path / "manifest.json").read_bytes())
        for name, digest in manifest["files"].items():
            if _digest(path / name) != digest:
                raise _Damaged(f"{name} has been altered")
    except FileNotFoundError as error:
        raise _Damaged(f"{Path(error.filename).relative_to(path)} is missing") from error
    except OSError as error:
        raise _Damaged(f"{error.filename} cannot be read: {error.strerror}") from error
    if manifest["format"] != _FORMAT or str(manifest["step"]) != path.name:
        raise _Damaged("manifest.json is of another checkpoint or another version")
    return manifest


def _is_whole(path: Path) -> bool:
    try:
        _verify(path)
    except _Damaged:
        return False
    return True


def _signed(manifest: dict[str, Any]) -> bytes:
    """A manifest as it is written: its own SHA-256 on the first line, then the JSON."""
    body = json.dumps(manifest, indent=1).encode()
    return hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def _unsigned(text: bytes) -> dict[str, Any]:
    digest, _, body = text.partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != digest:
        raise _Damaged("manifest.json has been altered")
    return json.loads(body)


def _files(directory: Path) -> list[Path]:
    return sorted(path for path in directory.rglob("*") if path.is_file())


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
