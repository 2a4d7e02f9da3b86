"""Runs side by side: pictures, and tables in Markdown."""

import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.analysis import figures, peers
from experiments.analysis.calibration import DATA, HELD_OUT, UNSEEN
from experiments.analysis.intervals import (
    Bounds,
    Interval,
    Paired,
    bootstrap,
    interquartile_mean,
    interval,
    paired,
    probability_of_improvement,
)
from experiments.analysis.peers import Peer
from experiments.analysis.statistics import MEASURES, Group, PairedReturns, Returns, group, paired_returns, returns_of
from experiments.analysis.tables import duration, markdown_table, number, span
from experiments.runs.errors import RunError, disk_error
from experiments.runs.files import write_text
from experiments.runs.scene import Cells, Scene
from jaxplore import validate


def write(
    runs: Sequence[Path],
    names: Sequence[str | None],
    out: Path,
    until: int | None = None,
    against: str | None = None,
    others: Sequence[tuple[str | None, Path]] = (),
) -> str:
    """Compare runs: pictures and `comparison.json` in `out`; gives the tables.

    Args:
        runs: directories.
        names: of each run, what it counts under; None: its method.
        out: a directory.
        until: steps to compare; None: all.
        against: the name that all others are compared with, seed by seed; None: the first.
        others: runs of other libraries, to hold their returns beside: what each counts under (None: its library), and
            its file.

    Raises:
        RunError: a run cannot be read or does not go with the others, or `out` cannot be written.
        ValueError: the configuration of a run is damaged, or no run is called `against`.
    """
    first, groups = group(runs, until, names)
    config, scene = first.config, first.scene
    own = [one.label for one in groups]
    beside = peers.group(others, config.env, config.steps)
    twice = [label for label in beside if label in own]
    if twice:
        raise RunError(f"{twice[0]}: is a name of runs and of another library's. Give NAME=FILE to tell them apart.")
    against = own[0] if against is None else against
    validate.one_of("against", against, [*own, *beside])
    returns = [*map(returns_of, groups), *(peers.returns_of(label, found) for label, found in beside.items())]
    pairs = _pair(returns, against)
    try:
        out.mkdir(parents=True, exist_ok=True)
        _draw(groups, returns, first.scene, config.env, out)
        found = {one.label: [outcome._asdict() for outcome in one.outcomes] for one in groups}
        record = {"env": config.env, "preset": config.preset, "steps": config.steps, "methods": found}
        if beside:
            record["others"] = {label: [_record_of(peer) for peer in found] for label, found in beside.items()}
        if pairs:
            record["returns"] = {"less": against, "by_name": {label: _plain(pair) for label, pair in pairs.items()}}
        write_text(out / "comparison.json", json.dumps(record, indent=2) + "\n")
    except OSError as error:
        raise disk_error("write the comparison", out, error) from error
    tables = [
        coverage_table(groups, scene.coverage),
        # Other libraries are not known to have seen anything.
        paired_table(groups, against if against in own else own[0]),
        return_table(groups, beside),
        paired_return_table(pairs, against),
        belief_table(groups),
        calibration_table(groups),
    ]
    total = sum(outcome.minutes for one in groups for outcome in one.outcomes)
    after = f"{duration(60 * total)} of wall time in all; written to {out}"
    return "\n\n".join([*(text for text in tables if text), after])


def _pair(returns: Sequence[Returns], against: str) -> dict[str, PairedReturns]:
    """By name what is compared with one of them, those that can be."""
    reference = next(one for one in returns if one.label == against)
    pairs = {one.label: paired_returns(one, reference) for one in returns if one is not reference}
    return {label: pair for label, pair in pairs.items() if pair is not None}


def _record_of(peer: Peer) -> dict[str, Any]:
    """What another library's run came to, as JSON has it."""
    shown = {name: value for name, value in peer._asdict().items() if name not in ("path", "steps", "returns")}
    return {**shown, "final_return": peer.returns[-1], "evaluated": peer.steps, "returns": peer.returns}


def _plain(pair: PairedReturns) -> dict[str, Any]:
    def of(one: Paired) -> dict[str, Any]:
        return {"seeds": one.seeds, "difference": one.difference._asdict(), "ahead": one.ahead}

    return {"first": pair.first, "last": pair.last, "final": of(pair.final), "mean": of(pair.mean)}


