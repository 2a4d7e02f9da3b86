"""The methods table: a method is a signal, which says how interesting a transition is, and a behaviour that turns it
into actions.

A signal is an intrinsic reward read off a belief over the dynamics, random network distillation, or the task's own
reward. Everything else is shared. Where actions are discrete, double DQN stands in for the SAC of a method. To add a
method, add a row; what it needs and `jaxplore.parts` does not offer is one new factory.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal, NamedTuple

from jaxplore import validate
from jaxplore.behaviours.base import Behaviour
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.parts import (
    distillation,
    distillation_beside,
    divergence_reward,
    error_reward,
    fields_read,
    gaussian_belief,
    generator_belief,
    information_reward,
    informed_sac,
    lasting_sac_on_real_data,
    model_free_ddpg,
    model_free_ddqn,
    model_free_sac,
    planned,
    ppo_on_own_steps,
    read_off,
    reward_gradient,
    sac_in_imagination,
    sac_on_real_data,
    spread_reward,
    static_belief,
    task_reward,
    uniform_actions,
    variance_reward,
)
from jaxplore.signals.base import Signal

Actions = Literal["any", "continuous", "discrete"]


class Method(NamedTuple):
    """One row of the table. Each entry makes its part from the configuration."""

    summary: str
    """What it is, for `--help` and tables."""
    signal: Callable[[Sizes, ExplorationConfig], Signal]
    behaviour: Callable[[Sizes, ExplorationConfig, Signal], Behaviour]
    needs_reward: bool = False
    """Whether it learns from the environment's own reward."""
    actions: Actions = "any"
    """Which actions it can choose."""
    settings: Callable[[ExplorationConfig], ExplorationConfig] = lambda config: config
    """Where it departs from the settings that all share, as its authors have it; what a user sets comes on top."""
    finite: bool = True
    """Whether it can run where both observations and actions are finitely many, as on the chain."""

    def fits(self, sizes: Sizes) -> bool:
        """Whether it can run in an environment of these sizes, as far as this row says."""
        kind = "discrete" if sizes.discrete else "continuous"
        takes = self.actions in ("any", kind) and (self.finite or not _finite(sizes))
        return takes and (sizes.has_reward or not self.needs_reward)

    def reads(self, config: ExplorationConfig, sizes: Sizes | None = None) -> frozenset[str]:
        """Fields of the configuration that this method looks at; those of a part that does not say so: all.

        Args:
            config: all settings, some of which decide on others.
            sizes: of the environment; whether its actions are discrete decides on the learner. None: not known. Then
                those that are read where actions are numbers and, where the method takes both, what is read for
                discrete ones alone and is not as it is by default.
        """
        if sizes is not None or self.actions != "any":
            return self._reads(config, self.actions == "discrete" if sizes is None else sizes.discrete)
        numbers, choices = (self._reads(config, discrete) for discrete in (False, True))
        defaults = ExplorationConfig()
        return numbers | {name for name in choices - numbers if getattr(config, name) != getattr(defaults, name)}

    def _reads(self, config: ExplorationConfig, discrete: bool) -> frozenset[str]:
        return frozenset({*SHARED, *fields_read(self.signal, config), *fields_read(self.behaviour, config, discrete)})


def _finite(sizes: Sizes) -> bool:
    return sizes.discrete and sizes.one_hot_obs


SHARED = ("warm_up_steps", "steps_per_round", "data_capacity")
"""Fields that every method reads."""


def as_sac_v2(config: ExplorationConfig) -> ExplorationConfig:
    """SAC's second form: a learned entropy weight, and the reward as it is."""
    return dataclasses.replace(
        config, task_sac=dataclasses.replace(config.task_sac, learn_alpha=True, reward_scale=1.0)
    )


def as_informed(config: ExplorationConfig) -> ExplorationConfig:
    """`as_sac_v2`, and a belief that goes on from round to round with a gradient step for each of SAC's updates."""
    steps = config.model_free.updates_per_round
    return dataclasses.replace(
        as_sac_v2(config), fit=dataclasses.replace(config.fit, epochs=0, steps=steps, restart=False)
    )


def as_maxinfo(config: ExplorationConfig) -> ExplorationConfig:
    """Sukhija et al.'s code: five networks of 2 x 256 with swish, Adam at 3e-4 on batches of 256, nothing clipped."""
    config = as_informed(config)
    return dataclasses.replace(
        config,
        dynamics=dataclasses.replace(config.dynamics, hidden=(256, 256), activation="swish"),
        ensemble=dataclasses.replace(config.ensemble, num_members=5),
        fit=dataclasses.replace(config.fit, lr=3e-4, weight_decay=0.0, batch_size=256, clip_value=0.0, clip_norm=0.0),
    )


