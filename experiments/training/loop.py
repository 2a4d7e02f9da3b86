"""The rounds of a run: environments step, the agent learns, everything is logged.

The agent is one jitted program over all seeds. Environments on the device are stepped by another; for those on the
host all seeds act in one.
"""

import dataclasses
import time
from typing import Any

import jax
import numpy as np

from envs.base import Environment
from envs.errors import EnvironmentFault
from experiments.runs import console
from experiments.runs.config import RunConfig
from experiments.runs.directory import RunDirectory
from experiments.runs.errors import RunError
from experiments.runs.schedule import due, gap, on_schedule, rounds
from experiments.runs.spec import RunSpec
from experiments.runs.status import Status
from experiments.training import record
from experiments.training.evaluate import make_evaluate
from experiments.training.programs import OLDER, Programs, RunState, make_programs
from jaxplore.exploration import Explorer
from jaxplore.types import Transition


def run(
    spec: RunSpec,
    directory: RunDirectory,
    env: Environment,
    agent: Explorer,
    programs: Programs | None = None,
    *,
    resume: bool = False,
    wandb: str | None = None,
) -> RunState:
    """Carry out a run, from its latest checkpoint if `resume`, and write what comes of it to its directory.

    Args:
        spec: what to run.
        directory: the run's.
        env: the environment that `spec` names.
        agent: the agent that `spec` names.
        programs: of the run, where they have been made already.
        resume: whether to continue from the latest checkpoint; without one the run starts over.
        wandb: project of Weights & Biases to log to as well; None: none.

    Returns:
        The last state.

    Raises:
        RunError: the disk fails, a checkpoint does not fit, or no seed is left whose numbers are finite. The latest
            checkpoint is then whole.
    """
    session = Session(spec, directory, env, agent, programs or make_programs(spec.config, env, agent), wandb)
    try:
        session.start(resume=resume)
        try:
            for first, end in rounds(spec.config, session.step):
                session.round(first, end)
        finally:
            session.close()
    except EnvironmentFault as fault:
        raise RunError(
            f"{fault} That was after step {session.step:,} of the run, whose latest checkpoint is kept. What to do: "
            "mend the environment, then continue with --resume; --debug shows where it happened."
        ) from fault
    directory.write_walk(session.state.positions, session.state.episode_steps)
    directory.write_outcome(Status.FINISHED, session.diverged())
    return session.state


MOST_LOST = 25
"""Steps in a row without one that can be learned from after which an environment is given up."""


