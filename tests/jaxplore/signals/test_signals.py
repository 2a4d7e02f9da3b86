"""Any signal with any behaviour that fits: what each is worth by hand, what learners are shown, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, replay, rewards
from jaxplore.behaviours import (
    Experience,
    ImaginationConfig,
    ModelFreeConfig,
    ReactiveConfig,
    make_imagination,
    make_informed,
    make_reactive,
)
from jaxplore.behaviours.gradient import GradientPolicyConfig, make_gradient_policy
from jaxplore.beliefs import FitConfig, make_no_belief
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import DynamicsConfig, Prediction
from jaxplore.exploration import make_explorer
from jaxplore.learners import Learner, SACConfig
from jaxplore.methods import METHODS, Method
from jaxplore.parts import (
    distillation,
    distillation_beside,
    generator_belief,
    informed_sac,
    model_free_ddpg,
    ppo_on_own_steps,
    read_off,
    reward_gradient,
    sac_in_imagination,
    sac_on_real_data,
    static_belief,
    task_reward,
    variance_reward,
)
from jaxplore.signals import TASK, Reward, RNDConfig, make_belief_signal, make_distillation
from jaxplore.signals.distillation import update_scale
from jaxplore.types import Transition
from tests.jaxplore import distillation as by_hand

OBS, ACTION, NUM, BATCH = 2, 1, 12, 16
MODELS = np.array([1.0, 3.0], np.float32)
RND = RNDConfig(hidden=(8,), features=4, lr=1e-2)
BELIEF = make_no_belief()._replace(
    predict=lambda models, inputs: Prediction(models[:, None, None] * inputs[None, :, :OBS])
)
"""Two models, which predict once and three times the normalised observation: their mean is 2 obs, their variance obs^2
summed over entries."""
VARIANCE = Reward(lambda prediction, *_: rewards.variance(prediction), "squared")
ERROR = Reward(lambda prediction, delta, _: rewards.prediction_error(prediction, delta), "squared")
DISTILLED = make_distillation(OBS, NUM, RND, BELIEF)


def recorder():
    """A learner that keeps its last batch."""
    rows, flag = jnp.zeros((BATCH, OBS)), jnp.zeros(BATCH, bool)
    empty = Transition(rows, jnp.zeros((BATCH, ACTION)), jnp.zeros(BATCH), rows, flag, flag)
    return Learner(
        init=lambda key: empty,
        actor=lambda state: (),
        act=lambda key, actor, obs: jnp.tanh(obs[..., :ACTION]),
        act_greedily=lambda actor, obs: obs[..., :ACTION],
        update=lambda key, state, batch: (batch, {"one": jnp.ones(())}),
        batch_size=BATCH,
    )


@pytest.fixture(scope="module")
def experience():
    """Of `NUM` transitions, the environment's reward of each its number; and what distillation carries after them."""
    rng = np.random.default_rng(0)
    obs = np.asarray(rng.normal(size=(NUM, OBS)) * [1, 3] + 2, np.float32)
    moved, flag = np.asarray(obs + rng.normal(size=obs.shape), np.float32), np.zeros(NUM, bool)
    rows = Transition(obs, np.tanh(obs[:, :ACTION]), np.arange(NUM, dtype=np.float32), moved, flag, flag)

    @jax.jit
    def made(key, rows):
        data = replay.add(replay.init(jax.tree.map(lambda leaf: leaf[0], rows), 20), rows)
        normalizers = dynamics.update_normalizers(dynamics.init_normalizers(OBS, ACTION), rows, jnp.ones(NUM, bool))
        own = dataclasses.replace(DISTILLED.init(key), position=jnp.int32(0))
        own, metrics = DISTILLED.fit(own, data, normalizers)
        return Experience(jnp.asarray(MODELS), data, jnp.int32(NUM), normalizers, rows.obs[0], own), metrics

    return made(jax.random.key(0), rows)


def normal(experience, obs):
    stats = experience.normalizers.obs
    return (np.asarray(obs) - np.asarray(stats.mean)) / np.asarray(stats.std)


def worth(name, experience, obs, delta, next_obs):
    """By hand: of normalised observations, normalised changes and normalised successors."""
    if name == "variance":
        return np.sum(obs**2, axis=-1)
    if name == "error":
        return np.sum((2 * obs - delta) ** 2, axis=-1)
    own = jax.device_get(experience.own)
    return by_hand.error(own.rnd, next_obs) / float(own.scale.std)


SIGNALS = {
    "variance": make_belief_signal(BELIEF, VARIANCE),
    "error": make_belief_signal(BELIEF, ERROR),
    "distillation": DISTILLED,
}