def as_explorer(config: ExplorationConfig) -> ExplorationConfig:
    """SAC at the task with all settings that explorers have: the exploration column of the paper's table."""
    return dataclasses.replace(config, task_sac=config.sac)


def as_baselines_default(config: ExplorationConfig) -> ExplorationConfig:
    """DDPG's networks as openai/baselines has them where nothing is set, so perhaps as the paper ran them."""
    return dataclasses.replace(config, ddpg=dataclasses.replace(config.ddpg, layer_norm=False, activation="tanh"))


def as_max(config: ExplorationConfig) -> ExplorationConfig:
    """nnaisense/max's networks: swish, where they are Gaussian."""
    if config.dynamics.target == "one_hot":
        return config
    return dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, activation="swish"))


def as_max_reactive(config: ExplorationConfig) -> ExplorationConfig:
    """nnaisense/max's command JDRX: 100 updates on real data in each round, of 25 steps."""
    if config.dynamics.target == "one_hot":
        return config
    config = as_max(config)
    return dataclasses.replace(config, reactive=dataclasses.replace(config.reactive, updates=100))


def in_imagination_alone(config: ExplorationConfig) -> ExplorationConfig:
    """No real transitions in a batch, as in nnaisense/max: on these alone it would be another row of the table."""
    return dataclasses.replace(config, imagination=dataclasses.replace(config.imagination, real_fraction=0.0))


def as_max_trajectory(config: ExplorationConfig) -> ExplorationConfig:
    """nnaisense/max's command TVAX: alpha 0.2. Its reward is one number for all that is imagined in a step, so that it
    can say nothing of real transitions.
    """
    config = in_imagination_alone(as_max(config))
    return dataclasses.replace(
        config,
        sac=dataclasses.replace(config.sac, alpha=0.2),
        imagination=dataclasses.replace(config.imagination, real_updates=0),
    )


def as_max_prediction_error(config: ExplorationConfig) -> ExplorationConfig:
    """nnaisense/max's command PERX: 100 updates on real data in each round, of 25 steps, alpha 0.2."""
    config = as_max_reactive(config)
    return dataclasses.replace(config, sac=dataclasses.replace(config.sac, alpha=0.2))


