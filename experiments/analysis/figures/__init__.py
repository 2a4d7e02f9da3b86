"""Pictures. Every function takes arrays, draws without a display, and replaces its file as a whole."""

from experiments.analysis.figures.style import save  # First: it says what to install where matplotlib is missing.

# isort: split
from experiments.analysis.figures.calibration import Reliability, plot_calibration
from experiments.analysis.figures.curves import FEW_CELLS, plot_coverage, plot_intrinsic_reward, plot_return
from experiments.analysis.figures.floor import plot_visitation
from experiments.analysis.figures.panels import Curves

__all__ = [
    "FEW_CELLS",
    "Curves",
    "Reliability",
    "plot_calibration",
    "plot_coverage",
    "plot_intrinsic_reward",
    "plot_return",
    "plot_visitation",
    "save",
]
