"""Seeds of one run spread over all devices, and on one. For `test_placement`."""

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxplore
from envs.base import Environment, EnvState
from experiments.runs.config import RunConfig
from experiments.training import build, placement, programs
from experiments.training.programs import Programs, make_programs
from jaxplore import methods
from jaxplore.methods import Method, get_method
from jaxplore.types import Array, Transition
from tests.experiments import tiny

COLLECTIVES = r"\b(all-reduce|all-gather|all-to-all|collective-permute|collective-broadcast|reduce-scatter)(-start)?\("
SIZES = jaxplore.ExplorationConfig(
    warm_up_steps=8,
    steps_per_round=8,
    dynamics=jaxplore.DynamicsConfig(hidden=(8,)),
    generator=jaxplore.GeneratorConfig(hidden=(8,), noise_size=4),
    svgd=jaxplore.SVGDConfig(num_particles=4),
    fit=jaxplore.FitConfig(lr=1e-3, batch_size=8, epochs=0, steps=3, restart=False),
    imagination=jaxplore.ImaginationConfig(
        num_actors=4, horizon=3, num_rollouts=2, num_random_rollouts=1, updates_per_rollout=2, real_updates=1
    ),
    sac=jaxplore.SACConfig(hidden=(8,), batch_size=8),
    # Few: each update magnifies the rounding of those before it.
    reactive=jaxplore.ReactiveConfig(updates=2),
    rnd=jaxplore.RNDConfig(hidden=(8,), features=4),
    ppo=jaxplore.PPOConfig(hidden=(8,), rollout_steps=8, epochs=1, minibatch_size=4),
)


def make_settling_point() -> Environment:
    """A point that is pulled back, as far as it has gone, in a loop that ends when it is there: as a solver's does."""
    env = tiny.make_point()

    def settle(obs: Array) -> Array:
        return jax.lax.while_loop(lambda obs: jnp.any(jnp.abs(obs[:2]) > 0.5), lambda obs: 0.9 * obs, obs)

    def step(state: EnvState, action: Array) -> tuple[EnvState, Transition]:
        after, transition = env.step(state, action)
        obs = settle(after.obs)
        return after.replace(obs=obs), transition._replace(next_obs=obs)

    return dataclasses.replace(env, step=step)


def make(method: Method, num_seeds: int, seed: int, num_devices: int) -> Programs:
    """Programs of a run over the first devices."""
    env = make_settling_point()
    config = RunConfig(method="implicit", seed=seed, num_seeds=num_seeds, steps=64, explorer=SIZES)
    agent = jaxplore.make_explorer(method, build.sizes_of(env), config.explorer)
    devices = jax.devices()[:num_devices]
    programs.place = lambda num_seeds: placement.place(num_seeds, devices)
    return make_programs(config, env, agent)


def rounds(own: Programs, num: int) -> tuple[Any, Any, list[dict[str, np.ndarray]]]:
    """Explorers, environments and metrics after some rounds, the first of uniform actions."""
    state = own.init()
    explorer, env, found = state.explorer, state.env, []
    for number in range(num):
        actors = own.actors(explorer, number == 0)
        env, rows, valid = own.collect(8 * number, env, actors, 8)
        args = (rows, valid, own.stepper.obs(env), 8 * number + 8, state.alive)
        explorer, metrics, _ = own.learn(8 * number, explorer, *args)
        found.append(jax.device_get(metrics))
    return explorer, env, found


def main(name: str, num_devices: str) -> dict[str, Any]:
    """Of the method `name`, or of its belief alone, with a seed for each device: collectives in the compiled programs,
    where their results lie, whether the state was taken over in place, and how far the seeds are from those that are
    on one device side by side (of whole methods), and from the last one alone.
    """
    method, count = get_method(name.removesuffix(" belief")), int(num_devices)
    if name.endswith(" belief"):
        method = Method("belief", method.signal, methods.uniform_actions)
    spread = make(method, count, 0, count)
    state = spread.init()
    actors = spread.actors(state.explorer, False)
    env, rows, valid = spread.collect(0, state.env, actors, 8)
    obs = spread.stepper.obs(env)
    learn = spread.trace_learn(state.explorer, (rows, valid), obs, 8, state.alive).lower().compile().as_text()
    collect = spread.stepper.collect.lower(spread.keys(programs.COLLECT, 0), state.env, actors, 8)  # pyright: ignore
    collect = collect.compile().as_text()
    control = jax.jit(jax.vmap(make_settling_point().step)).lower(state.env, rows.action[:, 0]).compile().as_text()
    spread.learn(0, state.explorer, rows, valid, obs, 8, state.alive)
    explorer, env, metrics = rounds(spread, 3)
    alone = rounds(make(method, 1, count - 1, 1), 3)
    # Side by side on one device they are another program: only where time does not matter.
    beside = None if name.endswith(" belief") else rounds(make(method, count, 0, 1), 3)
    leaves = jax.tree.leaves((explorer, env))
    return {
        "parts": [int(re.findall(r"num_partitions=(\d+)", text)[0]) for text in (learn, collect)],
        "collectives": re.findall(COLLECTIVES, learn + collect),
        "collectives of a program that XLA splits": sorted({name for name, _ in re.findall(COLLECTIVES, control)}),
        "lies there": all(leaf.sharding == spread.learning.sharding for leaf in leaves),
        "each": sorted({shard.data.shape[0] for leaf in leaves for shard in leaf.addressable_shards}),
        "in place": all(leaf.is_deleted() for leaf in jax.tree.leaves(state.explorer)),
        "from those beside": distance((explorer, metrics), (beside[0], beside[2])) if beside else None,
        "from the last alone": distance(seed(-1, (explorer, metrics)), (alone[0], alone[2])),
        "from another seed": distance(seed(0, (explorer, metrics)), (alone[0], alone[2])),
    }


def seed(number: int, tree: Any) -> Any:
    """One seed of many, with its axis."""
    return jax.tree.map(lambda leaf: leaf[number][None], tree)


def distance(one: Any, other: Any) -> float:
    """The largest difference of two trees, relative to the largest number of the leaf that it is in, or to 1."""
    pairs = zip(jax.tree.leaves(jax.device_get(one)), jax.tree.leaves(jax.device_get(other)), strict=True)
    return max(float(np.max(np.abs(a * 1.0 - b) / max(np.max(np.abs(b)), 1.0))) for a, b in pairs if a.size)
