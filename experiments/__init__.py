"""The command line and everything with side effects. Importing it sets two of JAX's switches for CPUs."""

import os

import jax

# XLA's thread pool on CPUs now and then hangs in programs as these (seen with jaxlib 0.10.2 on 2 cores: all threads
# asleep, a result never ready; others report the same, and the same cure). One thread and no dispatch ahead of time
# cost little here: the matrices are small. The flag alone does not do it, large products go to the pool all the same:
# the pool itself is made of one thread. XLA reads both at the first computation, so this is early enough. Whoever sets
# them is left alone.
if "xla_cpu_multi_thread_eigen" not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip()
if "NPROC" not in os.environ:
    os.environ.setdefault("PJRT_NPROC", "1")
jax.config.update("jax_cpu_enable_async_dispatch", False)
