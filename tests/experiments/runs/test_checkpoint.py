import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp
import pytest
from flax import struct

from experiments.runs import checkpoint
from experiments.runs.checkpoint import Checkpoints
from experiments.runs.errors import RunError

ROOT = Path(__file__).parent.parent.parent.parent


class Record(NamedTuple):
    physics: Any
    flags: Any


@struct.dataclass
class State:
    params: Any
    optimizer: Any
    key: Any
    record: Record
    python: dict[str, Any]
    nothing: None = None
    name: str = struct.field(pytree_node=False, default="static")


def make_state(seed: int) -> State:
    rng = np.random.default_rng(seed)
    params = {"Dense_0": {"kernel": jnp.asarray(rng.normal(size=(7, 5)), jnp.float32), "bias": jnp.zeros(5)}}
    params["half"] = jnp.asarray(rng.normal(size=3), jnp.bfloat16)
    params["awkward"] = jnp.asarray([np.nan, -0.0, np.inf, 1e-45], jnp.float32)
    params["weak"] = jnp.asarray(0.5 + seed)
    params["weak_vector"] = jnp.broadcast_to(jnp.asarray(3), (2,))
    params["empty"] = jnp.zeros((0, 3), jnp.int32)
    return State(
        params=params,
        optimizer=optax.chain(optax.clip(1.0), optax.adam(1e-3)).init(params["Dense_0"]),
        key=jax.random.split(jax.random.key(seed), 3),
        record=Record(rng.normal(size=11), np.array([True, False])),
        python={
            "count": 2**60 + seed,
            "rate": 0.1,
            "on": True,
            "scalar": np.float64(1 / 3),
            "big": np.array([2**60 + 1]),
            "fortran": np.asfortranarray(rng.normal(size=(2, 3))),
            "empty": np.zeros((2, 0)),
        },
    )


def assert_same(state: Any, other: Any) -> None:
    """To the bit, in type, dtype, weak type and structure."""
    assert jax.tree.structure(state) == jax.tree.structure(other)
    for leaf, twin in zip(jax.tree.leaves(state), jax.tree.leaves(other), strict=True):
        assert isinstance(leaf, jax.Array) == isinstance(twin, jax.Array)
        if isinstance(leaf, jax.Array):
            assert leaf.dtype == twin.dtype
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                leaf, twin = jax.random.key_data(leaf), jax.random.key_data(twin)
            assert leaf.weak_type == twin.weak_type
        else:
            assert type(leaf) is type(twin)
        leaf, twin = np.asarray(leaf), np.asarray(twin)
        assert (leaf.dtype, leaf.shape) == (twin.dtype, twin.shape)
        assert leaf.tobytes() == twin.tobytes()


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Checkpoints, list[str]]:
    """Checkpoints of steps 100 and 200, and what was warned of."""
    warnings: list[str] = []
    checkpoints = Checkpoints(tmp_path / "checkpoints", warn=warnings.append)
    for step in (100, 200):
        checkpoints.save(step, make_state(step), {"episodes": step})
    return checkpoints, warnings


@pytest.mark.parametrize("abstract", ["fresh state", "eval_shape"])
def test_state_comes_back_to_the_bit(tmp_path: Path, abstract: str):
    assert not jax.config.read("jax_enable_x64")
    meta = {"episodes": 3, "best": 0.1, "names": ["a", None]}
    Checkpoints(tmp_path).save(7, make_state(1), meta)
    target = make_state(0)
    if abstract == "eval_shape":  # It has no place for Python's large integers.
        target = jax.eval_shape(lambda: target.replace(python=None)).replace(python=target.python)
    restored = Checkpoints(tmp_path).restore_latest(target)
    assert restored is not None
    assert (restored.step, restored.meta) == (7, meta)
    assert_same(restored.state, make_state(1))


def test_restored_state_may_be_donated(tmp_path: Path):
    Checkpoints(tmp_path).save(1, {"x": jnp.arange(1000.0)})
    state = Checkpoints(tmp_path).restore_latest({"x": jnp.zeros(1000)}).state
    for _ in range(3):
        state = jax.jit(lambda s: {"x": s["x"] + 1}, donate_argnums=0)(state)
    np.testing.assert_array_equal(state["x"], np.arange(1000) + 3)