@pytest.mark.parametrize("name", [*SIGNALS, "task"])
@pytest.mark.parametrize("lasting", [False, True])
def test_one_loop_gives_real_transitions_the_reward_of_any_signal(name, lasting, experience):
    # by hand, of each row of the last batch; the task's is the row's number, as the environment gave it
    experience, _ = experience
    signal = SIGNALS.get(name, TASK)
    behaviour = make_reactive(signal, recorder(), OBS, ACTION, ReactiveConfig(updates=2), lasting=lasting)
    state, _ = jax.jit(lambda key: behaviour.improve(key, behaviour.init(key), experience))(jax.random.key(1))
    batch, rows = jax.device_get((state if lasting else state.learner, experience.data.rows))
    obs = normal(experience, rows.obs[:NUM])
    index = [int(np.argmin(np.sum((obs - one) ** 2, axis=1))) for one in batch.obs]
    np.testing.assert_allclose(batch.obs, obs[index], atol=1e-5)
    assert len(set(index)) > 4
    stats, delta = experience.normalizers.delta, rows.next_obs[:NUM] - rows.obs[:NUM]
    delta = (delta - np.asarray(stats.mean)) / np.asarray(stats.std)
    want = (
        np.arange(NUM)
        if name == "task"
        else worth(name, experience, obs, delta, normal(experience, rows.next_obs[:NUM]))
    )
    np.testing.assert_allclose(batch.reward, want[index], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", SIGNALS)
def test_imagined_transitions_get_the_reward_of_any_signal(name, experience):
    # each row of the buffer, which keeps the signal's own unit, from its observation, its change and where it led
    experience, _ = experience
    config = ImaginationConfig(
        num_actors=4,
        horizon=3,
        num_rollouts=2,
        num_random_rollouts=1,
        updates_per_rollout=1,
        real_updates=0,
        real_fraction=0.0,
        replay_capacity=64,
    )
    behaviour = make_imagination(SIGNALS[name], recorder(), OBS, ACTION, config)
    state, _ = jax.jit(lambda key: behaviour.improve(key, behaviour.init(key), experience))(jax.random.key(1))
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[: 2 * 4 * 3], state.imagined.rows)
    stats = experience.normalizers.delta
    delta = (rows.next_obs - rows.obs - np.asarray(stats.mean)) / np.asarray(stats.std)
    obs, next_obs = (np.clip(normal(experience, x), -10, 10) for x in (rows.obs, rows.next_obs))
    want = worth(name, experience, obs, delta, next_obs)
    scale = float(experience.own.scale.std) if name == "distillation" else 1.0
    np.testing.assert_allclose(rows.reward, want * scale, rtol=2e-3, atol=1e-3)
    assert np.ptp(rows.reward) > 0
    # What the learner is shown is in units of the spread of bonuses in time.
    shown = np.asarray(state.learner.reward)
    gaps = np.min(np.abs(shown[:, None] - (rows.reward / scale)[None]), axis=1)
    np.testing.assert_allclose(gaps, 0.0, atol=1e-5 * np.max(np.abs(shown)))


def test_distillation_learns_what_a_round_brought(experience):
    # four steps on all rows: the error falls from what it was, whose discounted sums have the spread that is carried
    experience, metrics = experience
    rows = jax.device_get(experience.data.rows)
    first = jax.device_get(jax.jit(DISTILLED.init)(jax.random.key(0)))
    seen = normal(experience, rows.next_obs[:NUM])
    before, after = (by_hand.error(state.rnd, seen) for state in (first, jax.device_get(experience.own)))
    scale = update_scale(first.scale, jnp.asarray(before), jnp.ones(NUM, bool), RND.discount)
    np.testing.assert_allclose(experience.own.scale.std, scale.std, rtol=1e-4)
    assert np.mean(after) < float(metrics["rnd_error"]) < np.mean(before)


SMALL = ExplorationConfig(
    steps_per_round=NUM,
    data_capacity=50,
    dynamics=DynamicsConfig(hidden=(4,)),
    fit=FitConfig(batch_size=4, epochs=0, steps=2),
    imagination=ImaginationConfig(num_actors=3, horizon=2, num_rollouts=2),
    sac=SACConfig(hidden=(4,), batch_size=4),
    gradient=GradientPolicyConfig(hidden=(4,), batch_size=4, horizon=2),
    rnd=RND,
)
IMAGINED = (read_off(generator_belief, variance_reward), distillation_beside(static_belief))
REAL = (*IMAGINED, distillation, task_reward)


@pytest.mark.parametrize(
    ("signal", "behaviour"),
    [
        *((signal, behaviour) for signal in IMAGINED for behaviour in (sac_in_imagination, reward_gradient)),
        *((signal, behaviour) for signal in REAL for behaviour in (sac_on_real_data, model_free_ddpg)),
        *((signal, ppo_on_own_steps) for signal in (distillation, distillation_beside(static_belief))),
    ],
)
def test_any_two_that_fit_make_a_row(signal, behaviour):
    # as shapes only: a round keeps those of the state, and the signal is reported wherever it has a unit
    explorer = make_explorer(Method("mine", signal, behaviour), Sizes(OBS, ACTION), SMALL)
    obs, flags = jnp.zeros((NUM, OBS)), jnp.zeros(NUM, bool)
    rows = Transition(obs, jnp.zeros((NUM, ACTION)), jnp.zeros(NUM), obs, flags, flags)

    def one_round(key):
        first = explorer.init(key)
        state, _ = explorer.improve(key, explorer.observe(first, rows, ~flags), obs[0], jnp.int32(NUM))
        return first, state, explorer.assess(key, state, rows, ~flags)

    first, state, told = jax.eval_shape(one_round, jax.random.key(0))
    shapes = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), one) for one in (first, state)]
    assert shapes[0] == shapes[1]
    assert ("intrinsic_reward" in told) == (explorer.reward_unit is not None) == (signal is not task_reward)


