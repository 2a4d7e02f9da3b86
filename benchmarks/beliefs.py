"""`python -m benchmarks.beliefs --method=implicit [FLAGS]`: what a belief makes of stored transitions, and of functions
drawn from a Gaussian process, where the posterior is known.

Flags are those of `python -m experiments.run`, with the presets' values as defaults; `--method` names the belief.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from benchmarks import gaussian_process, transitions
from benchmarks.transitions import Stored
from experiments import process, runtime
from experiments.analysis.tables import number, text_table
from experiments.runs import command, flags
from experiments.runs.errors import RunError
from jaxplore import dynamics, replay
from jaxplore.beliefs.base import Belief
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.methods import METHODS
from jaxplore.signals import rewards
from jaxplore.types import Key, Transition, no_metrics

STEPS = 4_000
"""Gradient steps of a fit: what 4,000 steps of the maze come to with the laptop's settings."""
CHUNK = 500
"""Transitions predicted at once."""
OWN = ("data", "fit-steps", "fits", "json")
"""Flags of this command's own."""
HELP = f"""--data=NAME,...     what to fit to (default: all that is stored, and gaussian_process)
--fit-steps={STEPS}    gradient steps
--fits=1            fits, of seeds 0, 1, ...
--json=FILE         to write"""


class Kind(NamedTuple):
    """What a belief makes of one kind of transitions."""

    error: float
    """Squared error of the models' mean, summed over entries, mean over transitions."""
    variance: float
    """Variance over models (equation 1), the same."""
    ratio: float
    """Geometric mean over transitions of error over variance: 1 where the size of the uncertainty is right."""
    rank: float
    """Spearman's correlation of variance and error."""
    within: float | None = None
    """Variance among the networks of one generator, where there are several; unbiased."""


class Verdict(NamedTuple):
    """What came out of one fit."""

    environment: str
    kinds: dict[str, Kind]
    metrics: dict[str, float]
    """The fit's own, of its last step."""
    milliseconds: float
    """Of one gradient step, compiling aside."""


class Fit(NamedTuple):
    """What came of gradient steps on transitions."""

    state: Any
    metrics: dict[str, float]
    """Of the last step."""
    milliseconds: float
    """Of one gradient step, compiling aside."""


def make_fit(belief: Belief) -> Callable[[Transition, dynamics.Normalizers, int, int], Fit]:
    """`fit(data, normalizers, steps, seed)`: a belief after so many gradient steps on transitions `[N, ...]`. It is
    compiled once for all transitions of one shape.
    """

    @jax.jit
    def run_steps(key: Key, state: Any, held: Any, normalizers: Any, first: Any, count: Any) -> tuple[Any, Any]:
        def step(i: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            return belief.update(jax.random.fold_in(key, i), carry[0], held, normalizers)

        metrics = no_metrics(lambda: belief.update(key, state, held, normalizers)[1])
        return jax.lax.fori_loop(first, first + count, step, (state, metrics))

    init = jax.jit(belief.init)

    def fit(data: Transition, normalizers: dynamics.Normalizers, steps: int, seed: int) -> Fit:
        held = replay.init(jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), data), len(data.obs))
        held = replay.add(held, data)
        init_key, key = jax.random.split(jax.random.key(seed))
        state, _ = jax.block_until_ready(run_steps(key, init(init_key), held, normalizers, 0, 1))
        began = time.monotonic()
        state, metrics = jax.block_until_ready(run_steps(key, state, held, normalizers, 1, steps - 1))
        milliseconds = 1e3 * (time.monotonic() - began) / max(steps - 1, 1)
        return Fit(state, {name: float(value) for name, value in metrics.items()}, milliseconds)

    return fit


def normalizers_of(data: Transition) -> dynamics.Normalizers:
    """The statistics of transitions `[N, ...]`."""
    start = dynamics.init_normalizers(data.obs.shape[1], data.action.shape[1])
    return dynamics.update_normalizers(start, jax.tree.map(jnp.asarray, data), jnp.ones(len(data.obs), bool))


