"""Pictures. Every function takes arrays, draws without a display, and replaces its file as a whole.

A run draws when it ends. Matplotlib, a second of its start, is imported when the first of these names is used; whether
it is there is found out at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

from experiments.analysis.figures.style import FEW_CELLS, save

if TYPE_CHECKING:
    from experiments.analysis.figures.calibration import Reliability, plot_calibration
    from experiments.analysis.figures.curves import plot_coverage, plot_intrinsic_reward, plot_return
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
_WHERE = {
    **dict.fromkeys(("Reliability", "plot_calibration"), "calibration"),
    **dict.fromkeys(("plot_coverage", "plot_intrinsic_reward", "plot_return"), "curves"),
    "plot_visitation": "floor",
    "Curves": "panels",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_WHERE[name]}"), name)
