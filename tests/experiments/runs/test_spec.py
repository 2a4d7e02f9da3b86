import dataclasses
import json

import pytest

from experiments.runs import spec, upgrades
from experiments.runs.config import PRESETS, RunConfig, differences, flag, replace
from experiments.runs.presets import ENVIRONMENTS, preset_config
from experiments.runs.spec import RunSpec
from experiments.runs.upgrades import UNTIL_FORMAT_4
from jaxplore.validate import FieldError

# Table "List of SAC hyper-parameters", the appendix on dynamic models, and what nnaisense/max's defaults settle.
PAPER = {
    "steps": 10_000,
    "obs_noise": 0.02,
    "explorer.warm_up_steps": 256,
    "explorer.steps_per_round": 25,
    "explorer.data_capacity": 10_001,
    "explorer.reward_units": "normalized",
    "explorer.dynamics.hidden": (512, 512, 512, 512),
    "explorer.dynamics.activation": "relu",
    "explorer.generator.noise_size": 32,
    "explorer.generator.hidden": (64, 64),
    "explorer.generator.noise": "shared",
    "explorer.svgd.num_particles": 32,
    "explorer.svgd.self_weight": 1.0,
    "explorer.svgd.kernel": "rbf",
    "explorer.svgd.kernel_outputs": "joint",
    "explorer.svgd.bandwidth": "median",
    "explorer.svgd.bandwidth_scale": 1.0,
    "explorer.svgd.likelihood_std": pytest.approx(0.5**0.5),
    "explorer.svgd.learn_likelihood_std": False,
    "explorer.svgd.temperature": 1.0,
    "explorer.svgd.tempering": "constant",
    "explorer.svgd.prior": "flat",
    "explorer.svgd.repulsion_points": "batch",
    "explorer.svgd.redraw": "every_step",
    "explorer.fit.lr": 1e-4,
    "explorer.fit.weight_decay": 1e-5,
    "explorer.fit.batch_size": 256,
    "explorer.fit.epochs": 50,
    "explorer.fit.restart": False,
    "explorer.fit.clip_value": 5.0,
    "explorer.fit.clip_norm": 0.0,
    "explorer.ensemble.num_members": 32,
    "explorer.reactive.updates": 2_450,
    "explorer.reactive.restart_every": 1,
    "explorer.reactive.normalize_reward": False,
    "explorer.reactive.center_reward": False,
    "explorer.reactive.act_greedily": True,
    "explorer.imagination.num_actors": 128,
    "explorer.imagination.horizon": 50,
    "explorer.imagination.num_rollouts": 50,
    "explorer.imagination.num_random_rollouts": 3,
    "explorer.imagination.updates_per_rollout": 50,
    "explorer.imagination.real_updates": 100,
    "explorer.imagination.real_fraction": 0.5,
    "explorer.imagination.current_fraction": 1.0,
    "explorer.imagination.mover": "per_step",
    "explorer.imagination.bound": 0.0,
    "explorer.imagination.replay_capacity": 320_000,
    "explorer.imagination.restart_every": 1,
    "explorer.imagination.keep_imagined": False,
    "explorer.imagination.normalize_reward": False,
    "explorer.imagination.center_reward": False,
    "explorer.imagination.act_greedily": True,
    "explorer.sac.hidden": (256, 256),
    "explorer.sac.activation": "leaky_relu",
    "explorer.sac.init": "orthogonal",
    "explorer.sac.layer_norm": False,
    "explorer.sac.lr": 1e-3,
    "explorer.sac.batch_size": 4096,
    "explorer.sac.alpha": 0.02,
    "explorer.sac.discount": 0.99,
    "explorer.sac.tau": 5e-3,
    "explorer.sac.reward_scale": 1.0,
    "explorer.sac.log_std_map": "tanh",
    "explorer.sac.log_std_min": -20.0,
    "explorer.sac.log_std_max": 2.0,
    "explorer.sac.policy_penalty": 1e-3,
    "explorer.sac.grad_clip": 5.0,
    # haarnoja/sac on the half cheetah: baselines.md, section 7.
    "explorer.task_sac.hidden": (256, 256),
    "explorer.task_sac.activation": "relu",
    "explorer.task_sac.init": "xavier",
    "explorer.task_sac.layer_norm": False,
    "explorer.task_sac.lr": 3e-4,
    "explorer.task_sac.batch_size": 256,
    "explorer.task_sac.alpha": 1.0,
    "explorer.task_sac.learn_alpha": False,
    "explorer.task_sac.discount": 0.99,
    "explorer.task_sac.tau": 5e-3,
    "explorer.task_sac.reward_scale": 5.0,
    "explorer.task_sac.log_std_map": "clip",
    "explorer.task_sac.log_std_min": -20.0,
    "explorer.task_sac.log_std_max": 2.0,
    "explorer.task_sac.policy_penalty": 0.0,
    "explorer.task_sac.grad_clip": 1e6,
    "explorer.model_free.updates_per_round": 25,
    "explorer.model_free.act_greedily": False,
}


