"""A panel's curves in numbers: the table under it, in words for the legend."""

import numpy as np

from experiments.analysis.pages.contents import Panel, Table
from experiments.analysis.pages.numbers import Summary, short, summary

PARTS = 4
"""Columns of the table: at so many equal parts of the steps."""
BAND = "line: mean over seeds; band: ± one standard deviation over seeds (n - 1)"
"""What curves show."""


def table(panel: Panel) -> Table:
    """Mean ± standard deviation of each series at equal parts of the panel's steps, at the last point until then.

    `(n = 3)` stands where not all seeds have a value, `-` where none has or the series has ended.
    """
    last = max((float(one.steps[-1]) for one in panel.series if len(one.steps)), default=0.0)
    at = [last * part / PARTS for part in range(1, PARTS + 1)]
    lines = []
    for one in panel.series:
        means = summary(one.values)
        entries = [_entry(np.asarray(one.steps, float), means, step, len(one.seeds)) for step in at]
        lines.append((one.label, str(len(one.seeds)), *entries))
    # Rounded steps of a short run could come twice: then they keep their digits.
    heads = tuple(f"at {step:,.0f}" if last >= 100 else f"at {step:,.4g}" for step in at)
    caption = f"{panel.measure}: mean ± standard deviation over seeds, at {panel.steps_label}"
    return Table(("method", "seeds", *heads), lines, caption)


def _entry(steps: np.ndarray, means: Summary, step: float, seeds: int) -> str:
    mean, spread, count = means
    index = int(np.searchsorted(steps, step, side="right")) - 1
    gap = float(steps[-1] - steps[0]) / max(len(steps) - 1, 1) if len(steps) else 0.0
    if index < 0 or not count[index] or step > steps[-1] + max(gap, 0.0):
        return "-"
    text = short(float(mean[index]))
    if np.isfinite(spread[index]):
        text += f" ± {short(float(spread[index]), 2)}"
    return text if count[index] == seeds else f"{text} (n = {count[index]})"