def _draw(groups: Sequence[Group], returns: Sequence[Returns], scene: Scene, env: str, out: Path) -> None:
    curves = [figures.Curves(one.label, one.steps, one.coverage) for one in groups]
    figures.plot_coverage(out / "coverage.png", curves, scene.coverage, episode_steps=scene.episode_steps, title=env)
    earned = [figures.Curves(one.label, one.steps, one.values) for one in returns if len(one.steps)]
    if earned:
        figures.plot_return(out / "return.png", earned, title=f"{env}: return of evaluations without exploring")
    known = [figures.Curves(one.label, one.steps, one.variance) for one in groups if np.isfinite(one.variance).any()]
    if known:
        figures.plot_intrinsic_reward(
            out / "variance.png",
            known,
            unit=f"equation 1 ({scene.variance_unit})",
            title=f"{env}: variance of the models on the transitions just met",
        )


def coverage_table(groups: Sequence[Group], cells_of: Cells) -> str:
    """A Markdown table: medians, ranges in brackets, and the mean height of the coverage curves with its interval."""
    most = cells_of.reachable or cells_of.num_cells
    seen = f"{cells_of.unit} of {cells_of.size}: median (range)"
    head = ("method", "seeds", seen, "each seed", "all seen at step", "coverage over the run: mean, 95 %", "minutes")
    lines = []
    for one in groups:
        cells = [outcome.cells for outcome in one.outcomes]
        whole = [f"{outcome.reached[-1]:,}" for outcome in one.outcomes if outcome.cells == most]
        lines.append(
            (
                *(f"`{one.label}`", str(len(cells)), f"{statistics.median(cells):g} ({min(cells)} to {max(cells)})"),
                *(", ".join(map(str, cells)), ", ".join(whole) or "-", _percent(one)),
                f"{statistics.median(outcome.minutes for outcome in one.outcomes):.1f}",
            )
        )
    return markdown_table(head, lines)


def paired_table(groups: Sequence[Group], against: str) -> str | None:
    """A Markdown table of each method against one of them, by the mean height of the coverage curve: the difference on
    the seeds that both have, and over all seeds how often the method's is higher; None where nothing can be compared.
    """
    reference = next(one for one in groups if one.label == against)
    seeds_ahead = f"seeds ahead of `{against}`"
    head = ("method", "coverage: interquartile mean, 95 %", f"less `{against}`, by seed: mean, 95 %", seeds_ahead)
    head = (*head, "probability of being ahead, 95 %")
    lines = []
    for one in groups:
        heights, others = (np.array(list(group.heights.values())) for group in (one, reference))
        line = [f"`{one.label}`", _bounds(bootstrap(interquartile_mean, heights), ".0%", len(heights))]
        found = paired(one.heights, reference.heights) if one is not reference else None
        if found is None:
            line += ["-", "-"]
        else:
            mean, half_width = found.difference
            error = "" if half_width is None else f" +- {100 * half_width:.0f}"
            line += [f"{100 * mean:+.0f}{error} points", f"{found.ahead:g} of {len(found.seeds)}"]
        if one is reference:
            line.append("-")
        else:
            chance = bootstrap(probability_of_improvement, heights, others)
            line.append(_bounds(chance, ".2f", min(len(heights), len(others))))
        lines.append(line)
    return markdown_table(head, lines) if len(groups) > 1 else None


def return_table(groups: Sequence[Group], others: Mapping[str, Sequence[Peer]] | None = None) -> str | None:
    """A Markdown table of the mean returns of the last evaluations, of other libraries' runs (`peers.group`) too; None
    where there was none.
    """
    found = []
    for one in groups:
        finals = [outcome.final_return for outcome in one.outcomes if outcome.final_return is not None]
        found.append((one.label, finals, one.evaluated[-1] if len(one.evaluated) else None))
    for label, own in (others or {}).items():
        found.append((label, [peer.returns[-1] for peer in own], min(peer.steps[-1] for peer in own)))
    lines = []
    for label, finals, last in found:
        if finals:
            each = ", ".join(f"{value:,.1f}" for value in finals)
            mean = _mean_return(interval(np.array(finals)), ",.1f")
            lines.append((f"`{label}`", str(len(finals)), mean, each, "-" if last is None else f"{last:,}"))
    head = ("method", "seeds", "final return: mean, 95 %", "each seed", "at step, parents' counted")
    return markdown_table(head, lines) if lines else None