def to_json(config: RunConfig) -> str:
    return spec.to_json(RunSpec(config))


def from_json(text: str, source: str) -> RunConfig:
    return spec.from_json(text, source).config


def look_up(config, path):
    for name in path.split("."):
        config = getattr(config, name)
    return config


@pytest.mark.parametrize("path", PAPER)
def test_the_paper_preset_is_the_paper(path: str):
    assert look_up(preset_config("paper"), path) == PAPER[path]


def test_the_laptop_preset_takes_10000_steps_of_the_same_size():
    laptop, paper = preset_config("laptop"), preset_config("paper")
    assert laptop.steps == 10_000
    for path in ("explorer.warm_up_steps", "explorer.steps_per_round", "explorer.svgd.num_particles"):
        assert look_up(laptop, path) == look_up(paper, path)
    assert laptop.preset == "laptop"
    assert RunConfig().preset == "laptop"


def test_the_smoke_preset_is_smaller_in_everything_that_costs():
    smoke, laptop = preset_config("smoke"), preset_config("laptop")
    for path in ("steps", "explorer.fit.steps", "explorer.imagination.horizon", "explorer.imagination.num_actors"):
        assert look_up(smoke, path) < look_up(laptop, path)
    assert smoke.steps > smoke.explorer.warm_up_steps + 10 * smoke.explorer.steps_per_round


def test_what_was_chosen_for_the_generator_is_not_static_networks():
    """One preset, and a weight of entropy that was searched for each; the rest they share."""
    proposed, static = (preset_config("laptop", "ant_maze", method).explorer for method in ("implicit", "disagreement"))
    assert (proposed.sac.alpha, static.sac.alpha) == (0.05, 0.02)
    assert dataclasses.replace(proposed, sac=static.sac) == static
    assert preset_config("laptop", "acrobot", "max").explorer.sac.alpha == 0.1, "chosen in the maze, for all"
    assert preset_config("laptop", "ant_maze", "max_trajectory").explorer.sac.alpha == 0.2, "its authors' own"


def test_disagreements_networks_are_a_bootstrap_where_the_preset_is_the_papers():
    for name in ("disagreement", "disagreement_grad"):
        assert preset_config("paper", "ant_maze", name).explorer.ensemble.bootstrap == "poisson"
    assert preset_config("paper", "ant_maze", "max").explorer.ensemble.bootstrap == "none"


def test_one_reward_has_one_weight_of_entropy():
    for one, other in (("disagreement", "disagreement_reactive"), ("icm", "icm_active"), ("max", "max_reactive")):
        here, there = (preset_config("laptop", "ant_maze", name).explorer for name in (one, other))
        assert here.sac == there.sac


@pytest.mark.parametrize("env", sorted(ENVIRONMENTS))
def test_the_laptops_generators_are_kept_apart(env: str):
    """What makes them the paper's: several draws of a generator meet on one batch, where SVGD compares them, and no
    feature of z can die. Without that each generator is a static network in all but name."""
    explorer = preset_config("laptop", env).explorer
    assert explorer.svgd.num_particles > explorer.generator.num_generators
    assert (explorer.svgd.batches, explorer.generator.activation) == ("shared", "tanh")


