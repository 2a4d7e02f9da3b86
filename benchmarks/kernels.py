"""What learning is made of, with the Ant maze's sizes: an SVGD step, an imagined step, an update, a whole round."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import flops
from benchmarks.result import Result, make_result, widths
from benchmarks.timing import measure, measure_chain
from experiments.runs.config import RunConfig
from experiments.runs.presets import preset_config
from experiments.training.build import make_agent, make_env
from experiments.training.programs import make_programs
from jaxplore import (
    ExplorationConfig,
    Replay,
    Transition,
    World,
    dynamics,
    make_generator_belief,
    make_sac,
    replay,
    rewards,
    rollout,
)
from jaxplore.behaviours.base import AS_THEY_ARE, lesson_of, no_learner_metrics, train
from jaxplore.beliefs import Belief

OBS, ACTION = 31, 8
"""Sizes of the Ant maze."""


def kernels(rate: float, *, quick: bool) -> Iterator[Result]:
    """What learning is made of, at laptop and paper shapes."""
    laptop, paper = preset_config("laptop"), preset_config("paper")
    for run, inner in ((laptop, 50), (paper, 3)):
        yield svgd_step(run.explorer, rate, inner)
        yield imagined_step(run.explorer, rate)
        yield sac_update(run.explorer, rate, 20 if run is laptop else 3)
        if run is laptop or not quick:
            yield whole_round(run, rate, 2_560 if run is laptop else 256, 3 if run is laptop else 1)


def svgd_step(config: ExplorationConfig, rate: float, inner: int) -> Result:
    """One amortised SVGD step, its minibatch drawn from the replay."""
    belief = make_belief(config)
    data, normalizers = random_data(4096, 4096), dynamics.init_normalizers(OBS, ACTION)

    def steps(state: Any) -> Any:
        def step(i: jax.Array, state: Any) -> Any:
            return belief.update(jax.random.key(i), state, data, normalizers)[0]

        return jax.lax.fori_loop(0, inner, step, state)

    timing = measure_chain(jax.jit(steps, donate_argnums=0), belief.init(jax.random.key(0)), inner=inner)
    batch, rows = config.fit.batch_size, svgd_rows(config)
    points = f"batch {batch}" if rows == batch else f"batch {batch} and {rows - batch} points"
    shape = f"{config.svgd.num_particles} x {widths(config.dynamics.hidden)}, {points}"
    return make_result("SVGD step", shape, timing, svgd_flops(config), rate)


def imagined_step(config: ExplorationConfig, rate: float) -> Result:
    """One step of all actors in all models, the policy's action and the reward included."""
    belief, sac, settings = make_belief(config), make_sac(OBS, ACTION, config.sac), config.imagination
    actor = sac.actor(sac.init(jax.random.key(0)))
    draw = jax.jit(belief.sample, static_argnums=2)
    models = draw(jax.random.key(1), belief.init(jax.random.key(2)), belief.num_models)

    @jax.jit
    def roll(key: jax.Array, models: Any) -> Any:
        world = World(
            belief,
            models,
            dynamics.init_normalizers(OBS, ACTION),
            lambda seen: rewards.variance(seen.prediction),
        )
        start = jnp.zeros((settings.num_actors, OBS))
        act = lambda act_key, obs: sac.act(act_key, actor, obs)  # noqa: E731
        return rollout(key, act, world, start, settings.horizon, settings.mover, settings.bound).reward

    timing = measure(lambda: roll(jax.random.key(3), models), inner=settings.horizon)
    shape = f"{belief.num_models} x {widths(config.dynamics.hidden)}, {settings.num_actors} actors"
    return make_result("imagined step", shape, timing, imagined_flops(config), rate)


