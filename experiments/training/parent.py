"""Runs that start from another run's policy."""

import dataclasses
import re
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from envs.base import Environment
from experiments.runs.config import RunConfig, flag
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.inherit import conflicts
from experiments.runs.spec import RunRef
from experiments.runs.status import Status
from experiments.training import build
from experiments.training.loop import last_state
from experiments.training.programs import RunState
from jaxplore.exploration import Actor, Explorer
from jaxplore.types import Array
from jaxplore.validate import FieldError


def resolve(ref: RunRef, env: Environment, agent: Explorer, config: RunConfig) -> RunRef:
    """A reference with its step and identity filled in, checked against the run that is to start from it.

    A run that is not finished has come to the checkpoints that it has, so one of them that is named is as good as
    later; which one is its latest, changes.

    Args:
        ref: the parent, as it was written.
        env: where the new run takes place.
        agent: of the new run.
        config: of the new run.

    Raises:
        FieldError: it is no run, has no such checkpoint, is not finished (unless a checkpoint is named), has diverged,
            is of another environment, other sizes or another form, or is not the run whose identity the reference has;
            or the new agent has no policy to start with.
        RunError: its files cannot be read, or its checkpoint is damaged.
    """
    directory = RunDirectory(ref.directory)
    if agent.adopt is None:
        allowed = "a method whose policy lives as long as the run and can be taken over, such as sac or sac_v2"
        raise FieldError("parent", str(ref), allowed, "cannot be used: this method has no policy to start with")
    status = directory.status()
    if status is Status.ABSENT:
        raise FieldError("parent", str(ref), "the directory of a run", "holds no run")
    if status is Status.DIVERGED:
        raise FieldError("parent", str(ref), "a run that is finished", "diverged: its numbers are not finite")
    steps = directory.checkpoints().steps()
    if not steps or (ref.step is not None and ref.step not in steps):
        known = ", ".join(map(str, steps)) if steps else "none; it is kept, or has not come to one yet"
        what = "has no checkpoint" if ref.step is None else f"has no checkpoint of step {ref.step}"
        raise FieldError("parent", str(ref), f"one of its checkpoints ({known})", what)
    if status is Status.PARTIAL and ref.step is None:
        allowed = f"a run that is finished (--resume does), or one of its checkpoints, such as {ref}@{steps[-1]}"
        raise FieldError("parent", str(ref), allowed, "is not finished")
    spec, step = directory.spec(), ref.step or steps[-1]
    parent_env = build.make_env(dataclasses.replace(spec.config, eval_every=0))
    own, other = ((one.spec.obs_size, one.spec.action_size) for one in (env, parent_env))
    if own != other:
        allowed = f"a run with {own[0]} observation entries and {own[1]} action entries"
        raise FieldError("parent", str(ref), allowed, f"has {other[0]} and {other[1]}")
    if config.env != spec.config.env:
        _check_entries(ref, (config.env, env), (spec.config.env, parent_env))
    _check_form(ref, config, spec.config)
    parent_agent = build.make_agent(spec.config, parent_env)
    here, there = (jax.tree.map(_shape, _abstract_actor(one).behaviour) for one in (agent, parent_agent))
    if here != there:
        allowed = "a run whose method has a policy of SAC's, such as implicit, max, icm or sac"
        raise FieldError("parent", str(ref), allowed, f"has another kind of policy (method {spec.config.method!r})")
    _check_alive(ref, directory, step, config)
    check_identity(ref, directory, step)
    return RunRef(ref.directory, step, spec.identity, spec.parent.steps if spec.parent else 0)


def check_identity(ref: RunRef, directory: RunDirectory, step: int) -> None:
    """The parent is the run that the reference says, if it says any, and its checkpoint is as it was saved.

    Raises:
        FieldError: it is another run.
        RunError: its files cannot be read, or the checkpoint is damaged.
    """
    try:
        saved = directory.checkpoints().check(step)
    except RunError as error:
        raise RunError(f"--parent={ref}: {error}") from error
    # One that has been made longer since is another run, and its checkpoint of before the same.
    if saved.get("identity") != ref.identity:
        check_recorded(ref, directory.spec().identity)