@pytest.mark.parametrize("method", ["max_trajectory", "icm_active", "rnd_active"])
@pytest.mark.parametrize("preset", PRESETS)
def test_what_is_of_imagination_imagines(method: str, preset: str):
    """Where a preset learns from real transitions alone, these would be another method, or, where the reward compares
    the rows of one imagined step, none."""
    imagination = preset_config(preset, "ant_maze", method).explorer.imagination
    assert imagination.real_fraction == 0.0
    if method == "max_trajectory":
        assert imagination.real_updates == 0


def test_the_papers_methods_are_fitted_alike():
    assert preset_config("paper", "ant_maze").explorer.fit == preset_config("paper", "ant_maze", "max").explorer.fit


@pytest.mark.parametrize("preset", PRESETS)
def test_json_and_back(preset: str):
    config = preset_config(preset)
    assert from_json(to_json(config), "config.json") == config
    changed = dataclasses.replace(config, seed=7, obs_noise=0.5)
    assert from_json(to_json(changed), "config.json") == changed


def test_what_json_leaves_out_comes_from_its_preset():
    config = from_json('{"preset": "smoke", "explorer": {"sac": {"lr": 1, "hidden": [3]}}}', "c")
    assert config == dataclasses.replace(
        preset_config("smoke"),
        explorer=dataclasses.replace(
            preset_config("smoke").explorer,
            sac=dataclasses.replace(preset_config("smoke").explorer.sac, lr=1.0, hidden=(3,)),
        ),
    )
    assert isinstance(config.explorer.sac.lr, float)
    assert from_json("{}", "c") == preset_config("laptop")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"c\.json is not JSON"),
        ("[]", r"c\.json holds list"),
        ('{"sead": 1}', r"c\.json: field='sead' is not known. Did you mean 'seed'\? Allowed: .*steps"),
        ('{"explorer": {"sac": {"lrr": 1}}}', r"'explorer\.sac\.lrr' is not known\. Did you mean 'explorer\.sac\.lr'"),
        ('{"explorer": 3}', r"c\.json: explorer=3\. Allowed: an object"),
        ('{"seed": "1"}', r"c\.json: seed='1'\. Allowed: a value of type int"),
        ('{"seed": true}', r"c\.json: seed=True\. Allowed: a value of type int"),
        ('{"seed": 1.5}', r"c\.json: seed=1\.5\. Allowed: a value of type int"),
        ('{"seed": -1}', r"c\.json: seed=-1 is out of range\. Allowed: a whole number, 0 or more"),
        ('{"obs_noise": true}', r"c\.json: obs_noise=True\. Allowed: a value of type float"),
        ('{"obs_noise": NaN}', r"c\.json: obs_noise=nan is out of range"),
        ('{"explorer": {"fit": {"restart": 1}}}', r"c\.json: explorer\.fit\.restart=1\. Allowed: a value of type bool"),
        ('{"explorer": {"sac": {"hidden": 8}}}', r"c\.json: explorer\.sac\.hidden=8\. Allowed: a value of type tuple"),
        ('{"explorer": {"sac": {"hidden": [8.5]}}}', r"c\.json: explorer\.sac\.hidden=8\.5 is out of range"),
        ('{"explorer": {"sac": {"hidden": []}}}', r"c\.json: explorer\.sac\.hidden=\(\) is not a list of layer widths"),
        ('{"explorer": {"sac": {"lr": 0}}}', r"c\.json: explorer\.sac\.lr=0\.0 .*Allowed: a finite number in \(0, inf"),
        (
            '{"explorer": {"sac": {"discount": 2}}}',
            r"explorer\.sac\.discount=2\.0 .*Allowed: a finite number in \[0, 1",
        ),
        ('{"env": "ant_mase"}', r"c\.json: env='ant_mase' is not known\. Did you mean 'ant_maze'"),
        (
            '{"preset": "papre"}',
            r"c\.json: preset='papre' is not known\. Did you mean 'paper'\? Allowed: laptop, paper",
        ),
        ('{"preset": null}', r"c\.json: preset=None is not known\. Allowed: laptop, paper"),
        ('{"method": "implict"}', r"c\.json: method='implict' is not known\. Did you mean 'implicit'"),
        ('{"steps": 10}', r"c\.json: steps=10 ends within the random steps .*Allowed: at least warm_up_steps=256"),
    ],
)
def test_bad_json_is_refused_with_its_place(text: str, message: str):
    with pytest.raises(ValueError, match=message):
        from_json(text, "c.json")


