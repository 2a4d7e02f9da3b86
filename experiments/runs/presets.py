"""What the presets set, per environment. An environment that is not in the table has the defaults."""

import dataclasses
from typing import Any, cast

import envs
from experiments.runs.config import PRESETS, Preset, RunConfig, replace
from jaxplore import (
    METHODS,
    DynamicsConfig,
    EnsembleConfig,
    ExplorationConfig,
    FitConfig,
    GeneratorConfig,
    GradientPolicyConfig,
    ImaginationConfig,
    MCTSConfig,
    ModelFreeConfig,
    PPOConfig,
    ReactiveConfig,
    RNDConfig,
    SACConfig,
    SVGDConfig,
    validate,
)

LAPTOP = ExplorationConfig(
    dynamics=DynamicsConfig(hidden=(64, 64)),
    generator=GeneratorConfig(hidden=(64, 16), activation="tanh", num_generators=4),
    svgd=SVGDConfig(temperature=0.2, tempering="per_datum"),
    fit=FitConfig(lr=3e-3, weight_decay=0.0, batch_size=128, epochs=0, steps=60, restart=False),
    imagination=ImaginationConfig(
        horizon=25,
        num_rollouts=4,
        num_random_rollouts=0,
        updates_per_rollout=75,
        real_updates=0,
        real_fraction=1.0,
        current_fraction=0.5,
        mover="per_rollout",
        bound=10.0,
        replay_capacity=25_600,
        restart_every=12,
        keep_imagined=False,
        normalize_reward=True,
    ),
    reactive=ReactiveConfig(updates=300, restart_every=12, normalize_reward=True),
    sac=SACConfig(hidden=(128, 128), batch_size=256, alpha=0.05, log_std_min=-5.0),
    gradient=GradientPolicyConfig(
        updates=100, batch_size=64, hidden=(128, 128), restart=False, normalize_reward=True, bound=10.0
    ),
    rnd=RNDConfig(hidden=(64, 64), features=64, lr=1e-3),
    ppo=PPOConfig(hidden=(64, 64)),
)
"""Settings for a laptop without a GPU: four generators, whose features cannot die and whose draws SVGD keeps apart, and
a policy that learns from what happened. See `experiments/results/ant_maze_laptop/TUNING.md`."""

SMOKE = dataclasses.replace(
    LAPTOP,
    dynamics=DynamicsConfig(hidden=(32, 32)),
    generator=dataclasses.replace(LAPTOP.generator, noise_size=4, hidden=(8, 4), num_generators=2),
    fit=dataclasses.replace(LAPTOP.fit, lr=1e-3, steps=10),
    imagination=dataclasses.replace(
        LAPTOP.imagination, horizon=10, num_actors=32, num_rollouts=1, updates_per_rollout=20, real_fraction=0.5
    ),
    reactive=dataclasses.replace(LAPTOP.reactive, updates=20),
    sac=dataclasses.replace(LAPTOP.sac, hidden=(32, 32), batch_size=64),
    gradient=dataclasses.replace(LAPTOP.gradient, updates=5, hidden=(32, 32)),
    rnd=dataclasses.replace(LAPTOP.rnd, hidden=(32, 32), features=16),
    ppo=dataclasses.replace(LAPTOP.ppo, hidden=(32, 32)),
    task_sac=dataclasses.replace(LAPTOP.task_sac, hidden=(32, 32), batch_size=64),
)
"""The laptop's settings cut down until nothing can be learned: it shows that everything runs."""

NCHAIN_PAPER = ExplorationConfig(
    warm_up_steps=147,
    steps_per_round=1,
    planner="mcts",
    dynamics=DynamicsConfig(hidden=(256, 256, 256, 256), activation="tanh", target="one_hot"),
    svgd=SVGDConfig(num_particles=5),
    fit=FitConfig(lr=1e-4, weight_decay=1e-6, batch_size=32, epochs=10, restart=False),
    ensemble=EnsembleConfig(num_members=5),
    model_free=ModelFreeConfig(updates_per_round=1),
    reactive=ReactiveConfig(updates=50, restart_every=0, normalize_reward=True, act_greedily=False),
)
"""The paper's agent for the chain: after every step 10 further epochs, 5 new draws, and a tree search in them. Random
are the first 3 episodes of 49 steps; batch 32 is ours, as the paper is silent on both."""

NCHAIN_LAPTOP = dataclasses.replace(
    NCHAIN_PAPER,
    dynamics=dataclasses.replace(NCHAIN_PAPER.dynamics, hidden=(64, 64)),
    generator=GeneratorConfig(activation="tanh"),
    svgd=dataclasses.replace(NCHAIN_PAPER.svgd, temperature=0.003),
    ddqn=dataclasses.replace(NCHAIN_PAPER.ddqn, lr=1e-3),
    fit=dataclasses.replace(NCHAIN_PAPER.fit, lr=1e-3, epochs=0, steps=10),
    mcts=MCTSConfig(num_iterations=100, num_trajectories=300),
)
"""Small networks, and as many gradient steps at the end of a run as at its start. More trajectories than the paper's:
once the models are sure of a long stretch, few random ones of 49 steps reach what lies beyond it, and with no utility
in sight the search walks at random. With 100 of them one seed of five stops at 38 states, with the paper's search
(25 x 10) all do at 30 to 36."""