def check_recorded(ref: RunRef, identity: str) -> None:
    """Raise `FieldError` unless the reference has this identity, or none."""
    if ref.identity not in ("", identity):
        allowed = "that run, back in its place, or a new run that starts from this one"
        problem = f"is another run by now: its identity is {identity}, and that of the one started from {ref.identity}"
        raise FieldError("parent", str(ref), allowed, problem)


def _check_entries(ref: RunRef, own: tuple[str, Environment], parent: tuple[str, Environment]) -> None:
    """Two environments of the same sizes have the same entries, as far as their names say."""
    for kind in ("observation", "action"):
        here, there = (_names(env, kind) for _, env in (own, parent))
        if here == there and not _are_numbered(here):
            continue
        pairs = enumerate(zip(here, there, strict=True))
        told = next((f"entry {i} is {b!r}, not {a!r}" for i, (a, b) in pairs if a != b), "entries are only numbered")
        allowed = f"a run of {own[0]}, or of an environment whose entries have the same names"
        raise FieldError("parent", str(ref), allowed, f"is of another environment, {parent[0]}, whose {kind} {told}")


def _names(env: Environment, kind: str) -> Sequence[str]:
    return env.spec.obs_names if kind == "observation" else env.spec.action_names


def _are_numbered(names: Sequence[str]) -> bool:
    """Whether names say nothing of what entries are, as other packages' environments have it: `obs[0]`, `action=1`."""
    return all(re.search(r"\d\]?$", name) for name in names)


def _check_form(ref: RunRef, own: RunConfig, parent: RunConfig) -> None:
    """Parameters of the same shapes mean something else in a network of another form."""
    found = conflicts(own, parent)
    if found:
        told = ", ".join(f"{path}={there!r}, not {here!r}" for path, (there, here) in found.items())
        flags = ", ".join(flag(path) for path in found)
        allowed = f"a run whose policy has the form of this one's, or to leave out {flags}, which the parent decides on"
        raise FieldError("parent", str(ref), allowed, f"has a policy of another form ({told})")


def _check_alive(ref: RunRef, directory: RunDirectory, step: int, config: RunConfig) -> None:
    """The seeds that are taken over from had not diverged by then."""
    parent = directory.config()
    taken = {parent.seed + i % parent.num_seeds for i in range(config.num_seeds)}
    rows = directory.rows() if directory.metrics_path.exists() else []
    broken = sorted({row["seed"] for row in rows if row.get("diverged") and row["step"] <= step} & taken)
    if broken:
        allowed = "a run whose seeds are finite at that step"
        raise FieldError("parent", str(ref), allowed, f"diverged in seed {', '.join(map(str, broken))}")


def _abstract_actor(agent: Explorer) -> Actor:
    return jax.eval_shape(lambda key: agent.actor(agent.init(key)), jax.random.key(0))


def _shape(leaf: jax.ShapeDtypeStruct) -> tuple[tuple[int, ...], str]:
    return leaf.shape, str(leaf.dtype)


def adopt(state: RunState, ref: RunRef, agent: Explorer) -> RunState:
    """The state that a run starts from, with the policies of its parent: of the seed with the same place in it, and
    of its only seed where it has one.

    Args:
        state: of the new run.
        ref: the parent, as `resolve` gives it.
        agent: of the new run.

    Raises:
        RunError: the checkpoint cannot be read, or is damaged: no other one takes its place.
    """
    assert ref.step is not None
    directory = RunDirectory(ref.directory)
    directory.checkpoints().check(ref.step)
    config = directory.config()
    env = build.make_env(dataclasses.replace(config, eval_every=0))
    parent_agent = build.make_agent(config, env)
    parent_state, _ = last_state(directory, env, parent_agent, ref.step)
    num_seeds = len(state.alive)
    index = jnp.arange(num_seeds) % config.num_seeds

    def one(state: object, parent: object) -> object:
        assert agent.adopt is not None
        return agent.adopt(state, parent_agent.actor(parent))  # pyright: ignore[reportArgumentType]

    def pick(leaf: Array) -> Array:
        return jnp.asarray(leaf)[index]

    def put(new: Array, old: Array) -> Array:
        # What is new and the same for all seeds would lie on every device.
        return jax.device_put(new, old.sharding) if len(old.sharding.device_set) > 1 else new

    parents = jax.tree.map(pick, parent_state.explorer)
    adopted = jax.jit(jax.vmap(one))(state.explorer, parents)
    return dataclasses.replace(state, explorer=jax.tree.map(put, adopted, state.explorer))
