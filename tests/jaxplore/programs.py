"""Compiling what runs long."""

import functools

import jax

compiled = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 1})
"""`jax.jit` for a program of thousands of steps: the tests compile for speed of compilation (`tests/conftest.py`), and
such a program then runs for longer than it takes to compile it well."""