METHODS: dict[str, Method] = {
    "implicit": Method(
        "generator of models trained by amortised SVGD, variance reward, SAC in imagination or tree search",
        read_off(generator_belief, variance_reward),
        planned,
    ),
    "implicit_reactive": Method(
        "generator of models, variance reward, SAC on real transitions, relabelled in each round",
        read_off(generator_belief, variance_reward),
        sac_on_real_data,
    ),
    "implicit_grad": Method(
        "generator of models, variance reward, policy by the reward's own gradient through the models",
        read_off(generator_belief, variance_reward),
        reward_gradient,
        actions="continuous",
    ),
    "disagreement": Method(
        "static networks, variance reward, SAC in imagination or tree search",
        read_off(static_belief, variance_reward),
        planned,
    ),
    "disagreement_reactive": Method(
        "static networks, variance reward, SAC on real transitions, relabelled in each round",
        read_off(static_belief, variance_reward),
        sac_on_real_data,
    ),
    "max": Method(
        "static Gaussian networks, Jensen-Renyi divergence (of probabilities Jensen-Shannon), SAC in imagination or "
        "tree search",
        read_off(gaussian_belief, divergence_reward),
        planned,
        settings=as_max,
    ),
    "max_reactive": Method(
        "static Gaussian networks, Jensen-Renyi divergence, SAC on real transitions (JDRX of nnaisense/max)",
        read_off(gaussian_belief, divergence_reward),
        sac_on_real_data,
        settings=as_max_reactive,
    ),
    "max_trajectory": Method(
        "static Gaussian networks, spread of the imagined changes, SAC in imagination (TVAX of nnaisense/max)",
        read_off(gaussian_belief, spread_reward),
        sac_in_imagination,
        settings=as_max_trajectory,
        finite=False,
    ),
    "prediction_error": Method(
        "static Gaussian networks, error of their mean, SAC on real transitions (PERX of nnaisense/max)",
        read_off(gaussian_belief, error_reward),
        sac_on_real_data,
        settings=as_max_prediction_error,
    ),
    "icm": Method(
        "static networks, error of their mean, SAC on real transitions with as many updates as in imagination",
        read_off(static_belief, error_reward),
        sac_on_real_data,
    ),
    "icm_active": Method(
        "static networks, error of their mean, SAC in imagination, where a model stands for the truth",
        read_off(static_belief, error_reward),
        sac_in_imagination,
        settings=in_imagination_alone,
        finite=False,
    ),
    "disagreement_grad": Method(
        "static networks, variance reward, policy by the reward's own gradient through the models",
        read_off(static_belief, variance_reward),
        reward_gradient,
        actions="continuous",
    ),
    "rnd": Method(
        "random network distillation with PPO, as published",
        distillation,
        ppo_on_own_steps,
        actions="continuous",
    ),
    "rnd_sac": Method(
        "random network distillation with SAC on real transitions, as an ablation",
        distillation,
        lasting_sac_on_real_data,
    ),
    "rnd_active": Method(
        "random network distillation with SAC in imagination, by static networks",
        distillation_beside(static_belief),
        sac_in_imagination,
        settings=in_imagination_alone,
        finite=False,
    ),
    "ddqn": Method(
        "double DQN with epsilon-greedy actions on the environment's own reward, for discrete actions",
        task_reward,
        model_free_ddqn,
        needs_reward=True,
        actions="discrete",
    ),
    "psne": Method(
        "DDPG with adaptive noise in the policy's parameters, on the environment's own reward",
        task_reward,
        model_free_ddpg,
        needs_reward=True,
        actions="continuous",
    ),
    "psne_no_norm": Method(
        "psne without layer normalisation, as an ablation",
        task_reward,
        model_free_ddpg,
        needs_reward=True,
        actions="continuous",
        settings=as_baselines_default,
    ),
    "sac": Method(
        "SAC with a fixed entropy weight on the environment's own reward",
        task_reward,
        model_free_sac,
        needs_reward=True,
        actions="continuous",
    ),
    "sac_v2": Method(
        "SAC with a learned entropy weight on the environment's own reward",
        task_reward,
        model_free_sac,
        needs_reward=True,
        actions="continuous",
        settings=as_sac_v2,
    ),
    "sac_explorer": Method(
        "SAC with the settings that it explores with (nnaisense/max's) on the environment's own reward",
        task_reward,
        model_free_sac,
        needs_reward=True,
        actions="continuous",
        settings=as_explorer,
    ),
    "maxinfo": Method(
        "static networks, SAC on the environment's own reward and on what its actions would tell (MaxInfoSAC)",
        read_off(static_belief, information_reward),
        informed_sac,
        needs_reward=True,
        actions="continuous",
        settings=as_maxinfo,
    ),
    "maxinfo_implicit": Method(
        "generator of models, SAC on the environment's own reward and on what its actions would tell",
        read_off(generator_belief, information_reward),
        informed_sac,
        needs_reward=True,
        actions="continuous",
        settings=as_informed,
    ),
    "random": Method("uniform random actions", task_reward, uniform_actions),
}
"""Name -> method. Add your own with `METHODS["mine"] = Method(...)`."""


def check_fits(method: Method, sizes: Sizes) -> None:
    """Raise unless `method` can run in an environment of these sizes, as far as its row says.

    Raises:
        ValueError: names what it needs, and the methods that fit.
    """
    if method.fits(sizes):
        return
    name = next((f"method={name!r}" for name, row in METHODS.items() if row is method), "this method")
    fitting = ", ".join(name for name, row in METHODS.items() if row.fits(sizes))
    if method.needs_reward and not sizes.has_reward:
        raise ValueError(
            f"{name} learns from the environment's own reward, and this environment has none. "
            f"Allowed: an environment with a reward (EnvSpec.has_reward), or one of the methods {fitting}."
        )
    wanted = "one of several choices" if method.actions == "discrete" else "numbers in [-1, 1]"
    given = f"one of {sizes.action} choices" if sizes.discrete else f"numbers in [-1, 1], {sizes.action} of them"
    kind = method.actions
    if kind == "any":
        wanted += " or, where they are choices, observations that are numbers"
        given += f" and an observation one of {sizes.obs} states"
        kind = "observations that are numbers, or with continuous"
    raise ValueError(
        f"{name} takes actions that are {wanted}; here an action is {given}. "
        f"Allowed: an environment with {kind} actions, or one of the methods {fitting}."
    )


def get_method(name: str) -> Method:
    """The method called `name`.

    Raises:
        ValueError: no such method; names the nearest and lists all.
    """
    validate.one_of("method", name, METHODS)
    return METHODS[name]
