"""What a method says that it reads is what it reads, and a belief judges as its encoding does by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import (
    METHODS,
    DynamicsConfig,
    EnsembleConfig,
    ExplorationConfig,
    GeneratorConfig,
    ReactiveConfig,
    RNDConfig,
    SACConfig,
    Sizes,
    SVGDConfig,
    Transition,
    dynamics,
    make_ensemble_belief,
    make_generator_belief,
    normalizer,
)
from jaxplore.behaviours.distillation import make_rnd_learner
from jaxplore.learners.sac import make_sac
from jaxplore.methods import SHARED

TINY = ExplorationConfig(
    dynamics=DynamicsConfig(hidden=(4,)),
    generator=GeneratorConfig(hidden=(4,), noise_size=2),
    svgd=SVGDConfig(num_particles=3),
    ensemble=EnsembleConfig(num_members=3),
)
CHAIN = dataclasses.replace(TINY, planner="mcts", dynamics=DynamicsConfig(hidden=(4,), target="one_hot"))


class Recorder:
    """A configuration that notes which of its fields are looked at."""

    def __init__(self, config: ExplorationConfig) -> None:
        self.config, self.read = config, set()

    def __getattr__(self, name: str):
        self.read.add(name)
        return getattr(self.config, name)


def sizes_for(name: str, planner: str) -> Sizes:
    discrete = planner == "mcts" or METHODS[name].actions == "discrete"
    return Sizes(4, 2, discrete=discrete, one_hot_obs=discrete, has_reward=True)


PAIRS = [(name, planner) for name in METHODS for planner in ("sac", "mcts")]


@pytest.mark.parametrize(("name", "planner"), [pair for pair in PAIRS if METHODS[pair[0]].fits(sizes_for(*pair))])
def test_a_method_reads_what_it_says(name: str, planner: str):
    method, config, sizes = METHODS[name], CHAIN if planner == "mcts" else TINY, sizes_for(name, planner)
    recorder = Recorder(config)
    belief = method.belief(sizes, recorder)
    reward = method.reward(recorder)
    method.behaviour(sizes, recorder, belief, reward.score)
    # The divergence's decay is read for every belief, by the agent; units only label some rewards.
    assert recorder.read - method.reads(config) == set()
    assert method.reads(config) - recorder.read - {*SHARED, "renyi_decay"} <= {"dynamics"}


@pytest.mark.parametrize("target", ["delta", "one_hot"])
def test_a_belief_judges_as_its_encoding_does_by_hand(target: str):
    config = DynamicsConfig(hidden=(4,), target=target)
    belief = make_generator_belief(
        3, 2, config, GeneratorConfig(hidden=(4,), noise_size=2), SVGDConfig(num_particles=5)
    )
    obs, next_obs = jax.nn.one_hot(jnp.array([[0, 1, 2, 2], [1, 2, 0, 1]]), 3) + (0.5 if target == "delta" else 0.0)
    action, zero, flag = jnp.eye(2)[jnp.array([0, 1, 1, 0])], jnp.zeros(4), jnp.zeros(4, bool)
    rows = Transition(obs, action, zero, next_obs, flag, flag)
    normalizers = dynamics.update_normalizers(dynamics.init_normalizers(3, 2), rows, ~flag)
    models = belief.sample(jax.random.key(0), belief.init(jax.random.key(1)), belief.num_models)
    prediction, found = belief.judge(models, normalizers, rows)
    if target == "delta":
        inputs = jnp.concatenate(
            [normalizer.normalize(normalizers.obs, obs), normalizer.normalize(normalizers.action, action)], -1
        )
        wanted = (next_obs - obs - normalizers.delta.mean[None]) / normalizers.delta.std[None]
    else:
        inputs, wanted = jnp.concatenate([obs, action], -1), next_obs
    assert prediction.mean.shape == (5, 4, 3) and belief.num_models == 5
    np.testing.assert_allclose(prediction.mean, belief.predict(models, inputs).mean, atol=1e-6)
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_m_is_the_ensembles_own():
    belief = make_ensemble_belief(
        3, 1, dynamics_config=DynamicsConfig(hidden=(4,)), ensemble_config=EnsembleConfig(num_members=6)
    )
    assert belief.num_models == 6
    state = belief.init(jax.random.key(0))
    assert jax.tree.leaves(belief.sample(jax.random.key(1), state, belief.num_models))[0].shape[0] == 6


def test_distillation_scores_successors_by_its_own_error():
    # the bonus that `assess` reports, beside target and predictor evaluated by hand
    learner = make_sac(3, 1, SACConfig(hidden=(4,), batch_size=4))
    behaviour = make_rnd_learner(learner, 3, 5, ReactiveConfig(updates=1), RNDConfig(hidden=(4,), features=2))
    state = behaviour.init(jax.random.key(0))
    obs, flag = jax.random.normal(jax.random.key(1), (5, 3)), jnp.zeros(5, bool)
    rows = Transition(obs, jnp.zeros((5, 1)), jnp.zeros(5), 2.0 * obs, flag, flag)
    normalizers = dynamics.update_normalizers(dynamics.init_normalizers(3, 1), rows, ~flag)
    assert behaviour.bonus is not None
    given = behaviour.bonus.score(state, normalizers, rows)

    def run(params, x):
        for name in sorted(name for name in params if name.startswith("hidden")):
            x = x @ params[name]["kernel"] + params[name]["bias"][None]
            x = jnp.where(x > 0, x, 0.01 * x)
        return x @ params["output"]["kernel"] + params["output"]["bias"][None]

    seen = jnp.clip(normalizer.normalize(normalizers.obs, 2.0 * obs), -5.0, 5.0)
    wanted = jnp.mean((run(state.rnd.predictor, seen) - run(state.rnd.target, seen)) ** 2, axis=-1)
    np.testing.assert_allclose(given, wanted, rtol=1e-4)