def judge(belief: Belief, models: Any, normalizers: dynamics.Normalizers, rows: Transition) -> Kind:
    """What models make of transitions `[N, ...]`."""

    @jax.jit
    def some(models: Any, rows: Transition) -> tuple[Any, ...]:
        prediction, target = belief.judge(models, normalizers, rows)
        within = [rewards.variance_within(prediction, belief.num_groups)] if belief.has_groups else []
        return rewards.variance(prediction), rewards.prediction_error(prediction, target), *within

    num = len(rows.obs)
    places = (np.arange(-(-num // CHUNK) * CHUNK) % num).reshape(-1, CHUNK)
    parts = [jax.device_get(some(models, jax.tree.map(lambda leaf, at=at: leaf[at], rows))) for at in places]
    variance, error, *within = (np.concatenate(column)[:num] for column in zip(*parts, strict=True))
    ratio = float(np.exp(np.mean(np.log(np.maximum(error, 1e-12)) - np.log(np.maximum(variance, 1e-12)))))
    found: Any = stats.spearmanr(variance, error)
    return Kind(
        *(float(error.mean()), float(variance.mean()), ratio, float(found[0])), *(float(one.mean()) for one in within)
    )


def verdict(name: str, method: str, config: ExplorationConfig, steps: int, seed: int) -> Verdict:
    """Fit the belief of a method to the stored transitions of a name, and judge it on all three kinds."""
    stored: Stored = transitions.load(name)
    sizes = Sizes(stored.data.obs.shape[1], stored.data.action.shape[1])
    belief = METHODS[method].signal(sizes, config).belief
    if belief.predict is None:
        raise RunError(f"--method={method} has no belief. Allowed: a method with models of the environment.")
    normalizers = normalizers_of(stored.data)
    state, metrics, milliseconds = make_fit(belief)(stored.data, normalizers, steps, seed)
    sample = jax.jit(belief.sample, static_argnums=2)
    models = sample(jax.random.key(seed + 1), state, belief.num_models)
    kinds = {kind: judge(belief, models, normalizers, rows) for kind, rows in stored._asdict().items()}
    return Verdict(name, kinds, metrics, milliseconds)


def table(verdicts: Sequence[Verdict]) -> str:
    """The verdicts as text: means over fits."""
    head = (
        "environment",
        "transitions",
        "error",
        "variance",
        "error / variance",
        "rank",
        "within",
        "ms a step",
        "dead features",
    )
    lines = []
    for name in dict.fromkeys(one.environment for one in verdicts):
        own = [one for one in verdicts if one.environment == name]
        for kind in own[0].kinds:
            found = [one.kinds[kind] for one in own]
            ratio = float(np.exp(np.mean(np.log([one.ratio for one in found]))))
            values = (np.mean([one.error for one in found]), np.mean([one.variance for one in found]), ratio)
            within = [one.within for one in found if one.within is not None]
            dead = [one.metrics["dead_features"] for one in own if "dead_features" in one.metrics]
            lines.append(
                (
                    *(name, kind, *(number(float(value)) for value in values)),
                    f"{np.mean([one.rank for one in found]):.2f}",
                    number(float(np.mean(within))) if within else "-",
                    f"{np.median([one.milliseconds for one in own]):.1f}",
                    f"{np.mean(dead):.0%}" if dead else "-",
                )
            )
    return text_table(head, lines)


def parse(argv: Sequence[str]) -> tuple[list[str], int, int, Path | None, list[str]]:
    """This command's own flags, and the words that are left for `experiments.run`."""
    own = {name: flags.option(argv, name) for name in OWN}
    rest, skip = [], False
    for word in argv:
        name = word.partition("=")[0].removeprefix("--")
        if skip or name in OWN:
            skip = not skip and "=" not in word
            continue
        rest.append(word)
    data = own["data"].split(",") if own["data"] else [*transitions.names(), "gaussian_process"]
    for name in data:
        if name not in (*transitions.names(), "gaussian_process"):
            known = ", ".join([*transitions.names(), "gaussian_process"])
            raise ValueError(f"--data={name} is not known. Allowed: {known}.")
    for name in ("fit-steps", "fits"):
        if own[name] is not None and not (own[name] or "").isdecimal():
            raise ValueError(f"--{name}={own[name]}. Allowed: a whole number, 1 or more.")
    path = Path(own["json"]) if own["json"] else None
    return data, int(own["fit-steps"] or STEPS), int(own["fits"] or 1), path, rest


def main(argv: Sequence[str] | None = None) -> int:
    """Fit, judge, print."""
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        if "--help" in argv or "-h" in argv:
            print(f"{__doc__}\n{HELP}")
            return 0
        data, steps, fits, path, rest = parse(argv)
        runtime.use_compilation_cache()
        config = command.parse(rest)[1].config
        verdicts, known = [], []
        for seed in range(fits):
            for name in data:
                if name == "gaussian_process":
                    known.append(gaussian_process.divergences(config.method, config.explorer, steps, seed))
                else:
                    verdicts.append(verdict(name, config.method, config.explorer, steps, seed))
    except (ValueError, RunError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if verdicts:
        print(table(verdicts))
    if known:
        print(gaussian_process.table(known))
    if path is not None:
        found = {
            "words": rest,
            "steps": steps,
            "stored": [
                {**one._asdict(), "kinds": {kind: value._asdict() for kind, value in one.kinds.items()}}
                for one in verdicts
            ],
            "gaussian_process": [one._asdict() for one in known],
        }
        path.write_text(json.dumps(found, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    process.carry_out(main)