NCHAIN_SMOKE = dataclasses.replace(
    NCHAIN_LAPTOP,
    dynamics=dataclasses.replace(NCHAIN_PAPER.dynamics, hidden=(16,)),
    fit=dataclasses.replace(NCHAIN_LAPTOP.fit, steps=2),
    mcts=MCTSConfig(num_iterations=5, num_trajectories=2),
)
"""Nothing can be learned with these."""

DEFAULTS: dict[str, dict[str, Any]] = {
    "laptop": {"explorer": LAPTOP},
    "paper": {"explorer": ExplorationConfig()},
    "smoke": {"explorer": SMOKE, "steps": 600, "checkpoint_every": 200},
}
"""Preset -> fields of `RunConfig`."""

ENVIRONMENTS: dict[str, dict[str, dict[str, Any]]] = {
    # Observation noise in nnaisense/max's commands, raw units; the paper is silent.
    "ant_maze": {
        "paper": {"obs_noise": 0.02},
    },
    "half_cheetah": {"paper": {"obs_noise": 0.02}},
    # Ten episodes.
    "mountain_car": {"laptop": {"steps": 5_000}},
    # The paper's scores are hundreds of steps: with 256 random steps at the start many runs would end among them.
    "acrobot": {
        "laptop": {"explorer": dataclasses.replace(LAPTOP, warm_up_steps=50)},
        "paper": {"explorer": ExplorationConfig(warm_up_steps=50)},
        "smoke": {"explorer": dataclasses.replace(SMOKE, warm_up_steps=50)},
    },
    # 15 episodes of 49 steps.
    "nchain": {
        "laptop": {"explorer": NCHAIN_LAPTOP, "steps": 735, "checkpoint_every": 147},
        "paper": {"explorer": NCHAIN_PAPER, "steps": 735, "checkpoint_every": 147},
        "smoke": {"explorer": NCHAIN_SMOKE, "steps": 196, "checkpoint_every": 98},
    },
}
"""Environment -> preset -> the fields in which it departs from the defaults. A new environment adds its own."""

LITTLE_ENTROPY, MUCH_ENTROPY = {"sac": {"alpha": 0.02}}, {"sac": {"alpha": 0.1}}
RESAMPLED = {"ensemble": {"bootstrap": "poisson"}}
OF_METHOD: dict[str, dict[str, dict[str, Any]]] = {
    "laptop": {
        **dict.fromkeys(("disagreement", "disagreement_reactive", "icm", "icm_active"), LITTLE_ENTROPY),
        **dict.fromkeys(("max", "max_reactive"), MUCH_ENTROPY),
    },
    "paper": dict.fromkeys(("disagreement", "disagreement_reactive", "disagreement_grad"), RESAMPLED),
}
"""Preset -> method -> the explorer's settings that are its own. Laptop: SAC's weight of entropy, chosen in the maze
for `disagreement`, `icm` and `max` by a search of the same size as for `implicit`, and what has the same reward has it,
too. Paper: the "bootstrap ensemble" of disagreement."""

TASK_RUN = {"steps": 1_000_000, "checkpoint_every": 10_000, "eval_every": 5_000}
"""A million steps, as the paper has them, evaluated every 5,000."""
TASK_EXPLORER = {"warm_up_steps": 10_000, "data_capacity": 1_000_000}
"""A replay that holds them all, 160 MB, and the warm-up of haarnoja/sac and of the paper."""

WITH_A_TASK: dict[tuple[str, str], tuple[dict[str, Any], dict[str, Any]]] = {
    (env, preset): (TASK_RUN, TASK_EXPLORER)
    for env in ("half_cheetah_task", "half_cheetah_transfer")
    for preset in ("laptop", "paper")
}
"""Environment and preset -> what the run, and its explorer, have where the task's reward is learned from, and not
otherwise."""


def settings(preset: str, env: str) -> dict[str, Any]:
    """The fields of `RunConfig` that a preset sets in an environment; both names must be known."""
    return {**DEFAULTS[preset], **ENVIRONMENTS.get(env, {}).get(preset, {})}


def preset_config(preset: str, env: str = "ant_maze", method: str = "implicit") -> RunConfig:
    """The configuration that a preset stands for, with the settings that the method departs in.

    Raises:
        FieldError: unknown `preset`, `env` or `method`, naming the nearest match.
    """
    validate.one_of("preset", preset, PRESETS)
    validate.one_of("method", method, METHODS)
    envs.check_name(env)
    config = RunConfig(env=env, method=method, preset=cast(Preset, preset), **settings(preset, env))
    row = METHODS[method]
    explorer = replace(config.explorer, OF_METHOD.get(preset, {}).get(method, {}))
    run: dict[str, Any] = {}
    if row.needs_reward and (env, preset) in WITH_A_TASK:
        run, own = WITH_A_TASK[env, preset]
        explorer = dataclasses.replace(explorer, **own)
    return dataclasses.replace(config, explorer=row.settings(explorer), **run)
