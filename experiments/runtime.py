"""What a process needs before it computes: XLA's switches, the compilation cache, and the versions in use."""

import os
import stat
import sys
from importlib import metadata
from pathlib import Path

import jax

PACKAGES = (
    *("jaxplore", "jax", "jaxlib", "flax", "optax", "distrax", "mujoco", "mujoco-mjx"),
    *("brax", "gymnasium", "numpy", "orbax-checkpoint"),
)
"""Packages that results depend on."""


def set_cpu_switches() -> None:
    """Have XLA compute on one CPU thread, unless the environment says otherwise.

    XLA's thread pool on CPUs now and then hangs in programs like these (seen with jaxlib 0.10.2 on 2 cores: all threads
    asleep, a result never ready; others report the same, and the same cure). One thread and no dispatch ahead of time
    cost little here: the matrices are small. The flag alone does not do it, large products go to the pool all the same:
    the pool itself is made of one thread. XLA reads both at the first computation, so this is early enough.
    """
    if "xla_cpu_multi_thread_eigen" not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip()
    if "NPROC" not in os.environ:
        os.environ.setdefault("PJRT_NPROC", "1")
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def share_device() -> None:
    """Have JAX take memory of a GPU as it needs it, not most of it at once, unless the environment says otherwise: for
    processes that share one. Read when JAX first looks for devices, and inherited by the processes that are started.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's own cache directory, unless JAX already has another."""
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    directory = Path(base) / "jaxplore" / "jax"
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        others_write = os.name == "posix" and _others_write(directory)
    except OSError:
        return
    if others_write:
        print(f"{directory} can be written to by others, so compiled programs are not kept there", file=sys.stderr)
        return
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _others_write(directory: Path) -> bool:
    """Whether anybody else can put files into a directory: compiled code is run without being checked."""
    found = directory.stat()
    return found.st_uid != os.getuid() or bool(found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    found = {"python": sys.version.split()[0]}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
