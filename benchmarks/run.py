"""`python -m benchmarks.run`: one table of what a step of each kernel costs, beside what it must cost.

Every figure is measured in this one process, and so is the matrix-product rate that the floors divide by.
"""

import argparse
import dataclasses
import json
import platform
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import envs
from benchmarks import flops
from benchmarks.timing import Timing, matmul_rate, measure
from envs.base import Environment
from envs.adapters.to_gymnasium import gymnasium_id
from experiments import loop
from experiments.config import RunConfig, preset_config
from experiments.run import use_compilation_cache, versions
from jaxplore import beliefs, dynamics, imagination, replay, rewards
from jaxplore.exploration import make_explorer
from jaxplore.methods import METHODS, ExplorationConfig, Sizes
from jaxplore.learners.sac import make_sac
from jaxplore.types import Transition

RESULTS = Path(__file__).parent / "results"
OBS, ACTION = 31, 8
"""Sizes of the Ant maze."""
PARTS = ("environments", "kernels", "methods")


@dataclasses.dataclass(frozen=True)
class Result:
    """One line of the table."""

    kernel: str
    shape: str
    seconds: float
    """Of one unit of work, best of the repeats."""
    median_seconds: float
    compile_seconds: float
    flops: float | None = None
    floor_seconds: float | None = None
    per_second: float | None = None
    """Environment steps, where that is what counts."""

    @property
    def times_floor(self) -> float | None:
        """How many times the floor the kernel takes."""
        return self.seconds / self.floor_seconds if self.floor_seconds else None


def _result(kernel: str, shape: str, timing: Timing, flop: float | None = None, rate: float | None = None) -> Result:
    floor = flop / rate if flop and rate else None
    return Result(kernel, shape, timing.best, timing.median, timing.compile, flop, floor)


def environment_steps(name: str, backend: str, num_envs: int, steps: int) -> Result:
    """Random actions in an environment: on the host one after the other, on the device under `vmap`."""
    env = envs.make(name, backend=backend)
    call = _device_steps(env, num_envs, steps) if env.compiled else _host_steps(env, steps)
    engine = {"mjx": "MJX", "mujoco": "C MuJoCo", "jax": "JAX"}[env.backend]
    return _steps(f"{name}, {engine}", f"{num_envs} in parallel", call, steps * num_envs)


def vector_steps(name: str, num_envs: int, steps: int, mode: str) -> Result:
    """The same with C MuJoCo through Gymnasium's vector environments: `sync`, or a process each (`async`)."""
    # Processes start afresh, as a fork of one that runs JAX can hang; "envs:" is what they import.
    options = {"context": "spawn"} if mode == "async" else {}
    id_ = f"envs:{gymnasium_id(name)}"
    vector = gymnasium.make_vec(id_, num_envs, vectorization_mode=mode, vector_kwargs=options, backend="mujoco")
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, *(vector.action_space.shape or ()))).astype(np.float32)

    def call() -> np.ndarray:
        obs, _ = vector.reset(seed=0)
        for action in actions:
            obs = vector.step(action)[0]
        return obs

    try:
        return _steps(f"{name}, C MuJoCo, Gymnasium {mode}", f"{num_envs} in parallel", call, steps * num_envs)
    finally:
        vector.close()


def _steps(kernel: str, shape: str, call: Callable[[], Any], inner: int) -> Result:
    timing = measure(call, repeats=3, inner=inner)
    return dataclasses.replace(_result(kernel, shape, timing), per_second=1.0 / timing.best)


def _host_steps(env: Environment, steps: int) -> Callable[[], Any]:
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, env.spec.action_size)).astype(np.float32)

    def call() -> np.ndarray:
        state = env.reset(jax.random.key(0))
        for action in actions:
            state, _ = env.step(state, action)
        return np.asarray(state.obs)

    return call


def _device_steps(env: Environment, num_envs: int, steps: int) -> Callable[[], Any]:
    shape = (num_envs, env.spec.action_size)

    @jax.jit
    def call_all(keys: jax.Array) -> jax.Array:
        def step(states: Any, key: jax.Array) -> tuple[Any, None]:
            return jax.vmap(env.step)(states, jax.random.uniform(key, shape, minval=-1.0, maxval=1.0))[0], None

        states = jax.vmap(env.reset)(keys)
        return jax.lax.scan(step, states, jax.random.split(jax.random.key(1), steps))[0].obs

    keys = jax.random.split(jax.random.key(0), num_envs)
    return lambda: call_all(keys)


