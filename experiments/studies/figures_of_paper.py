"""What the paper shows: its figures and its table, each with its claim, the runs it needs, and what would decide it.

Ratzlaff, Bai, Li, Xu, "Implicit Generative Modeling for Efficient Exploration", ICML 2020. `methods` and `beliefs` go
beyond it.
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from experiments.analysis.measures import CELLS, COVERAGE, RETURN, VARIANCE, VISITS, WHOLE, Measure
from experiments.analysis.verdicts import Condition, ahead, at_least, at_most, falls, ranks, rises
from experiments.runs.config import RunConfig, replace
from experiments.runs.presets import preset_config
from jaxplore import METHODS, validate

WarmUp = Literal["uniform", "policy", "none"]

SMOKE_SEEDS = 2
"""Of every cell with the smoke preset: the fewest that have an interval."""
OWN_SEEDS = {"laptop": {"seed": 20}}
"""The laptop preset's settings were chosen on seeds below, which so show nothing."""
TEN_SEEDS = {"laptop": {"seed": 20, "num_seeds": 10}}
"""Where five decide too little: after the first five of the acrobot ours looked far clearer ahead than after ten."""


class Cell(NamedTuple):
    """One line of a figure: runs that differ in their seed alone."""

    label: str
    env: str
    method: str
    seeds: int
    """The paper's, counting up from 0; settings may say others."""
    steps: Mapping[str, int]
    """Of each preset."""
    settings: Mapping[str, Any] = {}
    """Fields of `RunConfig`, nested, on top of the preset's."""
    by_preset: Mapping[str, Mapping[str, Any]] = {}
    """The same for one preset each, on top of those."""
    parent: "Cell | None" = None
    """The runs whose policies these start from, seed by seed."""
    parent_at: Mapping[str, int] = {}
    """The parent's step of each preset; without one, its end."""
    keep_at: Mapping[str, tuple[int, ...]] = {}
    """Of each preset, the steps whose checkpoints others start from."""
    warm_up: WarmUp | None = None
    """Who acts in the warm-up: a policy that came from a parent, nobody (there is none), or chance. None: as the
    preset has it."""


class Testbed(NamedTuple):
    """A belief that is fitted to stored transitions, without an environment (`benchmarks.beliefs`)."""

    label: str
    method: str


class Part(NamedTuple):
    """One picture of a figure."""

    title: str
    measure: Measure
    cells: tuple[Cell, ...]
    smoke: tuple[str, ...] | None = None
    """Labels that the smoke preset has; None: all."""

    def of(self, preset: str) -> list[Cell]:
        """The cells of a preset."""
        return [cell for cell in self.cells if preset != "smoke" or self.smoke is None or cell.label in self.smoke]


class Figure(NamedTuple):
    """One of the paper's figures, or its table."""

    name: str
    title: str
    source: str
    """Where the paper shows it."""
    claim: str
    parts: tuple[Part, ...]
    conditions: tuple[Condition, ...] = ()
    """The claim holds if all of them do, and does not if one of them does not."""
    printed: Mapping[str, str] = {}
    """Label -> the number that the paper prints, as it prints it."""
    testbeds: tuple[Testbed, ...] = ()
    unasked: str = ""
    """What of the claim no condition asks, and why."""


OURS, CHAIN_SEEDS, CONTROL_SEEDS, TRANSFER_SEEDS = "implicit", 3, 5, 3
RIVALS = ("max", "icm", "disagreement")

CHAIN_STEPS = {"paper": 735, "laptop": 735, "smoke": 98}
"""15 episodes of 49 steps."""
ACROBOT_STEPS = {"paper": 1_000, "laptop": 1_000, "smoke": 100}
EXPLORE_STEPS = {"paper": 10_000, "laptop": 10_000, "smoke": 100}
MAZE_STEPS = {**EXPLORE_STEPS, "laptop": 5_500}
"""By 5,500 the paper's agent has seen the whole maze on every seed."""
TASK_STEPS = {"paper": 1_000_000, "laptop": 100_000, "smoke": 100}
"""Of a task's policy, the exploration before it included."""
WARM_UP_STEPS = {"paper": 10_000, "laptop": 10_000, "smoke": 50}
LENGTHS = {"2k": 2_000, "4k": 4_000, "6k": 6_000, "8k": 8_000}
AT = {"paper": LENGTHS, "laptop": LENGTHS, "smoke": dict.fromkeys(LENGTHS, 75)}
"""Steps of exploration, by the name that the paper gives them."""

