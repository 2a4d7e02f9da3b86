"""From a configuration to an environment and an agent."""

import dataclasses
import inspect

import envs
from envs import coverage
from envs.base import Environment
from experiments.runs.config import RunConfig
from experiments.runs.scene import Scene, scene_of
from jaxplore.beliefs.base import Belief
from jaxplore.config import Sizes
from jaxplore.exploration import Explorer, make_explorer
from jaxplore.methods import get_method
from jaxplore.validate import FieldError


def draws_itself(env: str) -> bool:
    """Whether an environment draws something of its own once and for all, from a run's first seed: seeds carried side
    by side share it.
    """
    return "seed" in inspect.signature(envs.find_factory(env)).parameters


def make_env(config: RunConfig) -> Environment:
    """The environment that a configuration names.

    One that draws something of its own once and for all, such as the chain's flip-states, draws it from the run's first
    seed: seeds carried side by side share it.

    Raises:
        FieldError: the environment refuses an option, or is to be evaluated without a task.
    """
    own = {"seed": config.seed} if draws_itself(config.env) else {}
    env = envs.make(config.env, backend=config.backend, obs_noise=config.obs_noise, **own)
    if config.coverage_dims:
        env = dataclasses.replace(env, coverage=coverage.make_entries_coverage(env.spec, config.coverage_dims))
    if config.eval_every and not env.spec.has_reward:
        problem = f"evaluates by the return, and {config.env} has no task"
        raise FieldError("eval_every", config.eval_every, "0, or an environment with a task", problem, "RunConfig")
    return env


def on_host(config: RunConfig, env: Environment) -> Environment:
    """The same environment with its physics on the host, where it has the choice: there nothing is compiled."""
    if env.backend != "mjx" or config.env not in envs.FACTORIES:
        return env
    return make_env(dataclasses.replace(config, backend="mujoco"))


def sizes_of(env: Environment) -> Sizes:
    """What a method must know of an environment."""
    spec = env.spec
    return Sizes(spec.obs_size, spec.action_size, spec.discrete, spec.one_hot_obs, spec.has_reward)


def make_agent(config: RunConfig, env: Environment) -> Explorer:
    """The agent that a configuration names, for its environment."""
    return make_explorer(get_method(config.method), sizes_of(env), config.explorer)


def make_belief(config: RunConfig, env: Environment) -> Belief:
    """That agent's belief, to be asked."""
    return get_method(config.method).signal(sizes_of(env), config.explorer).belief


def make_scene(config: RunConfig, env: Environment, agent: Explorer) -> Scene:
    """What reports must know of them."""
    return scene_of(env, agent, config.explorer.dynamics.target == "one_hot")
