"""The environment's own reward, or none at all: nothing is learned to tell how interesting a transition is."""

from jaxplore.signals.base import Signal

TASK = Signal(score=None, unit=None)
"""Of methods that learn from the environment's reward, or from nothing."""
