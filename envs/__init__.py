"""The environments, by name: `make("ant_maze", obs_noise=0.02)`. See `envs.base` for what an environment is."""

import inspect
from collections.abc import Callable
from typing import Any

from envs.acrobot import make_acrobot
from envs.ant_maze import make_ant_maze
from envs.base import Coverage, Environment, EnvSpec, EnvState, FloorPlan
from envs.half_cheetah import make_half_cheetah, make_half_cheetah_task
from envs.hand_block import make_hand_block
from envs.mountain_car import make_mountain_car
from envs.nchain import make_nchain
from jaxplore import validate

FACTORIES: dict[str, Callable[..., Environment]] = {
    "acrobot": make_acrobot,
    "ant_maze": make_ant_maze,
    "half_cheetah": make_half_cheetah,
    "half_cheetah_task": make_half_cheetah_task,
    "hand_block": make_hand_block,
    "mountain_car": make_mountain_car,
    "nchain": make_nchain,
}
"""Name of an environment, and what makes it. A new environment is one line here."""


def make(name: str, **options: Any) -> Environment:
    """The environment called `name`.

    Args:
        name: one of `FACTORIES`.
        **options: the factory's own arguments, such as `backend` and `obs_noise`.

    Raises:
        ValueError: an unknown name or option, with the nearest match and the list of those that are known; or an
            option's value that the factory refuses.
    """
    validate.one_of("env", name, FACTORIES)
    factory = FACTORIES[name]
    for option in options:
        validate.one_of(f"option of {name!r}", option, inspect.signature(factory).parameters)
    return factory(**options)


__all__ = ["FACTORIES", "Coverage", "EnvSpec", "EnvState", "Environment", "FloorPlan", "make"]