BELIEFS = (OURS, "disagreement", "max")
FEW = (OURS, *RIVALS, "disagreement_grad", "implicit_reactive", "max_trajectory", "rnd_active", "random")
"""Methods that the smoke preset shows of all: those of other figures, and one of each further kind."""
SMOKE_EXPLORER = {"warm_up_steps": 50}
OF_RUN = {**OWN_SEEDS, "smoke": {"checkpoint_every": 50, "explorer": SMOKE_EXPLORER}}
OF_CHAIN = {**OWN_SEEDS, "smoke": {"checkpoint_every": 49, "explorer": {"warm_up_steps": 49}}}


def _merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    both = dict(below)
    for name, value in above.items():
        both[name] = _merge(both.get(name, {}), value) if isinstance(value, Mapping) else value
    return both


def _cells(
    env: str, methods: tuple[str, ...], seeds: int, steps: Mapping[str, int], more: Mapping[str, Any] | None = None
) -> tuple[Cell, ...]:
    by_preset = _merge(OF_CHAIN if env == "nchain" else OF_RUN, more or {})
    return tuple(Cell(method, env, method, seeds, steps, by_preset=by_preset) for method in methods)


CHAIN = _cells("nchain", (OURS, "max", "icm", "disagreement", "ddqn"), CHAIN_SEEDS, CHAIN_STEPS)
ACROBOT = _cells("acrobot", (OURS, *RIVALS), CONTROL_SEEDS, ACROBOT_STEPS, TEN_SEEDS)
ANT = _cells("ant_maze", (OURS, "random", "icm", "disagreement", "max"), CONTROL_SEEDS, MAZE_STEPS, TEN_SEEDS)
HAND = _cells("hand_block", (OURS, *RIVALS), CONTROL_SEEDS, EXPLORE_STEPS)

TASK = "half_cheetah_transfer"
"""As the paper's authors have it: seen in MAX's way, without the angle that somersaults wind up without end."""
SAME_WIDTHS = {"laptop": (128, 128), "smoke": (32, 32), "paper": (256, 256)}
"""Of SAC's networks while it explores and on the task: one takes over the other's."""
SAME_FORM = {"activation": "relu", "log_std_map": "clip", "log_std_min": -20.0, "log_std_max": 2.0}
"""The rest of what a policy's parameters mean: as SAC's authors have it on the task."""
SAC_EXPLORING = {"lr": 1e-3, "alpha": 0.02, "reward_scale": 1.0}
"""SAC on the task with the numbers that exploration has; the paper's table has both."""
LIFE = {"imagination": {"restart_every": 20}, "reactive": {"restart_every": 20}}
"""With the laptop preset a policy lives for several rounds, and 2,000 steps are 80 of them: with a life that divides
80, here one of 20 rounds, the policy that is handed on has learned for 11 whatever the length of the exploration."""


def _explorer(method: str) -> Cell:
    """Exploration on the task's environment, with a policy of the form that the task's has."""
    by_preset = dict(OF_RUN)
    for preset, hidden in SAME_WIDTHS.items():
        life = LIFE if preset == "laptop" else {}
        sac = {"sac": {**SAME_FORM, "hidden": hidden}}
        by_preset[preset] = _merge(OF_RUN.get(preset, {}), {"explorer": {**sac, **life}})
    return _cells(TASK, (method,), TRANSFER_SEEDS, EXPLORE_STEPS)[0]._replace(by_preset=by_preset)


PARENTS = {method: _explorer(method) for method in (OURS, *RIVALS)}
PARENTS[OURS] = PARENTS[OURS]._replace(
    keep_at={preset: tuple(dict.fromkeys(AT[preset].values())) for preset in ("paper", "laptop", "smoke")}
)


