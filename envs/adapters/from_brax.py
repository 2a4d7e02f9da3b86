"""Any Brax environment: `make("brax:hopper")`. Pure JAX; see `envs.adapters.brax_like` for what becomes of its parts.

Observations, actions in [-1, 1] and rewards are Brax's own. Episodes are 1,000 steps, as Brax's own training has them.
Coverage: see `envs.coverage.make_generic_coverage`.
"""

import contextlib
import functools
import warnings
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import jax

from envs.adapters import brax_like, check_known
from envs.base import Environment
from envs.errors import raised
from jaxplore import validate
from jaxplore.validate import FieldError

BACKENDS = ("generalized", "mjx", "positional", "spring")
"""Brax's engines."""
NO_ENGINE = "jax"
"""What an environment without physics is stepped by, such as Brax's own toy, `fast`."""


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without the warnings that Brax makes of itself, which its user can do nothing about."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
        warnings.filterwarnings("ignore", "Brax System, piplines and environments", UserWarning)
        warnings.filterwarnings("ignore", "Accessing `\\w+` directly from `Data` is deprecated", DeprecationWarning)
        yield


@functools.cache
def load() -> ModuleType:
    """The module `brax.envs`. Raises `FieldError` where it is missing."""
    try:
        with quiet():
            import brax.envs
    except ImportError as error:
        problem = f"needs the package brax ({error}). Install it: pip install brax."
        raise FieldError("env", "brax:...", "packages that are installed", problem) from error
    return brax.envs


def check_name(name: str) -> None:
    """Raise `FieldError` unless Brax has an environment of this name, and is there."""
    check_known("brax", name, load()._envs)


def make_environment(
    name: str, backend: str = "auto", obs_noise: float = 0.0, episode_steps: int = 1_000
) -> Environment:
    """The Brax environment called `name`.

    Args:
        name: as Brax registers it.
        backend: one of Brax's engines, or `auto`: the environment's own choice; `jax` where there is no physics.
        obs_noise: standard deviation of Gaussian noise added to every observation entry, in raw units.
        episode_steps: steps after which an episode is truncated.

    Raises:
        FieldError: an unknown name or backend, an environment that Brax itself cannot step, observations that are not
            one vector, or a bad number.
    """
    check_name(name)
    if backend != NO_ENGINE:
        validate.one_of("backend", backend, ("auto", *BACKENDS))
    with quiet(), jax.numpy_rank_promotion("allow"):
        raw = load().get_environment(name, **({} if backend in ("auto", NO_ENGINE) else {"backend": backend}))
        model = getattr(getattr(raw, "sys", None), "mj_model", None)
        own = getattr(raw, "_backend", NO_ENGINE)
        if backend == NO_ENGINE != own:
            raise FieldError("backend", backend, f"auto, {', '.join(BACKENDS)}", "is for environments without physics")
        _check_runs(raw, name)
        return brax_like.make_environment(
            _Quiet(raw), f"brax:{name}", own, obs_noise, episode_steps, model, lambda state: state.pipeline_state.q
        )


def _check_runs(raw: Any, name: str) -> None:
    """Raise `FieldError` for an environment that Brax itself cannot step here; nothing is computed."""

    def first_step(key: Any) -> Any:
        return raw.step(raw.reset(key), jax.numpy.zeros(raw.action_size))

    try:
        jax.eval_shape(first_step, jax.random.key_data(jax.random.key(0)))
    except Exception as error:  # Old code against a new JAX raises anything.
        problem = f"cannot be stepped by this version of Brax and JAX: it {raised(error)}"
        raise FieldError("env", f"brax:{name}", "environments that Brax itself can run here", problem) from error


class _Quiet:
    """A Brax environment that is traced without its warnings."""

    def __init__(self, env: Any) -> None:
        # Brax's own toy has no physics, so no time either.
        self._env, self.action_size, self.dt = env, env.action_size, getattr(env, "dt", 1.0)

    def reset(self, key: Any) -> Any:
        with quiet():
            return self._env.reset(key)

    def step(self, state: Any, action: Any) -> Any:
        with quiet():
            return self._env.step(state, action)
