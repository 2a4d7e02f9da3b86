"""The command lines and everything with side effects. Importing it sets two of JAX's switches for CPUs."""

from experiments import runtime

runtime.set_cpu_switches()