def _task(label: str, parent: Cell | None, warm_up: WarmUp, at: str = "", *, exploring: bool = False) -> Cell:
    """SAC on the task: from a parent's policy or from nothing, with a warm-up or without."""
    parent_at = {preset: AT[preset][at] for preset in TASK_STEPS} if at else {}
    by_preset = {}
    for preset, total in TASK_STEPS.items():
        sac: dict[str, Any] = {"hidden": SAME_WIDTHS[preset]}
        if exploring:
            sac |= {**SAC_EXPLORING, "batch_size": 4096 if preset == "paper" else 256}
        explorer = {"data_capacity": total + 1, "warm_up_steps": WARM_UP_STEPS[preset], "task_sac": sac}
        times = {"checkpoint_every": 50, "eval_every": 50, "eval_episodes": 1}
        if preset != "smoke":
            times = {"checkpoint_every": 10_000, "eval_every": 5_000}
        by_preset[preset] = {**OWN_SEEDS.get(preset, {}), **times, "explorer": explorer}
    before = {preset: parent_at.get(preset, EXPLORE_STEPS[preset]) if parent else 0 for preset in TASK_STEPS}
    # Of the smoke preset nothing is left after the parent's.
    steps = {name: total - (0 if name == "smoke" else before[name]) for name, total in TASK_STEPS.items()}
    return Cell(label, TASK, "sac", TRANSFER_SEEDS, steps, {}, by_preset, parent, parent_at, warm_up=warm_up)


SAC_WARM, SAC_COLD = _task("sac", None, "uniform"), _task("sac", None, "none")
WARM = tuple(_task(method, parent, "policy") for method, parent in PARENTS.items())
COLD = tuple(_task(method, parent, "none") for method, parent in PARENTS.items())
INIT = tuple(_task(f"init-{name}", PARENTS[OURS], "policy", name) for name in LENGTHS)
INIT = (*INIT, WARM[0]._replace(label="init-10k"))
TABLE = {
    "ours, SAC's settings": COLD[0],
    "ours with warm-up, SAC's settings": WARM[0],
    "sac, SAC's settings": SAC_COLD,
    "sac with warm-up, SAC's settings": SAC_WARM,
    "ours, exploration's settings": _task("", PARENTS[OURS], "none", exploring=True),
    "ours with warm-up, exploration's settings": _task("", PARENTS[OURS], "policy", exploring=True),
    "sac, exploration's settings": _task("", None, "none", exploring=True),
    "sac with warm-up, exploration's settings": _task("", None, "uniform", exploring=True),
}
WARMTHS = ("", " with warm-up")
OF_TABLE = ("9701 +- 210", "10999 +- 355", "7273 +- 537", "9363 +- 277")
OF_TABLE = (*OF_TABLE, "9631 +- 559", "11269 +- 395", "6902 +- 696", "9321 +- 677")


def _full(env: str, steps: Mapping[str, int]) -> tuple[Cell, ...]:
    more = {} if env == "hand_block" else TEN_SEEDS
    return _cells(env, (OURS, "disagreement", "disagreement_grad"), CONTROL_SEEDS, steps, more)


def _all_methods(env: str, steps: Mapping[str, int], *, has_task: bool) -> tuple[Cell, ...]:
    fit = [name for name, row in METHODS.items() if row.actions != "discrete" and (has_task or not row.needs_reward)]
    return _cells(env, tuple(fit), CONTROL_SEEDS if env == "acrobot" else 3, steps)