@pytest.mark.parametrize(
    "behaviour", [sac_in_imagination, reward_gradient, informed_sac, METHODS["implicit"].behaviour]
)
def test_what_cannot_be_imagined_is_refused_by_what_imagines(behaviour):
    # why, and what fits
    fits = r"\. Allowed: a signal with a belief that predicts, or a behaviour on real transitions\."
    for signal, why in (
        (task_reward, r"cannot be imagined: it is the environment's own reward, which only real transitions have"),
        (distillation, "belief predicts nothing, so the signal cannot be imagined"),
    ):
        with pytest.raises(ValueError, match=why + fits):
            make_explorer(Method("mine", signal, behaviour), Sizes(OBS, ACTION), SMALL)


@pytest.mark.parametrize(
    ("normalize_obs", "reward", "worth"), [(True, VARIANCE, 1.0), (False, VARIANCE, 1.0), (True, ERROR, 0.0)]
)
def test_an_informed_learner_has_the_tasks_reward_and_what_the_signal_says_of_any_action(
    experience, normalize_obs, reward, worth
):
    # rewards are the environment's, the transitions' numbers; the gain of actions that nobody took, as the round's
    # models have it, is the variance |normalised obs|^2, and an error is none where they are right on average
    experience, _ = experience

    def make(gain):
        def update(key, state, batch):
            action = jnp.tanh(jax.random.normal(key, batch.action.shape))
            return (batch, gain(batch.obs, action)), {"one": jnp.ones(())}

        first = recorder()
        return first._replace(init=lambda key: (first.init(key), jnp.zeros(BATCH)), update=update)

    config = ModelFreeConfig(updates_per_round=2, normalize_obs=normalize_obs)
    behaviour = make_informed(make_belief_signal(BELIEF, reward), make, OBS, ACTION, config)
    state = behaviour.init(jax.random.key(0))
    (batch, gained), _ = jax.jit(behaviour.improve)(jax.random.key(1), state, experience)
    rows, stats = jax.device_get((experience.data.rows, experience.normalizers.obs))
    place = np.asarray(batch.reward, int)
    normalised = (rows.obs[place] - stats.mean) / np.asarray(stats.std)
    np.testing.assert_allclose(batch.obs, normalised if normalize_obs else rows.obs[place], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(gained, worth * np.sum(normalised**2, axis=1), rtol=1e-4, atol=1e-5)
    assert len(set(place)) > 4


def test_the_information_of_probabilities_is_refused():
    config = dataclasses.replace(SMALL, dynamics=DynamicsConfig(hidden=(8,), target="one_hot"))
    sizes = Sizes(OBS, ACTION, one_hot_obs=True, has_reward=True)
    with pytest.raises(ValueError, match=r"DynamicsConfig\.target='one_hot' is probabilities.*Allowed: 'delta'"):
        make_explorer(METHODS["maxinfo"], sizes, config)


def test_other_pairs_that_do_not_fit_are_refused():
    # PPO takes over how a signal learns; and nothing is read off a belief that says nothing
    with pytest.raises(ValueError, match=r"does not learn in steps.*Allowed: distillation \(make_distillation\), or"):
        make_explorer(Method("mine", IMAGINED[0], ppo_on_own_steps), Sizes(OBS, ACTION), SMALL)
    with pytest.raises(ValueError, match=r"belief predicts nothing, so no reward can be read off it\. Allowed: "):
        make_belief_signal(make_no_belief(), VARIANCE)


def test_the_gradient_climbs_any_signal(experience):
    # that of where a step leads, too: 100 steps raise the error of the predictor that is met
    experience, _ = experience

    def pushed(models, inputs):
        return Prediction(models[:, None, None] * jnp.repeat(inputs[None, :, OBS:], OBS, axis=-1))

    signal = DISTILLED._replace(belief=BELIEF._replace(predict=pushed))
    config = GradientPolicyConfig(hidden=(8,), batch_size=32, updates=1, lr=1e-2, restart=False, policy_penalty=0.0)

    @jax.jit
    def returns(key):
        def told(updates):
            behaviour = make_gradient_policy(signal, OBS, ACTION, dataclasses.replace(config, updates=updates))
            return behaviour.improve(key, behaviour.init(key), experience)[1]["imagined_return"]

        return told(1), told(100)

    first, last = returns(jax.random.key(2))
    assert float(last) > 1.1 * float(first)