def _random_data(capacity: int, size: int) -> replay.Replay[Transition]:
    """A replay of random rows: timings do not depend on what is in them."""
    key = jax.random.key(0)
    obs, next_obs = jax.random.normal(key, (2, size, OBS))
    rows = Transition(
        obs, jnp.zeros((size, ACTION)), jnp.ones(size), next_obs, jnp.zeros(size, bool), jnp.zeros(size, bool)
    )
    return replay.add(replay.init(jax.tree.map(lambda leaf: leaf[0], rows), capacity), rows)


def svgd_step(config: ExplorationConfig, rate: float, inner: int) -> Result:
    """One amortised SVGD step, its minibatch drawn from the replay."""
    belief = beliefs.make_generator_belief(OBS, ACTION, config.dynamics, config.generator, config.svgd, config.fit)
    data, normalizers = _random_data(4096, 4096), dynamics.init_normalizers(OBS, ACTION)
    state = belief.init(jax.random.key(0))

    def steps(state: Any) -> Any:
        def step(i: jax.Array, state: Any) -> Any:
            return belief.update(jax.random.key(i), state, data, normalizers)[0]

        return jax.lax.fori_loop(0, inner, step, state)

    timing = _donating(jax.jit(steps, donate_argnums=0), state, inner)
    widths = (OBS + ACTION, *config.dynamics.hidden, OBS)
    generator = (config.generator.noise_size, *config.generator.hidden)
    flop = flops.svgd_step(widths, generator, config.svgd.num_particles, config.fit.batch_size)
    shape = f"{config.svgd.num_particles} x {_widths(config.dynamics.hidden)}, batch {config.fit.batch_size}"
    return _result("SVGD step", shape, timing, flop, rate)


def _donating(call: Callable[[Any], Any], state: Any, inner: int, repeats: int = 5) -> Timing:
    """Time a function that takes its state over and gives it back."""
    holder = [state]

    def once() -> Any:
        holder[0] = call(holder[0])
        return holder[0]

    return measure(once, inner=inner, repeats=repeats)


def imagined_step(config: ExplorationConfig, rate: float) -> Result:
    """One step of all actors in all models, the policy's action and the reward included."""
    belief = beliefs.make_generator_belief(OBS, ACTION, config.dynamics, config.generator, config.svgd, config.fit)
    sac = make_sac(OBS, ACTION, config.sac)
    actor = sac.actor(sac.init(jax.random.key(0)))
    settings = config.imagination
    models = jax.jit(belief.sample, static_argnums=2)(
        jax.random.key(1), belief.init(jax.random.key(2)), settings.num_models
    )
    assert belief.predict is not None
    predict = belief.predict

    @jax.jit
    def roll(key: jax.Array, models: Any) -> Any:
        return imagination.rollout(
            key,
            lambda act_key, obs: sac.act(act_key, actor, obs),
            predict,
            lambda prediction, delta, normalizers: rewards.variance(prediction),
            models,
            dynamics.init_normalizers(OBS, ACTION),
            jnp.zeros((settings.num_actors, OBS)),
            settings.horizon,
            settings.mover,
            settings.bound,
        ).reward

    timing = measure(lambda: roll(jax.random.key(3), models), inner=settings.horizon)
    widths, policy = (OBS + ACTION, *config.dynamics.hidden, OBS), (OBS, *config.sac.hidden, 2 * ACTION)
    flop = flops.imagined_step(widths, policy, settings.num_models, settings.num_actors)
    shape = f"{settings.num_models} x {_widths(config.dynamics.hidden)}, {settings.num_actors} actors"
    return _result("imagined step", shape, timing, flop, rate)


