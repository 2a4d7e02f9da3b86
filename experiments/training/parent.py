"""Runs that start from another run's policy."""

import dataclasses

import jax
import jax.numpy as jnp

from envs.base import Environment
from experiments.runs.directory import RunDirectory
from experiments.runs.spec import RunRef
from experiments.runs.status import Status
from experiments.training import build
from experiments.training.loop import last_state
from experiments.training.programs import RunState
from jaxplore.exploration import Actor, Explorer
from jaxplore.types import Array
from jaxplore.validate import FieldError


def resolve(ref: RunRef, env: Environment, agent: Explorer) -> RunRef:
    """A reference with its step and identity filled in, checked against the run that is to start from it.

    Args:
        ref: the parent, as it was written.
        env: where the new run takes place.
        agent: of the new run.

    Raises:
        FieldError: it is no run, has no such checkpoint or is of other sizes, or the new agent has no policy to start
            with.
        RunError: its files cannot be read.
    """
    directory = RunDirectory(ref.directory)
    if agent.adopt is None:
        allowed = "a method whose policy lives as long as the run and can be taken over, such as sac or sac_v2"
        raise FieldError("parent", str(ref), allowed, "cannot be used: this method has no policy to start with")
    if directory.status() is Status.ABSENT:
        raise FieldError("parent", str(ref), "the directory of a run", "holds no run")
    steps = directory.checkpoints().steps()
    if not steps or (ref.step is not None and ref.step not in steps):
        known = ", ".join(map(str, steps)) if steps else "none; it is kept, or has not come to one yet"
        what = "has no checkpoint" if ref.step is None else f"has no checkpoint of step {ref.step}"
        raise FieldError("parent", str(ref), f"one of its checkpoints ({known})", what)
    spec, step = directory.spec(), ref.step or steps[-1]
    parent_env = build.make_env(dataclasses.replace(spec.config, eval_every=0))
    own, other = ((one.spec.obs_size, one.spec.action_size) for one in (env, parent_env))
    if own != other:
        allowed = f"a run with {own[0]} observation entries and {own[1]} action entries"
        raise FieldError("parent", str(ref), allowed, f"has {other[0]} and {other[1]}")
    parent_agent = build.make_agent(spec.config, parent_env)
    here, there = (jax.tree.map(_shape, _abstract_actor(one).behaviour) for one in (agent, parent_agent))
    if here != there:
        allowed = "a run whose method has a policy, with networks of the same widths as this one's"
        raise FieldError("parent", str(ref), allowed, f"has another kind of policy (method {spec.config.method!r})")
    return RunRef(ref.directory, step, spec.identity)


def _abstract_actor(agent: Explorer) -> Actor:
    return jax.eval_shape(lambda key: agent.actor(agent.init(key)), jax.random.key(0))


def _shape(leaf: jax.ShapeDtypeStruct) -> tuple[tuple[int, ...], str]:
    return leaf.shape, str(leaf.dtype)


def adopt(state: RunState, ref: RunRef, agent: Explorer) -> RunState:
    """The state that a run starts from, with the policies of its parent: of the seed with the same place in it, and
    of its only seed where it has one.
    """
    directory = RunDirectory(ref.directory)
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
