"""The environments, by name: `make("ant_maze", obs_noise=0.02)`, `make("gymnasium:Pendulum-v1")`.

See `envs.base` for what an environment is. Importing this package also registers the ones in `FACTORIES` with
Gymnasium; see `envs.adapters.to_gymnasium`.
"""

import functools
import importlib
import inspect
from collections.abc import Callable
from typing import Any

from envs.acrobot import make_acrobot
from envs.adapters import to_gymnasium
from envs.ant_maze import make_ant_maze
from envs.base import Coverage, Environment, EnvSpec, EnvState, FloorPlan
from envs.half_cheetah import make_half_cheetah, make_half_cheetah_task, make_half_cheetah_transfer
from envs.hand_block import make_hand_block
from envs.mountain_car import make_mountain_car
from envs.nchain import make_nchain
from jaxplore import validate
from jaxplore.validate import FieldError

FACTORIES: dict[str, Callable[..., Environment]] = {
    "acrobot": make_acrobot,
    "ant_maze": make_ant_maze,
    "half_cheetah": make_half_cheetah,
    "half_cheetah_task": make_half_cheetah_task,
    "half_cheetah_transfer": make_half_cheetah_transfer,
    "hand_block": make_hand_block,
    "mountain_car": make_mountain_car,
    "nchain": make_nchain,
}
"""Name of an environment, and what makes it. A new environment is one line here."""

ADAPTERS = {
    "brax": "envs.adapters.from_brax",
    "gymnasium": "envs.adapters.from_gymnasium",
    "playground": "envs.adapters.from_playground",
}
"""Prefix of the names of other packages' environments, and the module that adapts them, imported when it is asked for.
It has `check_name(name)` and `make_environment(name, **options)`, `name` without the prefix."""


def check_name(name: str) -> None:
    """Raise unless there is an environment of this name: one of `FACTORIES`, or one of another package, such as
    `gymnasium:Pendulum-v1`, `brax:hopper` or `playground:CartpoleBalance`.

    Raises:
        FieldError: an unknown name or prefix, with the nearest match and what is allowed; a package that is missing,
            with what to install; or a module of somebody's that has not been imported, as reading a name imports none.
    """
    find_factory(name)


def find_factory(name: str) -> Callable[..., Environment]:
    """What makes the environment called `name`; its arguments are the options of `make`. Raises as `check_name`."""
    prefix, colon, own_name = str(name).partition(":")
    if not colon:
        # A name with a colon in it, which this one is not, so it is never taken for known.
        validate.one_of("env", name, [*FACTORIES, *(f"{prefix}:NAME" for prefix in ADAPTERS)])
        return FACTORIES[name]
    validate.one_of("env", f"{prefix}:NAME", (f"{known}:NAME" for known in ADAPTERS))
    adapter = importlib.import_module(ADAPTERS[prefix])
    adapter.check_name(own_name)
    return functools.partial(adapter.make_environment, own_name)


def make(name: str, **options: Any) -> Environment:
    """The environment called `name`.

    Args:
        name: one of `FACTORIES`, or one of another package as `check_name` describes.
        **options: the factory's own arguments, such as `backend` and `obs_noise`.

    Raises:
        FieldError: an unknown name or option, with the nearest match and the list of those that are known; a package
            that is missing; or an option's value that the factory refuses.
    """
    factory = find_factory(name)
    for option in options:
        validate.one_of(f"option of {name!r}", option, inspect.signature(factory).parameters)
    return factory(**options)


def backends(name: str) -> tuple[str, ...]:
    """The backends that `make(name, backend=...)` offers beside `"auto"`, as it says when it is asked for another.

    Example:
        >>> backends("ant_maze"), backends("nchain")
        (('mjx', 'mujoco'), ('jax',))
    """
    try:
        return (make(name, backend="?").backend,)
    except FieldError as error:
        if error.field != "backend":
            raise
        return tuple(backend for backend in error.allowed.split(", ") if backend != "auto")


to_gymnasium.register(FACTORIES)

__all__ = [
    "ADAPTERS",
    "FACTORIES",
    "Coverage",
    "EnvSpec",
    "EnvState",
    "Environment",
    "FloorPlan",
    "backends",
    "check_name",
    "find_factory",
    "make",
]
