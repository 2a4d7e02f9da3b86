"""What all pictures share: colours, fonts, and a file that is replaced as a whole. The first file to need
matplotlib, of which it imports little: the rest comes with the first picture.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import replacing

try:
    importlib.import_module("matplotlib")  # a quarter of a second, half a second less than matplotlib.figure
except ImportError as error:
    raise RunError('pictures need matplotlib. What to do: pip install -e ".[experiments]".') from error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FEW_CELLS = 12
"""Up to so many coverage cells are shown one by one."""

# Okabe and Ito's colours, told apart with any kind of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
INK, SOFT = "#222222", "#8a8a8a"
STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlesize": 11,
    "axes.titlecolor": INK,
    "axes.edgecolor": SOFT,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "savefig.dpi": 180,
    "savefig.facecolor": "white",
}


def save(figure: "Figure", path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG, whole or not at all.

    Raises:
        RunError: the file cannot be written.
    """
    try:
        with replacing(path) as draft:
            figure.savefig(draft)
    except OSError as error:
        raise disk_error("write the picture", path, error) from error
