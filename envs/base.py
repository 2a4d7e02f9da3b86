"""What an environment is: a spec and two functions, `reset(key)` and `step(state, action)`.

The same shape holds for environments whose physics runs on the device (MJX, pure JAX; `compiled=True`: jit, vmap and
scan as you like) and for those whose physics runs on the host (C MuJoCo; `compiled=False`: call them from Python, the
state holds NumPy arrays). In both the state is a pytree that holds *everything*: saving it and stepping from it again
gives the same numbers to the bit.

No environment resets itself. `Transition.next_obs` is always the true successor; anyone who collects calls `reset` when
`terminated` or `truncated` is set (`envs.stepper` has that loop for both kinds).
"""

import importlib
import math
import numbers
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import struct

from jaxplore import validate
from jaxplore.types import Array, Key, Transition
from jaxplore.validate import Checks, FieldError


@struct.dataclass
class EnvState:
    """Everything an environment needs to continue."""

    physics: Any
    """The engine's own state: `engines.mjx.MjxState`, C MuJoCo's integration state vector, or what `Rules` hold."""
    obs: Array
    """The observation that the agent sees now, `[O]`, float32, with observation noise if there is any."""
    num_steps: Array
    """Steps taken in this episode, int32."""
    key: Key
    """Source of the randomness still to come in this episode (observation noise)."""


@dataclass(frozen=True)
class EnvSpec:
    """What can be known of an environment without running it."""

    name: str
    obs_names: tuple[str, ...]
    """Name and unit of each observation entry, such as `"x [m]"`."""
    action_names: tuple[str, ...]
    """Name of each action entry, or of each choice where actions are discrete."""
    episode_steps: int
    """Steps after which an episode is truncated."""
    dt: float
    """Seconds between two steps."""
    discrete: bool = False
    """False: action entries are numbers in [-1, 1]. True: an action is one of `A` choices, as a one-hot `[A]`."""
    one_hot_obs: bool = False
    """Whether an observation is one of `O` states, as a one-hot vector `[O]`."""
    has_reward: bool = False
    """Whether `Transition.reward` is a task's. False: it is always 0, and nothing can be learned from it."""
    obs_limits: tuple[tuple[float, float], ...] | None = None
    """Lowest and highest value of each observation entry, infinite where there is none; None: not known."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        if not isinstance(self.name, str) or not self.name:
            raise checks.refusal("name", "names nothing", "a name")
        for field in ("obs_names", "action_names"):
            names = getattr(self, field)
            if isinstance(names, str) or not names or not all(isinstance(name, str) and name for name in names):
                raise checks.refusal(field, "names nothing", "one or more names")
        checks.at_least("episode_steps", 1)
        checks.in_range("dt", 0.0, open_low=True)
        if self.obs_limits is not None and len(self.obs_limits) != len(self.obs_names):
            allowed = f"{len(self.obs_names)} pairs, one for each of obs_names"
            raise checks.refusal("obs_limits", f"are {len(self.obs_limits)}", allowed)

    @property
    def obs_size(self) -> int:
        """Entries of an observation (`O`)."""
        return len(self.obs_names)

    @property
    def action_size(self) -> int:
        """Entries of an action (`A`)."""
        return len(self.action_names)


class Coverage(NamedTuple):
    """Which parts of an environment have been seen: a fixed set of cells and a look-up. Pure JAX, unbatched."""

    num_cells: int
    cell: Callable[[Array], Array]
    """`cell(obs [O]) -> int32`: the cell that an observation lies in, 0 to num_cells - 1, or -1 outside of all."""
    unit: str
    """What a cell is, for axis labels, such as `"maze cells"`."""
    reachable: int | None = None
    """How many of the cells can be reached, where that is known and not all: shown wherever coverage is."""

    @property
    def size(self) -> str:
        """How many cells there are, in words: `"7"`, or `"512, of which 256 can be reached"`."""
        rest = "" if self.reachable is None else f", of which {self.reachable:,} can be reached"
        return f"{self.num_cells:,}{rest}"


class FloorPlan(NamedTuple):
    """A view from above, for pictures. Metres."""

    position: tuple[int, int]
    """Indices of x and y in the observation."""
    walls: tuple[tuple[float, float, float, float], ...]
    """Axis-aligned boxes `(x_min, y_min, x_max, y_max)`."""
    cells: tuple[tuple[float, float, float, float], ...]
    """The coverage cells, in the order of their index."""


class View(NamedTuple):
    """How an environment is drawn; `envs.views` makes them."""

    frames: Callable[[Iterable[EnvState], int, int, str], Iterator[np.ndarray]]
    """`frames(states, height, width, camera)`: one uint8 `[height, width, 3]` per state, drawn as it is asked for."""
    cameras: tuple[str, ...]
    """Where it can be looked at from; the first is the usual place."""
    needs_renderer: bool
    """Whether drawing takes an OpenGL library."""


@dataclass(frozen=True)
class Environment:
    """An environment. See the module's text for the contract."""

    spec: EnvSpec
    reset: Callable[[Key], EnvState]
    """`reset(key) -> state`, the same state for the same key."""
    step: Callable[[EnvState, Array], tuple[EnvState, Transition]]
    """`step(state, action [A]) -> (state, transition)`; `transition.next_obs` is the new state's observation."""
    coverage: Coverage
    backend: str
    """Which engine steps it, such as `"mjx"` or `"mujoco"`."""
    compiled: bool
    """True: pure JAX. False: runs on the host, one environment a call."""
    floor_plan: FloorPlan | None = None
    view: View | None = None
    reset_all: Callable[[Key], tuple[EnvState, ...]] | None = None
    """On the host: `reset_all(keys [S]) -> states`, what `reset` gives for each key. None: one after the other."""
    step_all: Callable[[tuple[EnvState, ...], np.ndarray], tuple[tuple[EnvState, ...], Transition]] | None = None
    """On the host: `step_all(states, actions [S, A]) -> (states, transitions [S])`, what `step` gives for each state.
    None: one after the other."""
    reset_in: Callable[[Key, int], EnvState] | None = None
    """`reset_in(key, cell) -> state`: a start in one of the coverage cells, for asking what an agent knows of a place
    that it has not been to; no run begins there. None: this environment cannot be put where one likes."""