def spelled(config: RunConfig, changes: dict) -> None:
    """Change a configuration as the command line does."""
    try:
        replace(config, changes)
    except FieldError as error:
        raise ValueError(error.spell(flag(error.field))) from error


def test_a_message_spells_a_field_as_its_flag():
    assert flag("explorer.sac.batch_size") == "--sac.batch-size"
    assert flag("num_seeds") == "--num-seeds"
    with pytest.raises(ValueError, match=r"^--sac\.batch-size=0 is out of range\. Allowed: a whole number, 1 or more"):
        spelled(RunConfig(), {"explorer": {"sac": {"batch_size": 0}}})
    with pytest.raises(ValueError, match=r"^--svgd\.self-weight=0\.5 diverges with redraw='fixed'"):
        spelled(RunConfig(), {"explorer": {"svgd": {"self_weight": 0.5, "redraw": "fixed"}}})


def test_differences_are_named_as_flags_are():
    saved = preset_config("laptop")
    assert differences(saved, saved) == []
    wanted = replace(saved, {"seed": 3, "explorer": {"warm_up_steps": 9, "sac": {"hidden": [8]}}})
    assert differences(saved, wanted) == [
        "seed: 0 -> 3",
        "warm_up_steps: 256 -> 9",
        "sac.hidden: (128, 128) -> (8,)",
    ]


def test_a_saved_configuration_names_every_field():
    def paths(value, prefix=""):
        if not dataclasses.is_dataclass(value):
            return {prefix}
        return {
            path
            for item in dataclasses.fields(value)
            for path in paths(getattr(value, item.name), f"{prefix}.{item.name}")
        }

    def keys(value, prefix=""):
        if not isinstance(value, dict):
            return {prefix}
        return {path for name, inner in value.items() for path in keys(inner, f"{prefix}.{name}")}

    saved = json.loads(to_json(RunConfig()))
    assert (
        {saved.pop("format"), saved.pop("parent")} == {5, None}
        and saved.pop("imports") == []
        and len(saved.pop("identity")) == 16
    )
    assert keys(saved) == paths(RunConfig())


def test_a_belief_of_before_format_4_is_what_it_was():
    # whatever a preset has by now; a file that leaves fields out leaves them to the preset
    saved = json.loads(spec.to_json(RunSpec(RunConfig())))
    saved["format"] = 3
    for group, then in UNTIL_FORMAT_4.items():
        for name in then:
            del saved["explorer"][group][name]
    start = replace(
        preset_config("laptop"),
        {"explorer": {"generator": {"bootstrap": "poisson", "prior_scale": 1.0}, "ensemble": {"bootstrap_std": 0.5}}},
    )
    found = upgrades.upgrade(saved, start, 3)["explorer"]
    for group, then in UNTIL_FORMAT_4.items():
        assert {name: found[group][name] for name in then} == then
    assert upgrades.upgrade({"explorer": {"svgd": {"num_particles": 8}}}, start, 3)["explorer"]["svgd"] == {
        "num_particles": 8
    }


