"""The command lines and everything with side effects. Importing it sets two of JAX's switches for CPUs."""

import sys

from experiments import process, runtime

# `python -m experiments.NAME` imports this package before it fills in the program's name.
if sys.argv[:1] == ["-m"]:
    process.be_brief()
runtime.set_cpu_switches()
