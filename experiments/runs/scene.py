"""What reports must know of a run's environment and agent, saved with the run so that they build neither."""

import dataclasses
import json
from dataclasses import dataclass
from typing import Any, NamedTuple

from envs.base import Environment, FloorPlan
from jaxplore.exploration import Explorer


class Cells(NamedTuple):
    """What coverage counts: `envs.base.Coverage` without the look-up."""

    num_cells: int
    unit: str
    reachable: int | None = None

    @property
    def size(self) -> str:
        """How many cells there are, in words: `"7"`, or `"512, of which 256 can be reached"`."""
        rest = "" if self.reachable is None else f", of which {self.reachable:,} can be reached"
        return f"{self.num_cells:,}{rest}"


@dataclass(frozen=True)
class Scene:
    """Where a run takes place, and in which unit its agent is rewarded."""

    coverage: Cells
    floor_plan: FloorPlan | None
    episode_steps: int
    """Steps after which an episode is truncated."""
    obs_size: int
    action_size: int
    has_reward: bool
    """Whether there is a task."""
    has_view: bool
    """Whether it can be drawn."""
    reward_unit: str | None
    """Of the intrinsic reward; None: the method has none."""
    variance_unit: str
    """Of equation 1 on the belief's predictions."""


def scene_of(env: Environment, explorer: Explorer, one_hot: bool) -> Scene:
    """The scene of an environment and an agent; `one_hot`: whether models predict probabilities."""
    spec, coverage = env.spec, env.coverage
    return Scene(
        Cells(coverage.num_cells, coverage.unit, coverage.reachable),
        env.floor_plan,
        spec.episode_steps,
        spec.obs_size,
        spec.action_size,
        spec.has_reward,
        env.view is not None,
        explorer.reward_unit,
        "probability, squared" if one_hot else "normalised delta, squared",
    )


def to_json(scene: Scene) -> str:
    """A scene as indented JSON."""
    data = dataclasses.asdict(scene)
    data["coverage"] = scene.coverage._asdict()
    data["floor_plan"] = scene.floor_plan and scene.floor_plan._asdict()
    return json.dumps(data, indent=2) + "\n"


def from_json(data: dict[str, Any]) -> Scene:
    """A scene from what `to_json` writes.

    Raises:
        ValueError: it is none.
    """
    try:
        plan = data["floor_plan"]
        boxes = plan and {name: tuple(map(tuple, plan[name])) for name in ("walls", "cells")}
        floor_plan = plan and FloorPlan(tuple(plan["position"]), **boxes)
        scene = Scene(**{**data, "coverage": Cells(**data["coverage"]), "floor_plan": floor_plan})
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"not a scene: {error!r}") from error
    _check(scene)
    return scene


def _check(scene: Scene) -> None:
    """Raise `ValueError` for what pictures and tables cannot be made of."""
    cells, plan = scene.coverage, scene.floor_plan
    counts = (cells.num_cells, scene.episode_steps, scene.obs_size, scene.action_size)
    texts = (cells.unit, scene.variance_unit, *([scene.reward_unit] if scene.reward_unit is not None else []))
    good = all(type(count) is int and count > 0 for count in counts) and all(isinstance(one, str) for one in texts)
    good &= cells.reachable is None or (type(cells.reachable) is int and 0 < cells.reachable <= cells.num_cells)
    if plan is not None:
        boxes = (*plan.walls, *plan.cells)
        good &= len(plan.position) == 2 and all(type(at) is int for at in plan.position)
        good &= all(len(box) == 4 and all(isinstance(edge, int | float) for edge in box) for box in boxes)
    if not good:
        raise ValueError("not a scene: it holds values that no environment has")
