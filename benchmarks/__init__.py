"""Benchmarks. They run under the same switches as the command line, which importing `experiments` sets."""

import experiments  # noqa: F401