def figures() -> dict[str, Figure]:
    """Every figure by its name, in the paper's order."""
    maze, hand = "The Ant maze", "The hand and the block"
    found = [
        Figure(
            "chain",
            "The chain of 40 states",
            "Figure 2",
            "Ours and MAX reach the end of the chain within 15 episodes, sooner than ICM and disagreement, while "
            "double DQN sees no more than 40 % of it.",
            (Part("Share of the 40 states", COVERAGE._replace(over="episodes"), CHAIN),),
            (
                *(at_least(one, 1.0) for one in (OURS, "max")),
                *(ahead(one, other) for one in (OURS, "max") for other in ("icm", "disagreement")),
                ahead(OURS, "ddqn"),
                at_most("ddqn", 0.4),
            ),
        ),
        Figure(
            "acrobot",
            "Both horizontals of the acrobot",
            "Figure 3",
            "All four intrinsic rewards have the acrobot fully horizontal on either side within hundreds of steps, and "
            "ours is the quickest.",
            (Part("Poses seen", WHOLE, ACROBOT),),
            (*(at_least(one, 1.0) for one in (OURS, *RIVALS)), *(ahead(OURS, other) for other in RIVALS)),
        ),
        Figure(
            "ant_coverage",
            "Cells of the Ant maze",
            "Figure 4a",
            "Ours comes to the end of the maze on every seed, and sooner than all others.",
            (Part("Share of the 7 cells", COVERAGE, ANT),),
            (at_least(OURS, 1.0), *(ahead(OURS, cell.method) for cell in ANT[1:])),
        ),
        Figure(
            "ant_reward",
            "Equation 1 in the Ant maze",
            "Figure 4b",
            "The variance of ours rises while there is something to find and stays high until the maze is seen; that "
            "of MAX's ensemble falls from step 2,000 on.",
            (Part("Equation 1 on the transitions just met, mean of each round", VARIANCE, (ANT[0], ANT[4])),),
            (rises(OURS), falls("max"), ahead(OURS, "max")),
            unasked="from which step on MAX's falls.",
        ),
        Figure(
            "ant_visits",
            "Where the ant has been",
            "Figure 5",
            "Over five seeds our agent takes many ways through the maze and leaves no large part of it out.",
            (Part("Every step of all seeds", VISITS, ANT[:1]),),
            (at_least(OURS, 1.0),),
            unasked="whether its ways are many, which the picture shows.",
        ),
        Figure(
            "hand",
            "Rotations of the block",
            "Figure 6b",
            "Ours turns the block through more of the 512 rotations than the others, clearly; none sees half of them.",
            (Part("Share of the 512 rotations", CELLS, HAND),),
            tuple(ahead(OURS, other) for other in RIVALS),
            unasked="that none sees half of the 512, as no more than 256 of them can be reached.",
        ),
        Figure(
            "transfer",
            "HalfCheetah from an explorer's policy, with its warm-up",
            "Figure 7a",
            "SAC that starts from the policy of any explorer, which also acts in the warm-up, is ahead of SAC with a "
            "uniform warm-up, and most of all from ours.",
            (Part("Return", RETURN, (*WARM, SAC_WARM)),),
            (*(ahead(one, "sac") for one in RIVALS), *(ahead(OURS, other) for other in (*RIVALS, "sac"))),
        ),
        Figure(
            "transfer_length",
            "HalfCheetah after 2,000 to 10,000 steps of exploration",
            "Figure 7b",
            "The longer ours has explored, the better the task's policy becomes; 2,000 steps improve on SAC, and from "
            "4,000 on it is strictly ahead.",
            (Part("Return", RETURN, (*INIT, SAC_WARM)),),
            (*(ahead(cell.label, "sac") for cell in INIT), ahead("init-10k", "init-2k")),
        ),
        Figure(
            "transfer_cold",
            "HalfCheetah from an explorer's policy, without a warm-up",
            "Figure 9",
            "Without a warm-up SAC is far worse; an explorer's policy to start from makes up for it, ours most.",
            (Part("Return", RETURN, (*COLD, SAC_COLD)),),
            (*(ahead(one, "sac") for one in RIVALS), *(ahead(OURS, other) for other in (*RIVALS, "sac"))),
            unasked="how much worse SAC is than with a warm-up, which Table 2 shows.",
        ),
        Figure(
            "table_sac",
            "HalfCheetah under both settings of SAC",
            "Table 2",
            "SAC alone does best with its authors' settings, with and without a warm-up, and ours is ahead of it under "
            "both settings.",
            (Part("Return", RETURN, tuple(cell._replace(label=label) for label, cell in TABLE.items())),),
            tuple(
                ahead(f"ours{warm}, {whose} settings", f"sac{warm}, {whose} settings")
                for whose in ("SAC's", "exploration's")
                for warm in WARMTHS
            )
            + tuple(ahead(f"sac{warm}, SAC's settings", f"sac{warm}, exploration's settings") for warm in WARMTHS),
            dict(zip(TABLE, OF_TABLE, strict=True)),
        ),
        Figure(
            "disagreement_full",
            "Disagreement with its differentiable reward",
            "Appendix, figure on the full method",
            "Climbing the reward's gradient improves on disagreement as a mere reward; ours stays the most efficient.",
            (
                Part("The acrobot", WHOLE, _full("acrobot", ACROBOT_STEPS)),
                Part(maze, COVERAGE, _full("ant_maze", MAZE_STEPS)),
                Part(hand, CELLS, _full("hand_block", EXPLORE_STEPS)),
            ),
            tuple(
                ahead(first, second, part)
                for part in range(3)
                for first, second in (
                    ("disagreement_grad", "disagreement"),
                    (OURS, "disagreement"),
                    (OURS, "disagreement_grad"),
                )
            ),
        ),
        Figure(
            "rnd_psne",
            "RND and PSNE",
            "Appendix, figure on other exploration methods",
            "Ours makes a better task's policy than RND and PSNE on HalfCheetah, and is quicker in the maze than RND.",
            (
                Part("HalfCheetah, return", RETURN, (WARM[0], *_baselines())),
                Part(maze, COVERAGE, (ANT[0], *_cells("ant_maze", ("rnd",), CONTROL_SEEDS, MAZE_STEPS, TEN_SEEDS))),
            ),
            (ahead(OURS, "rnd"), ahead(OURS, "psne"), ahead(OURS, "rnd", 1)),
        ),
        Figure(
            "transfer_today",
            "HalfCheetah, beside what seeks information while it learns the task",
            "beyond the paper",
            "A policy that explored first is as good at the task as one that seeks its models' information on the way "
            "(MaxInfoRL, Sukhija et al. 2024), with either belief.",
            (Part("Return", RETURN, (WARM[0], *_beside("maxinfo", "maxinfo_implicit", "sac_v2"))),),
            (ahead(OURS, "maxinfo"), ahead(OURS, "sac_v2"), ahead("maxinfo_implicit", "maxinfo")),
        ),
        Figure(
            "methods",
            "Every method",
            "beyond the paper",
            "Whatever seeks what its models do not know explores sooner than uniform actions.",
            (
                Part("The acrobot", WHOLE, _all_methods("acrobot", ACROBOT_STEPS, has_task=True), FEW),
                Part(maze, COVERAGE, _all_methods("ant_maze", MAZE_STEPS, has_task=False), ()),
            ),
            tuple(ahead(one, "random", part) for part in range(2) for one in (OURS, *RIVALS)),
        ),
        Figure(
            "beliefs",
            "Every belief on the testbed",
            "beyond the paper",
            "A belief knows what it does not know: its variance ranks its errors, also on transitions unlike its data.",
            (),
            tuple(ranks(method) for method in BELIEFS),
            testbeds=tuple(Testbed(method, method) for method in BELIEFS),
            unasked="whether the size of the variance is that of the errors, which the table shows.",
        ),
    ]
    return {figure.name: figure for figure in found}