def test_a_generator_of_before_there_were_settings_for_it_is_what_it_was():
    # whatever the preset has now; a file that leaves fields out leaves them to the preset
    saved = json.loads(spec.to_json(RunSpec(RunConfig())))
    saved["format"] = 1
    generator = saved["explorer"]["generator"]
    for field in ("activation", "normalize", "num_generators"):
        del generator[field]
    old = spec.from_json(json.dumps(saved), "c.json").config.explorer.generator
    assert (old.activation, old.normalize, old.num_generators) == ("relu", False, 1)
    partial = spec.from_json('{"format": 1, "explorer": {"generator": {"noise_size": 8}}}', "c.json").config
    preset = preset_config("laptop").explorer.generator
    assert partial.explorer.generator == dataclasses.replace(preset, noise_size=8)


def test_sac_of_before_format_5_is_what_it_was_and_keeps_its_identity():
    # whatever a preset has by now, and also where fields are missing that SAC did not always have
    config = replace(preset_config("laptop", "acrobot", "sac"), {"explorer": {"task_sac": {"log_std_map": "tanh"}}})
    now = RunSpec(config)
    saved = json.loads(spec.to_json(now))
    saved["format"] = 4
    del saved["warm_up"], saved["keep_at"]
    for group in ("sac", "task_sac"):
        del saved["explorer"][group]["log_std_map"], saved["explorer"][group]["layer_norm"]
    old = spec.from_json(json.dumps(saved), "c.json", as_written=True)
    assert old == now and old.identity == now.identity
    assert old.identity == "de723502dc983229", "as it was before there were these settings"
    changed = replace(config, {"explorer": {"task_sac": {"log_std_map": "clip"}}})
    assert RunSpec(changed).identity != now.identity
    assert RunSpec(dataclasses.replace(config, warm_up="none")).identity != now.identity
    assert RunSpec(dataclasses.replace(config, keep_at=(50,))).identity == now.identity
    written = '{"format": 4, "env": "acrobot", "method": "sac", "explorer": {"task_sac": {"lr": 1e-4}}}'
    assert spec.from_json(written, "c.json").config.explorer.task_sac.log_std_map == "clip"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"warm_up": "policies"}, r"warm_up='policies' is not known\. Did you mean 'policy'\?"),
        ({"explorer": {"warm_up_steps": 0}}, r"warm_up='uniform' has no steps, as warm_up_steps=0\. Allowed: none, or"),
        (
            {"keep_at": (2_010,)},
            r"keep_at=2010 cannot be kept\. Allowed: ends of rounds up to 10000: multiples of step",
        ),
        ({"keep_at": (2_000, 10_025)}, r"keep_at=10025 cannot be kept"),
        ({"keep_at": ("2000",)}, r"keep_at='2000' cannot be kept"),
    ],
)
def test_a_bad_start_or_checkpoint_is_refused(changes: dict, message: str):
    with pytest.raises(FieldError, match=message):
        replace(preset_config("laptop"), changes)


def test_without_a_warm_up_there_are_no_steps_of_one():
    config = dataclasses.replace(preset_config("laptop"), warm_up="none", keep_at=(256 + 19, 10_000))
    assert config.explorer.warm_up_steps == 0
    assert from_json(to_json(config), "config.json") == config
    assert dataclasses.replace(preset_config("laptop"), keep_at=(256,)).keep_at == (256,), "the warm-up's end"


def test_a_policy_warms_up_only_with_a_parent():
    config = dataclasses.replace(preset_config("laptop", "acrobot", "sac"), warm_up="policy")
    with pytest.raises(FieldError, match=r"warm_up='policy' has no parent whose policy acts\. Allowed: uniform, none"):
        RunSpec(config)
    assert RunSpec(config, spec.RunRef("runs/explored", 4_000)).config.warm_up == "policy"


def test_the_tasks_learners_have_a_million_steps_on_the_cheetah_and_explorers_do_not():
    for preset in ("laptop", "paper"):
        config = preset_config(preset, "half_cheetah_task", "sac")
        assert (config.steps, config.explorer.data_capacity, config.explorer.warm_up_steps) == (10**6, 10**6, 10**4)
        assert (config.eval_every, config.eval_episodes) == (5_000, 5)
        explorer = preset_config(preset, "half_cheetah_task", "implicit")
        assert explorer == dataclasses.replace(preset_config(preset, "brax:hopper"), env="half_cheetah_task")