def _mean_return(found: Interval, written: str) -> str:
    mean, half_width = found
    return format(mean, written) + ("" if half_width is None else f" +- {half_width:,.1f}")


def paired_return_table(pairs: Mapping[str, PairedReturns], against: str) -> str | None:
    """A Markdown table of returns less those of one method, on the seeds that both have and over the steps that both
    have: at the last of these, and on average; None where nothing can be compared.

    Args:
        pairs: by name of the method.
        against: the name of the one.
    """
    less, ahead = f"less `{against}`, by seed: mean, 95 %", f"seeds ahead of `{against}`"
    head = ("method", "over steps", f"final return {less}", ahead, f"mean return over these steps {less}", ahead)
    lines = []
    for label, pair in pairs.items():
        line = [f"`{label}`", span(f"{pair.first:,}", f"{pair.last:,}")]
        for found in (pair.final, pair.mean):
            line += [_mean_return(found.difference, "+,.1f"), f"{found.ahead:g} of {len(found.seeds)}"]
        lines.append(line)
    return markdown_table(head, lines) if lines else None


def belief_table(groups: Sequence[Group]) -> str | None:
    """A Markdown table of what the beliefs said in the second half of the runs, means over seeds; None without any."""
    pairs = (
        ("own reward, imagined", "policy/imagined_reward"),
        ("own reward", "intrinsic_reward"),
        ("variance", "variance"),
        ("divergence", "divergence"),
    )
    head = ("method", "model error", *(f"{title}: mean, 95th percentile" for title, _ in pairs))
    lines = []
    for one in groups:
        means = {name: _mean([outcome.measures.get(name) for outcome in one.outcomes]) for name in MEASURES}
        if means["model_error"] is not None:
            shown = (f"{number(means[name])}, {number(means[f'{name}_p95'])}" for _, name in pairs)
            lines.append((f"`{one.label}`", number(means["model_error"]), *shown))
    return markdown_table(head, lines) if lines else None


def calibration_table(groups: Sequence[Group]) -> str | None:
    """A Markdown table of what `experiments.calibrate` found, geometric means of ratios and means of the rest over the
    seeds that were asked; None where none was.
    """
    kinds = (("data", DATA), ("new", HELD_OUT), ("unseen", UNSEEN))
    head = (
        *("method", "seeds"),
        *(f"error / variance, {short}" for short, _ in kinds),
        *(f"rank correlation, {short}" for short, _ in kinds),
        "unseen told from data",
    )
    lines = []
    for one in groups:
        asked = [outcome.calibration for outcome in one.outcomes if outcome.calibration]
        if not asked:
            continue
        sets = [[found["sets"].get(kind, {}) for found in asked] for _, kind in kinds]
        ratios = [[found.get("error_per_variance") for found in kind] for kind in sets]
        told = _mean([found["unseen_told_from_data"] for found in asked])
        lines.append(
            (
                *(f"`{one.label}`", str(len(asked))),
                *(number(_mean([value and float(np.log(value)) for value in kind], np.exp)) for kind in ratios),
                *(number(_mean([found.get("rank") for found in kind])) for kind in sets),
                "-" if told is None else f"{told:.0%}",
            )
        )
    return markdown_table(head, lines) if lines else None


def _mean(values: Sequence[float | None], then: Callable[[float], float] = float) -> float | None:
    """Mean of the values that there are."""
    known = [value for value in values if value is not None]
    return then(float(np.mean(known))) if known else None


def _bounds(found: Bounds, written: str, seeds: int) -> str:
    """A number and its interval, which one seed does not give."""
    value, low, high = (format(number, written) for number in found)
    return value if seeds < 2 else f"{value} ({low} to {high})"


def _percent(one: Group) -> str:
    mean, half_width = interval(one.coverage.mean(axis=1))
    return f"{mean:.0%}" if half_width is None else f"{mean:.0%} +- {100 * half_width:.0f}"