def sac_update(config: ExplorationConfig, rate: float, inner: int) -> Result:
    """One SAC update on a batch drawn from a replay, as a round makes many of them."""
    sac = make_sac(OBS, ACTION, config.sac)
    lesson = lesson_of([(random_data(8192, 8192), config.sac.batch_size)], None, AS_THEY_ARE)

    def updates(state: Any) -> Any:
        nothing = no_learner_metrics(sac, state, OBS, ACTION)
        return train(sac, jax.random.key(0), state, lesson, inner, nothing)[0]

    timing = measure_chain(jax.jit(updates, donate_argnums=0), sac.init(jax.random.key(0)), inner=inner)
    shape = f"{widths(config.sac.hidden)}, batch {config.sac.batch_size}"
    return make_result("SAC update", shape, timing, sac_flops(config), rate)


def whole_round(run: RunConfig, rate: float, num_data: int, repeats: int) -> Result:
    """One round with `num_data` real transitions held: assess, take in, fit, imagine, improve."""
    run, config = dataclasses.replace(run, backend="mujoco"), run.explorer
    env = make_env(run)
    programs = make_programs(run, env, make_agent(run, env))
    rows = random_data(config.steps_per_round, config.steps_per_round).rows
    chunk = jax.tree.map(lambda leaf: leaf[None], rows)
    valid, obs, alive = jnp.ones((1, config.steps_per_round), bool), jnp.zeros((1, OBS)), jnp.ones(1, bool)

    def call(explorer: Any) -> Any:
        return programs.learn(0, explorer, chunk, valid, obs, num_data, alive)[0]

    timing = measure_chain(call, programs.init().explorer, repeats=repeats)
    steps, settings = int(config.fit.num_steps(jnp.asarray(num_data))), config.imagination
    imagined = settings.num_rollouts * settings.horizon if settings.real_fraction < 1.0 else 0
    trained = settings.num_rollouts - settings.num_random_rollouts
    updates = settings.real_updates + trained * settings.updates_per_rollout
    flop = steps * svgd_flops(config) + imagined * imagined_flops(config) + updates * sac_flops(config)
    shape = f"{run.preset}, N = {num_data:,}: {steps} SVGD, {imagined} imagined, {updates} SAC"
    return make_result("whole round", shape, timing, flop, rate)


def make_belief(config: ExplorationConfig) -> Belief:
    """The paper's belief, for the Ant maze."""
    return make_generator_belief(OBS, ACTION, config.dynamics, config.generator, config.svgd, config.fit)


def random_data(capacity: int, size: int) -> Replay[Transition]:
    """A replay of random rows: timings do not depend on what is in them."""
    key = jax.random.key(0)
    obs, next_obs = jax.random.normal(key, (2, size, OBS))
    rows = Transition(
        obs, jnp.zeros((size, ACTION)), jnp.ones(size), next_obs, jnp.zeros(size, bool), jnp.zeros(size, bool)
    )
    return replay.add(replay.init(jax.tree.map(lambda leaf: leaf[0], rows), capacity), rows)


def svgd_flops(config: ExplorationConfig) -> int:
    """FLOPs of `svgd_step`."""
    target, generator = (OBS + ACTION, *config.dynamics.hidden, OBS), config.generator
    noise_and_hidden, count = (generator.noise_size, *generator.hidden), generator.num_generators
    return count * flops.svgd_step(target, noise_and_hidden, config.svgd.num_particles // count, svgd_rows(config))


def svgd_rows(config: ExplorationConfig) -> int:
    """Rows that each network runs on in an SVGD step: the batch, and the points beside it where networks repel."""
    batch, svgd = config.fit.batch_size, config.svgd
    further = {"batch": 0, "perturbed": batch, "independent": batch, "uniform": svgd.num_repulsion_points}
    return batch + further[svgd.repulsion_points]


def imagined_flops(config: ExplorationConfig) -> int:
    """FLOPs of `imagined_step`."""
    target, policy = (OBS + ACTION, *config.dynamics.hidden, OBS), (OBS, *config.sac.hidden, 2 * ACTION)
    return flops.imagined_step(target, policy, config.svgd.num_particles, config.imagination.num_actors)


def sac_flops(config: ExplorationConfig) -> int:
    """FLOPs of `sac_update`."""
    return flops.sac_update(OBS, ACTION, config.sac.hidden, config.sac.batch_size)
