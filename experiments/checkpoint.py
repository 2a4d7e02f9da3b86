"""Checkpoints: a whole state on disk that comes back to the bit, or not at all.

A checkpoint is a directory named by its step. Orbax writes the arrays, we write the manifest:

    checkpoints/
      8000/
      9000/
        state/          the arrays, as Orbax keeps them, named by their path in the state
        manifest.json   the rest (kinds of leaves, Python scalars, `meta`) and the SHA-256 of every file

It is prepared as `saving-9000`, flushed to the disk, and then renamed: the rename is the one instant at which the
checkpoint comes to be, so a process killed at any other instant leaves a directory that is not a checkpoint. Older ones
go only after it. Orbax does not notice every damaged byte, hence the checksums: nothing is restored whose bytes differ
from those saved.
"""

import hashlib
import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from experiments.errors import RunError, disk_error

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
        warn: told, in a sentence, about every checkpoint that could not be used. Default: prints to stderr.
    """

    def __init__(
        self, directory: str | os.PathLike[str], *, keep: int = 2, warn: Callable[[str], None] | None = None
    ) -> None:
        if keep < 1:
            raise ValueError(f"keep: must be at least 1, got {keep}")
        self.directory = Path(directory).absolute()
        self._keep = keep
        self._warn = warn or (lambda text: print(text, file=sys.stderr))

    def steps(self) -> list[int]:
        """The steps of the checkpoints on disk, oldest first, damaged ones among them."""
        try:
            return sorted(int(entry.name) for entry in self.directory.iterdir() if entry.name.isdecimal())
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise disk_error("look for checkpoints", self.directory, error) from error

    def save(self, step: int, state: Any, meta: dict[str, Any] | None = None) -> None:
        """Saves a state; when this returns it is on the disk, and the `keep` newest checkpoints are all that is left.

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
        arrays, leaves = _encode(state)
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
                _flush(path)
            final = self.directory / str(step)
            if final.exists():
                self._discard(final)
            staging.rename(final)
            _flush(self.directory)
        except Exception as error:  # Orbax and TensorStore wrap the system's errors in errors of many types.
            shutil.rmtree(staging, ignore_errors=True)
            then = "go on with --resume" if self.steps() else "start the run again"
            raise disk_error(f"write the checkpoint of step {step}", self.directory, error, then) from error
        try:
            for old in self.steps()[: -self._keep]:
                self._discard(self.directory / str(old))
        except OSError as error:
            self._warn(f"cannot remove old checkpoints in {self.directory}: {error.strerror}")

    def restore_latest(self, abstract_state: Any, until: int | None = None) -> Restored | None:
        """Reads the newest checkpoint that is whole. Deletes nothing, so another process may look at a running run.

        Args:
            abstract_state: a state with the structure, shapes and dtypes of the saved one: a fresh one, or what
                `jax.eval_shape` makes of it. JAX arrays come back as JAX arrays (spread over devices like those given
                here), NumPy arrays as NumPy arrays whatever `jax_enable_x64` says, typed keys as typed keys.
            until: a step; checkpoints of later ones are passed over.

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
                self._warn(f"{reason}; going on from the one of step {step}")
            try:
                state = _decode(abstract_state, manifest["leaves"], arrays)
            except _Misfit as misfit:
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


class _Misfit(Exception):
    """A saved state is whole but is not of the structure asked for."""


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


def _named_leaves(tree: Any) -> tuple[dict[str, Any], Any]:
    """The leaves of a tree by path, such as `"sac.policy.Dense_0.kernel"`, and its structure."""
    pairs, structure = jax.tree_util.tree_flatten_with_path(tree)
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in pairs}
    if len(named) != len(pairs):
        raise TypeError("two leaves of the state have the same path: are there dots in the keys of a dictionary?")
    return named, structure


def _encode(state: Any) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
    """Splits a state into arrays for Orbax and, for every leaf, a JSON record of what it was.

    Everything goes through Orbax as NumPy arrays: it would canonicalise float64 where x64 is off, and refuses arrays
    without entries (MJX has many); those are made anew from their record.
    """
    arrays: dict[str, np.ndarray] = {}
    records: dict[str, dict[str, Any]] = {}
    for name, leaf in _named_leaves(state)[0].items():
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            kind, extra, array = (
                "key",
                {"impl": str(jax.random.key_impl(leaf))},
                np.asarray(jax.device_get(jax.random.key_data(leaf))),
            )
        elif isinstance(leaf, jax.Array):
            # Weak types are kept: a resumed state must hit the compiled programs of the first one.
            kind, extra, array = "jax", {"weak": bool(leaf.weak_type)}, np.asarray(jax.device_get(leaf))
        elif isinstance(leaf, np.ndarray | np.generic):
            kind, extra, array = "numpy", {"scalar": isinstance(leaf, np.generic)}, np.asarray(leaf, order="C")
        elif isinstance(leaf, bool | int | float | str):
            records[name] = {"kind": "python", "value": leaf}
            continue
        else:
            raise TypeError(f"{name}: a {type(leaf).__name__} cannot be saved, only arrays, keys and Python scalars")
        if array.dtype.hasobject or array.dtype.names or not array.dtype.isnative or array.dtype.kind in "SUMm":
            raise TypeError(f"{name}: an array of {array.dtype} cannot be saved")
        records[name] = {"kind": kind, "dtype": str(array.dtype), "shape": list(array.shape), **extra}
        if array.size:
            arrays[name] = array
    return arrays, records


def _read_arrays(path: Path, records: dict[str, dict[str, Any]]) -> dict[str, np.ndarray]:
    """Reads the arrays that `_encode` made, those without entries included.

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


