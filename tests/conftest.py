"""What holds for every test: no silent rank promotion, two CPU devices, programs compiled fast and kept between runs.

Warnings are errors too; `pyproject.toml` says so, and which of other packages' warnings are let through.
"""

import contextlib
import gc
import os
import signal
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

# Read by JAX when it is imported, and inherited by the commands that tests start.
_CACHE = Path(__file__).parent.parent / ".cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")
# Most of the suite's time is compiling, and programs here run for milliseconds: the same mathematics, compiled in half
# the time. `JAX_DISABLE_MOST_OPTIMIZATIONS=0 make test` compiles as a user's command does.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# XLA's older way to compile fusions takes half as long. A flag that XLA does not know ends the process, so only the
# versions that are known to have it get it.
if version("jaxlib").startswith("0.10.") and "xla_cpu_use_fusion_emitters" not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false".strip()

import jax
import pytest

import experiments  # noqa: F401  (sets switches of JAX's for the tests of the library, too)

# Not through the environment: a command under test should see the devices that a user's command sees.
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_rank_promotion", "raise")


# What is started in the background of a shell ignores Ctrl-C, and so would the commands that tests start and interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.default_int_handler)


# Tracing makes few cycles and many objects: looking through the young ones every 700 takes a tenth of the time.
gc.set_threshold(200_000, 20, 100)


@pytest.fixture(autouse=True, scope="module")
def _forget() -> Iterator[None]:
    """Take what a file leaves behind out of Python's garbage collection.

    JAX keeps every traced program, gigabytes of Python objects by the end, and each full collection walks all of them.
    """
    yield
    gc.freeze()


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("gpu") and not _has_gpu():
        pytest.skip("there is no GPU")


def _has_gpu() -> bool:
    try:
        return bool(jax.devices("gpu"))
    except RuntimeError:
        return False
