"""Any MuJoCo Playground environment: `make("playground:CartpoleBalance")`. Pure JAX, on MJX.

See `envs.adapters.brax_like` for what becomes of its parts. Observations (of several, the one named "state"), actions
in [-1, 1], rewards and the length of an episode are Playground's own. The control suite (`CartpoleBalance`,
`PendulumSwingup`, ...) ships with the package; for most robots Playground downloads their models the first time.
Coverage: see `envs.coverage.make_generic_coverage`.
"""

import functools
import warnings
from typing import Any

from envs.adapters import brax_like, check_known
from envs.base import Environment
from jaxplore import validate
from jaxplore.validate import FieldError

BACKEND = "mjx"


@functools.cache
def load() -> Any:
    """Playground's registry. Raises `FieldError` where the package is missing."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
            from mujoco_playground import registry  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        problem = f'needs the package playground ({error}). Install the extra: pip install -e ".[playground]".'
        raise FieldError("env", "playground:...", "packages that are installed", problem) from error
    return registry


def check_name(name: str) -> None:
    """Raise `FieldError` unless Playground has an environment of this name, and is there."""
    check_known("playground", name, load().ALL_ENVS)


def make_environment(
    name: str, backend: str = "auto", obs_noise: float = 0.0, episode_steps: int | None = None
) -> Environment:
    """The Playground environment called `name`.

    Args:
        name: as Playground registers it.
        backend: `auto` or `mjx`.
        obs_noise: standard deviation of Gaussian noise added to every observation entry, in raw units.
        episode_steps: steps after which an episode is truncated; by default Playground's own number.

    Raises:
        FieldError: an unknown name or backend, an environment whose files cannot be had, pictures for observations, or
            a bad number.
    """
    check_name(name)
    validate.one_of("backend", backend, ("auto", BACKEND))
    registry = load()
    try:
        # Warp, the default, is another package and not exact from run to run.
        raw = registry.load(name, config_overrides={"impl": "jax"})
    except Exception as error:  # Models that are not there, and calls that MuJoCo has no more: anything.
        allowed = (
            "the control suite, such as playground:CartpoleBalance; robots need the network once, for Playground to "
            "download their models"
        )
        raise FieldError("env", f"playground:{name}", allowed, f"cannot be made here: {error}") from error
    steps = episode_steps if episode_steps is not None else int(registry.get_default_config(name).episode_length)
    return brax_like.make_environment(
        raw, f"playground:{name}", BACKEND, obs_noise, steps, raw.mj_model, lambda state: state.data.qpos
    )