def _decode(abstract_state: Any, records: dict[str, dict[str, Any]], arrays: dict[str, np.ndarray]) -> Any:
    """Puts a state together again, the inverse of `_encode`.

    Raises:
        _Misfit: structure, shapes or dtypes are not those of `abstract_state`.
    """
    like, structure = _named_leaves(abstract_state)
    if like.keys() != records.keys():
        missing, unknown = sorted(like.keys() - records.keys()), sorted(records.keys() - like.keys())
        raise _Misfit(
            "; ".join(f"it {verb} {_some(names)}" for verb, names in (("lacks", missing), ("has", unknown)) if names)
        )
    leaves = []
    for name, record in records.items():
        leaf = record["value"] if record["kind"] == "python" else _rebuild(name, record, arrays[name], like[name])
        if np.shape(leaf) != np.shape(like[name]) or _dtype(leaf) != _dtype(like[name]):
            raise _Misfit(
                f"{name} is {_dtype(leaf)}{list(np.shape(leaf))} there and "
                f"{_dtype(like[name])}{list(np.shape(like[name]))} here"
            )
        leaves.append(leaf)
    return jax.tree_util.tree_unflatten(structure, leaves)


def _rebuild(name: str, record: dict[str, Any], array: np.ndarray, like: Any) -> Any:
    if record["kind"] == "numpy":
        return array[()] if record["scalar"] else array
    # A copy: on a CPU the JAX array would share memory with the NumPy array, and the first step may donate it.
    leaf = jnp.array(array)
    if leaf.dtype != array.dtype:
        raise _Misfit(f"{name} is {array.dtype}, which needs jax_enable_x64")
    if record["kind"] == "key":
        leaf = jax.random.wrap_key_data(leaf, impl=record["impl"])
    elif record["weak"]:
        leaf = jnp.broadcast_to(jnp.asarray(array.dtype.type(0).item()), array.shape).at[...].set(leaf)
    sharding = getattr(like, "sharding", None)
    return jax.device_put(leaf, sharding) if sharding is not None and len(sharding.device_set) > 1 else leaf


def _dtype(leaf: Any) -> str:
    """The dtype as `jax.eval_shape` would have it, so that both kinds of abstract state can be compared."""
    dtype = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
    if jnp.issubdtype(dtype, jax.dtypes.extended) or dtype.kind in "US":
        return str(dtype)
    return str(jax.dtypes.canonicalize_dtype(dtype))


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


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


def _flush(path: Path) -> None:
    """Forces a file, or the names in a directory, onto the disk: a rename may otherwise overtake the data."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