class Physics(NamedTuple):
    """A physics engine with one model in it. The state holds everything it needs to continue, to the bit."""

    init: Callable[[Array, Array], Any]
    """`init(qpos [nq], qvel [nv]) -> physics`: at rest otherwise."""
    step: Callable[[Any, Array], Any]
    """`step(physics, ctrl [nu]) -> physics`: one environment step, with `ctrl` held over all its substeps."""
    qpos: Callable[[Any], Array]
    """`qpos(physics) -> [nq]`, metres and radians."""
    qvel: Callable[[Any], Array]
    """`qvel(physics) -> [nv]`, per second."""


class Task(NamedTuple):
    """All that an environment on top of MuJoCo is beside its engine; the engines' `make_environment` runs it."""

    spec: EnvSpec
    model: Any
    """A `mujoco.MjModel`."""
    frame_skip: int
    """Substeps of `model.opt.timestep` in one environment step."""
    start: Callable[[Key], tuple[Array, Array]]
    """`start(key) -> (qpos [nq], qvel [nv])`, in JAX: the state an episode begins in."""
    observe: Callable[[ModuleType, Array, Array, Array], Array]
    """`observe(xp, qpos_before [nq], qpos [nq], qvel [nv]) -> [O]`; `xp` is `numpy` or `jax.numpy`. The positions are
    those before and after the step, equal at a reset."""
    reward: Callable[[ModuleType, Array, Array, Array, Array], Array | float]
    """`reward(xp, action [A], qpos_before [nq], qpos [nq], qvel [nv])`, of the step that led there."""
    coverage: Coverage
    cameras: tuple[str, ...]
    """Names of the model's cameras, the usual one first."""
    floor_plan: FloorPlan | None = None
    start_in: Callable[[Key, int], tuple[Array, Array]] | None = None
    """`start_in(key, cell)`: as `start`, in a coverage cell; see `Environment.reset_in`."""
    control: Callable[[ModuleType, Array], Array] = lambda xp, action: action
    """`control(xp, action [A]) -> ctrl [nu]`, of an action in [-1, 1]."""


ENGINES = {"mjx": "envs.engines.mjx", "mujoco": "envs.engines.host"}
"""Name of a backend, and the module that runs a `Task` on it, imported when it is asked for."""


def choose_engine(backend: str) -> ModuleType:
    """The module that runs a `Task` on `backend`: `"mjx"`, `"mujoco"`, or `"auto"` (MuJoCo on a CPU, else MJX).

    Raises `FieldError` for any other name.
    """
    validate.one_of("backend", backend, ("auto", *ENGINES))
    if backend == "auto":
        backend = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    return importlib.import_module(ENGINES[backend])


def check_noise(obs_noise: float) -> float:
    """Returns `obs_noise`. Raises `FieldError` unless it is a finite number of at least 0."""
    if not (isinstance(obs_noise, numbers.Real) and math.isfinite(obs_noise) and obs_noise >= 0):
        allowed = "a finite standard deviation of at least 0, in raw units"
        raise FieldError("obs_noise", obs_noise, allowed, "is out of range")
    return float(obs_noise)