def _beside(*methods: str) -> tuple[Cell, ...]:
    """Other methods at the task, for as long as SAC."""
    return tuple(SAC_WARM._replace(label=method, method=method, warm_up=None) for method in methods)


def _baselines() -> tuple[Cell, ...]:
    """RND weighs the task's advantage twice as its own (Burda et al. 2019); PSNE has nothing but the task's."""
    rnd, psne = _beside("rnd", "psne")
    weights = {"explorer": {"ppo": {"extrinsic_weight": 2.0}}}
    return rnd._replace(by_preset={preset: _merge(rnd.by_preset[preset], weights) for preset in TASK_STEPS}), psne


def choose(names: tuple[str, ...]) -> list[Figure]:
    """The figures of these names, in the paper's order; without names, all.

    Raises:
        FieldError: a name that is not known, with the nearest.
    """
    known = figures()
    for name in names:
        validate.one_of("figure", name, known)
    return [figure for name, figure in known.items() if not names or name in names]


def config_of(cell: Cell, preset: str) -> RunConfig:
    """The configuration of a cell's runs: its first seed, and how many there are.

    Args:
        cell: of a figure.
        preset: `laptop`, `paper` or `smoke`.

    Raises:
        FieldError: the cell sets a field that is not known, or to a value that is refused.
    """
    config = preset_config(preset, cell.env, cell.method)
    changes: dict[str, Any] = {
        "steps": cell.steps[preset],
        "num_seeds": SMOKE_SEEDS if preset == "smoke" else cell.seeds,
    }
    for more in (cell.settings, cell.by_preset.get(preset, {})):
        changes = _merge(changes, more)
    if cell.keep_at:
        changes["keep_at"] = cell.keep_at[preset]
    if cell.warm_up is not None:
        changes["warm_up"] = cell.warm_up
    return replace(config, changes)
