"""The command lines and everything with side effects. Importing it sets two of JAX's switches for CPUs."""

import sys

from experiments import process

# `python -m experiments.NAME` imports this package before it fills in the program's name. First of all: what follows
# takes seconds to import, and is interrupted, too.
if sys.argv[:1] == ["-m"]:
    process.be_brief()

from experiments import runtime

runtime.set_cpu_switches()