class Session:
    """A run while it runs: what it is, how far it has come, and where it is written.

    Args:
        spec: what to run.
        directory: where it is written.
        env: the environment.
        agent: the agent.
        programs: its functions.
        wandb: project of Weights & Biases to log to as well.
    """

    state: RunState
    step: int = 0
    """Environment steps taken."""

    def __init__(
        self,
        spec: RunSpec,
        directory: RunDirectory,
        env: Environment,
        agent: Explorer,
        programs: Programs,
        wandb: str | None = None,
    ) -> None:
        self.spec, self.directory, self.env, self.agent, self.wandb = spec, directory, env, agent, wandb
        self.config: RunConfig = spec.config
        self.programs: Programs = programs
        evaluates = spec.config.eval_every > 0
        self.evaluate = make_evaluate(spec.config, env, agent, self.programs) if evaluates else None
        self.checkpoints, self.log = directory.checkpoints(spec.config.keep_at), directory.metrics_log()
        self._announced: set[str] = set()
        self._lost = np.zeros(spec.config.num_seeds, int)

    def start(self, *, resume: bool) -> None:
        """Take up the state to continue from, and open what is written to."""
        state, self.step, earlier = self.programs.init(), 0, 0.0
        usable = on_schedule(self.config, self.checkpoints.steps())
        restored = self.checkpoints.restore_latest(state, usable, OLDER) if resume and usable is not None else None
        if restored is None and self.spec.parent is not None:
            from experiments.training import parent  # Which restores states by this module.

            state = parent.adopt(state, self.spec.parent, self.agent)
        if restored is not None:
            self._check_identity(restored.meta)
            self._check_rows(restored.step)
            self.step, state, earlier = restored.step, restored.state, restored.meta["wall_time"]
        self.began = time.monotonic() - earlier
        # Written in place; a restored array may be read-only.
        arrays = ("visited", "positions", "episode_steps", "alive", "episode_return", "episode_length")
        self.state = dataclasses.replace(
            state, **{name: np.array(jax.device_get(getattr(state, name))) for name in arrays}
        )
        last = self.step if restored is not None else -1
        self.log.truncate_after(last)
        self.sinks = self.directory.sinks(last if resume else None, self.wandb)
        self.progress = console.Progress(
            self.config.steps,
            start_step=self.step,
            num_cells=self.env.coverage.num_cells,
            warm_up=self.config.explorer.warm_up_steps,
        )
        if (count := self.programs.learning.num_devices) > 1:
            self.progress.say(f"The seeds are spread over {count} devices")
        if resume:
            known = f"Continuing from step {self.step:,}" if restored else "There is no checkpoint yet: starting over"
            self.progress.say(known)

    def _check_identity(self, meta: dict[str, Any]) -> None:
        """A checkpoint is of the run that its directory says."""
        saved = meta.get("identity")
        # It may be of before the run was made longer, and its replay with it.
        capacity = meta.get("data_capacity", self.config.explorer.data_capacity)
        explorer = dataclasses.replace(self.config.explorer, data_capacity=capacity)
        then = dataclasses.replace(self.config, steps=meta.get("steps", self.config.steps), explorer=explorer)
        if saved is not None and saved != dataclasses.replace(self.spec, config=then).identity:
            raise RunError(
                f"the checkpoints in {self.directory} are of another run: their identity is {saved}, and the "
                f"configuration has {self.spec.identity}. What to do: put back the run's own files, or start a new run "
                "with another --out."
            )

    def _check_rows(self, step: int) -> None:
        """The rows up to the checkpoint are as they were written: what is missing there is never written again."""
        path = self.directory.metrics_path
        damage = gap(self.config, self.directory.rows() if path.exists() else [], step)
        if damage is None:
            return
        good, what = damage
        steps = self.checkpoints.steps()
        older = [f"{self.checkpoints.directory / str(one)}" for one in steps if one > good]
        usable = on_schedule(self.config, [one for one in steps if one <= good])
        remedy = f", or remove {' and '.join(older)} to continue from the one of step {usable:,}" if usable else ""
        raise RunError(
            f"{path} {what}, from before its checkpoint of step {step:,}. What to do: put back a copy of the "
            f"file{remedy}, or start a new run with another --out."
        )

    def close(self) -> None:
        """End the progress bar and close the files."""
        self.progress.close()
        self.log.close()
        for sink in self.sinks:
            sink.close()

    def diverged(self) -> dict[int, dict[str, Any]]:
        """By seed when and by what its numbers stopped being finite."""
        if self.state.alive.all():
            return {}
        rows = (row for row in self.directory.rows() if row.get("diverged"))
        return {row["seed"]: {"step": row["step"], "what": row["diverged"]} for row in rows}

    def round(self, first: int, end: int) -> None:
        """Take the steps from `first` to `end`, learn, and log."""
        began, config, programs = time.monotonic(), self.config, self.programs
        warming_up, alive = first < config.explorer.warm_up_steps, self.state.alive.copy()
        if programs.stepper.compiles:
            self._announce("environment")
        episode_step = programs.stepper.episode_step(self.state.env)
        actors = programs.actors(self.state.explorer, warming_up and config.warm_up == "uniform")
        env_state, transitions, valid = programs.collect(first, self.state.env, actors, end - first)
        if end < config.explorer.warm_up_steps:
            metrics, finite = {}, {}
            learned = programs.absorb(self.state.explorer, transitions, valid)
        else:
            self._announce("learning")
            obs = programs.stepper.obs(env_state)
            learned, metrics, finite = programs.learn(first, self.state.explorer, transitions, valid, obs, end, alive)
        metrics, finite = jax.device_get((metrics, finite))
        broken = record.broken(finite, alive)
        survivors = alive & np.array([not names for names in broken])
        if not survivors.any():
            # The state before the round, which what follows changes in place.
            self._save(first, dataclasses.replace(self.state, explorer=learned))
        transitions, valid = jax.device_get((transitions, valid))
        own = self._remember(transitions, valid, episode_step, (first, end))
        self.state = dataclasses.replace(self.state, explorer=learned, env=env_state, alive=survivors)
        if self.evaluate is not None and due(config.eval_every, first, end, config.steps):
            self._announce("evaluation")
            metrics = {**metrics, **self.evaluate(end, learned)}
        now = time.monotonic()
        times = {"wall_time": round(now - self.began, 3), "steps_per_second": round((end - first) / (now - began), 3)}
        rows = record.rows(config.seed, end, self.state.visited, alive, (own, metrics, broken, times))
        self.log.append(rows)
        for sink in self.sinks:
            sink.append(rows)
        self.progress.update(end, rows)
        self._say_once("dying", record.dying(rows))
        if not survivors.any():
            self._give_up(broken, (first, end))
        for row in rows:
            if "diverged" in row:
                self.progress.say(
                    f"Seed {row['seed']} stops at step {end:,}: numbers that are not finite ({row['diverged']}). "
                    "The others continue."
                )
        if due(config.checkpoint_every, first, end, config.steps) or end in config.keep_at:
            self._save(end)
        self.step = end

    def _save(self, step: int, state: RunState | None = None) -> None:
        self.log.sync()
        meta = record.meta(self.spec, step, time.monotonic() - self.began)
        self.checkpoints.save(step, state or self.state, meta)

    def _announce(self, what: str) -> None:
        """Say once that something is about to be compiled."""
        self._say_once(what, f"Compiling the {what} step: up to a minute the first time, seconds from the cache later")

    def _say_once(self, about: str, text: str) -> None:
        if text and about not in self._announced:
            self._announced.add(about)
            self.progress.say(text)

    def _give_up(self, broken: list[list[str]], span: tuple[int, int]) -> None:
        """End a run of which no seed has survived the round."""
        self.log.sync()
        self.directory.write_outcome(Status.DIVERGED, self.diverged())
        names = list(dict.fromkeys(name for own in broken for name in own))
        seeds = [self.config.seed + i for i, own in enumerate(broken) if own]
        raise record.diverged_error(self.directory, names, seeds, span)

    def _remember(
        self, transitions: Transition, valid: Any, episode_step: np.ndarray, span: tuple[int, int]
    ) -> list[dict[str, Any]]:
        """Note in the state, in place, what the seeds that are alive saw and earned; what their rows have of it."""
        state, count = self.state, span[1] - span[0]
        # device_get: NumPy itself would wait for the result with Python's lock held, and hang.
        marked = jax.device_get(self.programs.mark(state.visited, transitions.obs, valid))
        state.visited[state.alive] = marked[state.alive]
        rows: Any = transitions
        done = (rows.terminated | rows.truncated)[:, :count]
        if self.env.floor_plan is not None:
            positions = rows.obs[:, :count][..., list(self.env.floor_plan.position)]
            record.walk(state, positions, record.steps_of_episodes(episode_step, done), span)
        own: list[dict[str, Any]] = [{"dropped": int(count - kept.sum())} for kept in valid]
        self._lost = np.where(valid.any(axis=1), 0, self._lost + count)
        if (self._lost[state.alive] >= MOST_LOST).any():
            what = f"returned numbers that are not finite, or beyond float32, in the last {self._lost.max()} steps"
            raise EnvironmentFault(self.env.spec.name, "every step", what, "finite observations and rewards")
        if self.env.spec.has_reward:
            for row, ended in zip(own, record.episodes(state, rows.reward[:, :count], done), strict=True):
                row.update(record.earned(ended))
        return own


def last_state(
    directory: RunDirectory, env: Environment, agent: Explorer, until: int | None = None
) -> tuple[RunState, int]:
    """The state in the latest checkpoint of a run, up to the step `until` if that is given, and its step.

    Raises:
        RunError: there is no such checkpoint, or none that fits the configuration.
    """
    config, checkpoints = directory.config(), directory.checkpoints()
    programs = make_programs(config, env, agent)
    restored = checkpoints.restore_latest(programs.stepper.abstract(programs.init), until, OLDER)
    if restored is None and checkpoints.steps():
        raise RunError(f"{directory} has no checkpoint up to step {until}, only of {checkpoints.steps()}.")
    if restored is None:
        raise RunError(f"{directory} has no checkpoint yet: let it run for {config.checkpoint_every:,} steps.")
    return restored.state, restored.step