def sac_update(config: ExplorationConfig, rate: float, inner: int) -> Result:
    """One SAC update on a batch drawn from a replay."""
    sac = make_sac(OBS, ACTION, config.sac)
    data = _random_data(8192, 8192)

    def updates(state: Any) -> Any:
        def update(i: jax.Array, state: Any) -> Any:
            key = jax.random.key(i)
            return sac.update(key, state, replay.sample(key, data, config.sac.batch_size))[0]

        return jax.lax.fori_loop(0, inner, update, state)

    timing = _donating(jax.jit(updates, donate_argnums=0), sac.init(jax.random.key(0)), inner)
    flop = flops.sac_update(OBS, ACTION, config.sac.hidden, config.sac.batch_size)
    return _result("SAC update", f"{_widths(config.sac.hidden)}, batch {config.sac.batch_size}", timing, flop, rate)


def whole_round(run: RunConfig, rate: float, num_data: int, repeats: int) -> Result:
    """One round with `num_data` real transitions held: assess, take in, fit, imagine, improve."""
    config = run.explorer
    env = envs.make("ant_maze", backend="mujoco")
    programs = loop.make_programs(run, env, loop.make_run_explorer(run, env))
    explorer = programs.init().explorer
    rows = _random_data(config.steps_per_round, config.steps_per_round).rows
    chunk = jax.tree.map(lambda leaf: leaf[None], rows)
    valid = jnp.ones((1, config.steps_per_round), bool)

    def call(explorer: Any) -> Any:
        return programs.learn(0, explorer, chunk, valid, jnp.zeros((1, OBS)), num_data)[0]

    holder = [explorer]

    def once() -> Any:
        holder[0] = call(holder[0])
        return holder[0]

    timing = measure(once, repeats=repeats)
    widths, policy = (OBS + ACTION, *config.dynamics.hidden, OBS), (OBS, *config.sac.hidden, 2 * ACTION)
    generator, settings = (config.generator.noise_size, *config.generator.hidden), config.imagination
    steps = int(config.fit.num_steps(jnp.asarray(num_data)))
    trained = settings.num_rollouts - settings.num_random_rollouts
    updates = settings.real_updates + trained * settings.updates_per_rollout
    flop = (
        steps * flops.svgd_step(widths, generator, config.svgd.num_particles, config.fit.batch_size)
        + settings.num_rollouts
        * settings.horizon
        * flops.imagined_step(widths, policy, settings.num_models, settings.num_actors)
        + updates * flops.sac_update(OBS, ACTION, config.sac.hidden, config.sac.batch_size)
    )
    imagined = settings.num_rollouts * settings.horizon
    shape = f"{run.preset}, N = {num_data:,}: {steps} SVGD, {imagined} imagined, {updates} SAC"
    return _result("whole round", shape, timing, flop, rate)


ROUNDS = 6
"""Rounds of 25 steps timed in one: PPO learns once in 128 steps, so not in each."""


def method_round(name: str, num_data: int = 2_560) -> Result:
    """A laptop round of one method with `num_data` transitions held: take 25 in, fit, imagine, improve."""
    method, config = METHODS[name], preset_config("laptop", method=name).explorer
    sizes = Sizes(OBS, ACTION, discrete=method.actions == "discrete", has_reward=True)
    explorer = make_explorer(method, sizes, config)
    data = _random_data(num_data, num_data).rows
    chunk = jax.tree.map(lambda leaf: leaf[: config.steps_per_round], data)
    obs, came, held = jnp.zeros((1, OBS)), jnp.ones(config.steps_per_round, bool), jnp.ones(num_data, bool)

    def one(key: jax.Array, state: Any, obs: jax.Array) -> Any:
        return explorer.improve(key, explorer.observe(state, chunk, came), obs, jnp.int32(num_data))[0]

    # One seed under vmap and each round waited for, as the loop does it.
    learn = jax.jit(jax.vmap(one), donate_argnums=1)

    def rounds(state: Any) -> Any:
        for i in range(ROUNDS):
            state = jax.block_until_ready(learn(jax.random.split(jax.random.key(i), 1), state, obs))
        return state

    def begin(key: jax.Array) -> Any:
        return explorer.observe(explorer.init(key), data, held)

    start = jax.block_until_ready(jax.jit(jax.vmap(begin))(jax.random.split(jax.random.key(0), 1)))
    timing = _donating(rounds, start, ROUNDS, repeats=2)
    return _result(f"round, {name}", f"laptop, N = {num_data:,}", timing)