def test_arrays_return_to_the_devices_they_were_spread_over(tmp_path: Path):
    mesh = jax.sharding.Mesh(jax.devices(), ("seed",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("seed"))
    state = {"x": jax.device_put(jnp.arange(4.0), sharding)}
    Checkpoints(tmp_path).save(1, state)
    restored = Checkpoints(tmp_path).restore_latest(state).state
    assert restored["x"].sharding == sharding
    assert_same(restored, state)


def test_nothing_saved_is_none(tmp_path: Path):
    assert Checkpoints(tmp_path / "none").restore_latest(make_state(0)) is None
    assert not (tmp_path / "none").exists()


def test_newest_are_kept_and_readable_by_orbax_alone(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    for step in (5, 10, 90, 100):
        checkpoints.save(step, {"x": np.arange(3.0) * step})
    assert checkpoints.steps() == [90, 100]
    assert {entry.name for entry in tmp_path.iterdir()} == {"90", "100"}
    arrays = ocp.Checkpointer(ocp.StandardCheckpointHandler()).restore(
        tmp_path / "100" / "state", args=ocp.args.StandardRestore({"x": np.empty(3)})
    )
    np.testing.assert_array_equal(arrays["x"], [0, 100, 200])


def test_saving_again_replaces_and_drops_the_future(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    for step, value in ((100, 1.0), (200, 2.0), (150, 3.0), (150, 4.0)):
        checkpoints.save(step, {"x": np.array(value)})
    assert checkpoints.steps() == [100, 150]
    assert checkpoints.restore_latest({"x": np.array(0.0)}).state["x"] == 4.0


def test_a_state_without_arrays(tmp_path: Path):
    Checkpoints(tmp_path).save(1, {"n": 3, "empty": np.zeros(0)})
    restored = Checkpoints(tmp_path).restore_latest({"n": 0, "empty": np.ones(0)})
    assert restored.state["n"] == 3


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2 :: max(1, len(data) // 3)] = bytes(
        byte ^ 0x10 for byte in data[len(data) // 2 :: max(1, len(data) // 3)]
    )
    file.write_bytes(bytes(data) if data else b"?")


def truncate(file: Path) -> None:
    data = file.read_bytes()
    file.write_bytes(data[:-1] if data else b"?")


def empty(file: Path) -> None:
    file.write_bytes(b"" if file.stat().st_size else b"?")


def garbage(file: Path) -> None:
    file.write_bytes(np.random.default_rng(0).bytes(file.stat().st_size + 1))


@pytest.mark.parametrize("damage", [flip, truncate, empty, garbage, os.unlink])
def test_any_damaged_file_falls_back_and_says_so(saved: tuple[Checkpoints, list[str]], damage: Callable[[Path], None]):
    checkpoints, warnings = saved
    latest, copy = checkpoints.directory / "200", checkpoints.directory.parent / "copy"
    shutil.copytree(latest, copy)
    files = [path.relative_to(latest) for path in latest.rglob("*") if path.is_file()]
    assert Path("manifest.json") in files
    assert len(files) > 5
    for file in files:
        damage(latest / file)
        restored = checkpoints.restore_latest(make_state(0))
        assert restored.step == 100, f"{file} was not missed"
        assert restored.meta == {"episodes": 100}
        assert_same(restored.state, make_state(100))
        (warning,) = warnings
        assert "step 200 is damaged" in warning
        assert "step 100" in warning
        warnings.clear()
        shutil.rmtree(latest)
        shutil.copytree(copy, latest)
    assert checkpoints.restore_latest(make_state(0)).step == 200
    assert warnings == []


def test_a_missing_directory_inside_falls_back(saved: tuple[Checkpoints, list[str]]):
    checkpoints, warnings = saved
    shutil.rmtree(checkpoints.directory / "200" / "state")
    assert checkpoints.restore_latest(make_state(0)).step == 100
    assert "is missing" in warnings[0]


def test_manifest_of_another_step_is_not_believed(saved: tuple[Checkpoints, list[str]]):
    checkpoints, _ = saved
    shutil.copytree(checkpoints.directory / "100", checkpoints.directory / "300")
    assert checkpoints.restore_latest(make_state(0)).step == 200


def test_restore_leaves_the_directory_as_it_is(saved: tuple[Checkpoints, list[str]]):
    checkpoints, _ = saved
    (checkpoints.directory / "saving-300").mkdir()
    flip(checkpoints.directory / "200" / "manifest.json")
    before = sorted(checkpoints.directory.rglob("*"))
    checkpoints.restore_latest(make_state(0))
    assert sorted(checkpoints.directory.rglob("*")) == before
    checkpoints.save(150, make_state(150))
    assert {entry.name for entry in checkpoints.directory.iterdir()} == {"100", "150"}


def test_all_damaged_is_an_error_that_names_the_reasons(saved: tuple[Checkpoints, list[str]]):
    checkpoints, _ = saved
    for step in (100, 200):
        os.unlink(checkpoints.directory / str(step) / "manifest.json")
    with pytest.raises(RunError, match=r"step 200 is damaged \(manifest.json is missing\).*step 100") as caught:
        checkpoints.restore_latest(make_state(0))
    assert str(checkpoints.directory) in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.replace(record=state.record._replace(physics=np.zeros(12))), "record.physics is float32"),
        (lambda state: state.replace(key=jax.random.key(0)), "key is"),
        (lambda state: state.replace(params={**state.params, "more": jnp.zeros(1)}), "it lacks params.more"),
        (lambda state: state.replace(python={}), "it has python.big, python.count, python.empty and 4 more"),
    ],
)
def test_a_state_of_another_shape_is_refused(
    saved: tuple[Checkpoints, list[str]], change: Callable[[State], State], message: str
):
    checkpoints, _ = saved
    with pytest.raises(RunError, match="does not fit this run") as caught:
        checkpoints.restore_latest(change(make_state(0)))
    assert message in str(caught.value)


@pytest.mark.parametrize("leaf", [object(), 1j, np.array(["a"]), np.array([None]), b"bytes"])
def test_leaves_that_cannot_be_saved_are_named(tmp_path: Path, leaf: Any):
    with pytest.raises(TypeError, match=r"sac\.1: "):
        Checkpoints(tmp_path / "c").save(1, {"sac": [np.zeros(1), leaf]})
    assert not (tmp_path / "c").exists()


def test_meta_that_is_not_json_is_refused(tmp_path: Path):
    with pytest.raises(TypeError):
        Checkpoints(tmp_path / "c").save(1, {"x": np.zeros(1)}, {"meta": object()})
    assert not (tmp_path / "c").exists()


def test_keep_must_be_positive(tmp_path: Path):
    with pytest.raises(ValueError, match="keep"):
        Checkpoints(tmp_path, keep=0)


def test_unwritable_directory_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    where = tmp_path / "file" / "checkpoints"
    with pytest.raises(RunError, match="Not a directory") as caught:
        Checkpoints(where).save(1, make_state(1))
    assert str(where) in str(caught.value)
    assert "--out" in str(caught.value)


class Stop(BaseException):
    """A kill at one exact call."""


def interrupt(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, call: int, error: BaseException) -> None:
    """Makes the `call`-th call of a function raise, and all after it: the disk stays full, the process stays dead."""
    original, count = getattr(module, name), 0

    def replacement(*args: Any, **kwargs: Any) -> Any:
        nonlocal count
        count += 1
        if count >= call:
            raise error
        return original(*args, **kwargs)

    monkeypatch.setattr(module, name, replacement)


CALLS = [(ocp.Checkpointer, "save", 1), *((checkpoint, "sync", n) for n in (1, 5, 9)), (Path, "write_bytes", 1)]
CALLS += [(checkpoint, "_digest", n) for n in (1, 4)]


@pytest.mark.parametrize(("module", "name", "call"), [*CALLS, (Path, "rename", 1)])
def test_full_disk_is_reported_and_spares_the_last_checkpoint(
    saved: tuple[Checkpoints, list[str]], monkeypatch: pytest.MonkeyPatch, module: Any, name: str, call: int
):
    checkpoints, warnings = saved
    with monkeypatch.context() as patch:
        interrupt(patch, module, name, call, OSError(28, "No space left on device"))
        with pytest.raises(
            RunError, match=r"checkpoint of step 300.*No space left on device.*free some space"
        ) as caught:
            checkpoints.save(300, make_state(300))
    assert str(checkpoints.directory) in str(caught.value)
    assert "--resume" in str(caught.value)
    assert {entry.name for entry in checkpoints.directory.iterdir()} == {"100", "200"}
    assert_same(checkpoints.restore_latest(make_state(0)).state, make_state(200))
    assert warnings == []
    checkpoints.save(300, make_state(300))
    assert checkpoints.steps() == [200, 300]


def test_full_disk_told_by_tensorstore_is_understood(
    saved: tuple[Checkpoints, list[str]], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    error = ValueError(
        "RESOURCE_EXHAUSTED: Failed to write 7 bytes [OS error 28: ENOSPC No space left on device]\nmore"
    )
    interrupt(monkeypatch, ocp.Checkpointer, "save", 1, error)
    with pytest.raises(RunError, match=r": No space left on device\. What to do: free some space"):
        saved[0].save(300, make_state(300))
    assert not caplog.records


@pytest.mark.parametrize(("module", "name", "call"), [*CALLS, *((Path, "rename", n) for n in (1, 2))])
def test_killed_at_any_call_leaves_a_whole_checkpoint(
    saved: tuple[Checkpoints, list[str]], monkeypatch: pytest.MonkeyPatch, module: Any, name: str, call: int
):
    checkpoints, warnings = saved
    with monkeypatch.context() as patch:
        interrupt(patch, module, name, call, Stop())
        with pytest.raises(Stop):
            checkpoints.save(300, make_state(300))
    restored = checkpoints.restore_latest(make_state(0))
    assert restored.step == (300 if (name, call) == ("rename", 2) else 200)
    assert_same(restored.state, make_state(restored.step))
    assert warnings == []
    checkpoints.save(400, make_state(400))
    assert checkpoints.steps() == [restored.step, 400]
    assert {entry.name for entry in checkpoints.directory.iterdir()} == {str(restored.step), "400"}


VICTIM = """
import sys
import jax.numpy as jnp, numpy as np
from experiments.runs.checkpoint import Checkpoints

def state(step):
    rng = np.random.default_rng(step)
    weights = {f"w{i}": jnp.asarray(rng.normal(size=50), jnp.float32) for i in range(20)}
    return {"host": rng.normal(size=200_000), **weights}

checkpoints = Checkpoints(sys.argv[1], warn=lambda text: print("WARNED", text, flush=True))
restored = checkpoints.restore_latest(state(0))
step = 0
if restored is not None:
    step, expected = restored.step, state(restored.step)
    assert restored.meta == {"step": step}
    assert all(np.asarray(restored.state[n]).tobytes() == np.asarray(expected[n]).tobytes() for n in expected)
print("restored", step, flush=True)
while len(sys.argv) == 2:
    step += 1
    checkpoints.save(step, state(step), {"step": step})
    print("saved", step, flush=True)
"""


def test_kill_9_while_saving(tmp_path: Path):
    command = [sys.executable, "-W", "error", "-c", VICTIM, str(tmp_path / "checkpoints")]
    rng, saved = random.Random(0), 0
    for _ in range(5):
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            first = process.stdout.readline().split()
            assert first[0] == "restored"
            # One more than was reported, if the kill came between the rename and the report.
            assert int(first[1]) in (saved, saved + 1)
            process.stdout.readline()
            time.sleep(rng.uniform(0, 0.4))
            process.send_signal(signal.SIGKILL)
            rest = process.stdout.read().split("\n")
        saved = max([int(first[1]) + 1, *(int(line.split()[1]) for line in rest if line.startswith("saved"))])
    last = subprocess.run([*command, "look"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert int(last.stdout.split()[1]) in (saved, saved + 1)
    assert "WARNED" not in last.stdout
    assert json.loads((tmp_path / "checkpoints" / str(saved) / "manifest.json").read_bytes().partition(b"\n")[2])