def methods() -> Iterator[Result]:
    """What a round of each method costs."""
    for name in METHODS:
        yield method_round(name)


def _widths(hidden: tuple[int, ...]) -> str:
    return "-".join(map(str, hidden))


def environments(*, quick: bool) -> Iterator[Result]:
    """Throughput of every environment of ours."""
    for name in ("ant_maze", "half_cheetah", "hand_block"):
        yield environment_steps(name, "mujoco", 1, 300)
        for mode in ("sync", "async"):
            yield vector_steps(name, 4, 300, mode)
        # The hand's programs take minutes to compile on a CPU.
        sizes = {"hand_block": () if quick else (16,)}.get(name, (16,) if quick else (1, 16, 256))
        for num_envs in sizes:
            yield environment_steps(name, "mjx", num_envs, 50 if num_envs == 1 else 10)
    for name in ("nchain", "acrobot", "mountain_car"):
        for num_envs in (1, 1024):
            yield environment_steps(name, "jax", num_envs, 1000)


def kernels(rate: float, *, quick: bool) -> Iterator[Result]:
    """What learning is made of, at laptop and paper shapes."""
    laptop, paper = preset_config("laptop"), preset_config("paper")
    for run, inner in ((laptop, 50), (paper, 3)):
        yield svgd_step(run.explorer, rate, inner)
        yield imagined_step(run.explorer, rate)
        yield sac_update(run.explorer, rate, 20 if run is laptop else 3)
        if run is laptop or not quick:
            yield whole_round(run, rate, 2_560 if run is laptop else 256, 3 if run is laptop else 1)


def run_all(rate: float, *, quick: bool, only: str | None = None) -> Iterator[Result]:
    """Every line of the table, in order, or one part of it."""
    if only in (None, "environments"):
        yield from environments(quick=quick)
    if only in (None, "kernels"):
        yield from kernels(rate, quick=quick)
    if only in (None, "methods"):
        yield from methods()


def table(results: list[Result]) -> str:
    """The results as aligned text."""
    head = ("kernel", "shape", "time", "floor", "x floor", "per second", "first call")
    lines = [
        (
            result.kernel,
            result.shape,
            _time(result.seconds),
            _time(result.floor_seconds),
            f"{result.times_floor:.2f}" if result.times_floor else "",
            f"{result.per_second:,.0f}" if result.per_second else "",
            f"{result.compile_seconds:.1f} s",
        )
        for result in results
    ]
    widths = [max(map(len, column)) for column in zip(head, *lines, strict=True)]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in (head, *lines)]
    return "\n".join(line.rstrip() for line in (text[0], "-" * len(text[0]), *text[1:]))


def _time(seconds: float | None) -> str:
    if seconds is None:
        return ""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def main() -> int:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="leave out many or slow MJX environments and the paper's round"
    )
    parser.add_argument("--only", choices=PARTS, help="one part of the table")
    parser.add_argument("--out", type=Path, help="JSON file to write; default: benchmarks/results/DEVICE.json")
    arguments = parser.parse_args()
    use_compilation_cache()
    device = jax.devices()[0].device_kind
    rate = matmul_rate()
    print(f"{device}: {rate / 1e9:,.0f} GFLOP/s in a float32 matrix product\n")
    results = []
    for result in run_all(rate, quick=arguments.quick, only=arguments.only):
        results.append(result)
        print(f"  {result.kernel}, {result.shape}: {_time(result.seconds)}", file=sys.stderr, flush=True)
    print(table(results))
    out = arguments.out or RESULTS / f"{device.replace(' ', '-').lower()}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    machine = {
        "device": device,
        "processor": _processor(),
        "platform": platform.platform(),
        "date": time.strftime("%Y-%m-%d"),
        "matmul_flops_per_second": rate,
        "versions": versions(),
    }
    rows = [{**dataclasses.asdict(result), "times_floor": result.times_floor} for result in results]
    out.write_text(json.dumps({"machine": machine, "results": rows}, indent=2) + "\n")
    print(f"\nwritten to {out}")
    return 0


def _processor() -> str:
    """The processor's own name, as Linux tells it, or Python's."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    sys.exit(main())
