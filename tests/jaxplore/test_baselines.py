"""The methods that the paper compares with: what each is put together from, and policies that imagine nothing."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, replay, rewards
from jaxplore.behaviours import Experience, ImaginationConfig, ReactiveConfig, make_reactive
from jaxplore.behaviours.base import LABEL_CHUNK, label
from jaxplore.beliefs import Belief, EnsembleConfig
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import DynamicsConfig, Prediction
from jaxplore.exploration import make_explorer
from jaxplore.learners.base import Learner
from jaxplore.learners.sac import SACConfig
from jaxplore.methods import METHODS
from jaxplore.signals import Reward, Seen, make_belief_signal
from jaxplore.types import Transition

O, A, M = 3, 2, 4  # noqa: E741
SIZES, CHAIN = Sizes(O, A), Sizes(6, 2, discrete=True, one_hot_obs=True)
TINY = ImaginationConfig(
    num_actors=4,
    horizon=3,
    num_rollouts=3,
    num_random_rollouts=1,
    updates_per_rollout=2,
    real_updates=1,
    replay_capacity=64,
)
SMALL = ExplorationConfig(
    data_capacity=64,
    dynamics=DynamicsConfig(hidden=(8,)),
    ensemble=EnsembleConfig(num_members=M),
    imagination=TINY,
    reactive=ReactiveConfig(updates=5),
    sac=SACConfig(hidden=(8,), batch_size=8),
)


def real_data(num, capacity=64):
    """`Experience` of `num` random transitions, its models the numbers 0, 1, 2, 3."""
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(num, O)) + 1
    rows = (obs, rng.uniform(-1, 1, (num, A)), np.full(num, 7.0), obs + rng.normal(size=(num, O)))
    flag = np.zeros(num, bool)
    return experience_of(Transition(*(np.asarray(x, np.float32) for x in rows), flag, flag), capacity)


@functools.partial(jax.jit, static_argnums=1)
def experience_of(rows, capacity):
    num = rows.obs.shape[0]
    data = replay.add(replay.init(jax.tree.map(lambda leaf: leaf[0], rows), capacity), rows)
    normalizers = dynamics.update_normalizers(dynamics.init_normalizers(O, A), rows, jnp.ones(num, bool))
    return Experience(jnp.arange(float(M)), data, jnp.int32(num), normalizers, rows.obs[0])


BELIEF = Belief(
    init=lambda key: (),
    update=lambda key, state, data, normalizers: (state, {}),
    sample=lambda key, state, num: jnp.arange(float(num)),
    predict=lambda models, inputs: Prediction(models[:, None, None] * inputs[None, :, :O]),
)
"""Models that predict 0, 1, 2 and 3 times the normalised observation: variance 1.25 |obs|^2."""


def recorder(batch_size):
    """A learner that keeps its last batch and counts its updates."""
    flag = jnp.zeros(batch_size, bool)
    rows = [jnp.zeros((batch_size, size)) for size in (O, A)]
    empty = Transition(rows[0], rows[1], jnp.zeros(batch_size), rows[0], flag, flag)
    return Learner(
        init=lambda key: {"updates": jnp.zeros((), jnp.int32), "batch": empty},
        actor=lambda state: state["updates"],
        act=lambda key, actor, obs: 5.0 + obs[..., :A],
        act_greedily=lambda actor, obs: obs[..., :A],
        update=lambda key, state, batch: ({"updates": state["updates"] + 1, "batch": batch}, {"one": jnp.ones(())}),
        batch_size=batch_size,
    )


def read_off_belief(score):
    return make_belief_signal(BELIEF, Reward(score, "its own"))


VARIANCE = read_off_belief(lambda prediction, delta, normalizers: rewards.variance(prediction))


@pytest.mark.parametrize(("num_updates", "restart_every", "lives"), [(5, 1, [5, 5, 5]), (7, 2, [7, 14, 7])])
def test_a_reactive_policy_sees_real_transitions_alone(num_updates, restart_every, lives):
    # every row of a batch is one of the 20 real ones, normalised, with its reward by today's models in place of the
    # environment's 7; as many updates as the settings say, from a new policy each round or every second one
    config = ReactiveConfig(updates=num_updates, restart_every=restart_every)
    behaviour = make_reactive(VARIANCE, recorder(16), O, A, config)
    experience = real_data(20)
    state, improve = jax.jit(behaviour.init)(jax.random.key(0)), jax.jit(behaviour.improve)
    for number, life in enumerate(lives):
        scale = 1.0 + number
        state, metrics = improve(
            jax.random.key(number), state, experience._replace(models=scale * np.arange(M, dtype=np.float32))
        )
        assert int(state.learner["updates"]) == life and set(metrics) == {"one"}
        batch, rows, stats = jax.device_get((state.learner["batch"], experience.data.rows, experience.normalizers.obs))
        real = (rows.obs[:20] - stats.mean) / np.asarray(stats.std)
        gaps = np.max(np.abs(batch.obs[:, None] - real[None]), axis=-1)
        assert np.max(np.min(gaps, axis=1)) < 1e-5
        chosen = np.argmin(gaps, axis=1)
        np.testing.assert_allclose(batch.action, rows.action[chosen], rtol=1e-6)
        np.testing.assert_allclose(batch.reward, 1.25 * scale**2 * np.sum(real[chosen] ** 2, axis=1), rtol=1e-4)
        assert len(set(chosen)) > 8
    # and it carries no room for anything imagined
    assert all(leaf.shape[:1] in ((), (16,)) for leaf in jax.tree.leaves(state))
    act = jax.jit(behaviour.act)
    action = act(jax.random.key(0), behaviour.actor(state), experience.normalizers, rows.obs[3])
    np.testing.assert_allclose(action, real[3, :A], rtol=1e-4)


@jax.jit
def labelled_by_spread(experience):
    spread = read_off_belief(lambda prediction, delta, normalizers: rewards.trajectory_spread(delta))
    return label(spread, experience).rows.reward


@pytest.mark.parametrize("num", [20, LABEL_CHUNK + 10])
def test_rewards_that_compare_rows_see_held_rows_only(num):
    # room for 1,500 transitions, mostly empty: the spread is of chunks of real changes, about 1 an entry in normalised
    # units, where empty rows (a change of 0) would pull it down; rows that are not held have no reward
    got = np.asarray(labelled_by_spread(real_data(num, capacity=1_500)))
    np.testing.assert_allclose(got[:num], O, rtol=0.05)
    np.testing.assert_array_equal(got[num:], 0.0)


def test_settings_are_those_of_maxs_commands():
    # nnaisense/max's README: swish for all; MAX and JDRX alpha 0.02, TVAX and PERX 0.2; JDRX and PERX 100 reactive
    # updates. On the chain its networks are the others' (tanh there). Methods of the paper's own share every setting,
    # and those on real data make as many updates as are made in imagination: 100 + (50 - 3) x 50
    default = ExplorationConfig()
    for name, alpha, updates in (
        ("max", 0.02, 2450),
        ("max_reactive", 0.02, 100),
        ("max_trajectory", 0.2, 2450),
        ("prediction_error", 0.2, 100),
    ):
        config = METHODS[name].settings(default)
        assert (config.dynamics.activation, config.sac.alpha, config.reactive.updates) == ("swish", alpha, updates)
        assert config.renyi_decay == 0.1 and config.fit == default.fit
        if name != "max_trajectory":
            assert config.imagination == default.imagination
    imagined = default.imagination
    trained = imagined.num_rollouts - imagined.num_random_rollouts
    assert imagined.real_updates + trained * imagined.updates_per_rollout == default.reactive.updates == 2450
    for name in ("implicit", "disagreement", "icm", "random"):
        assert METHODS[name].settings(default) == default
    # what is of imagination by name has no real transitions in its batches, and the spread of what is imagined in a
    # step says nothing of a real one
    alone = dataclasses.replace(imagined, real_fraction=0.0)
    for name in ("icm_active", "rnd_active"):
        assert METHODS[name].settings(default) == dataclasses.replace(default, imagination=alone)
    spread = METHODS["max_trajectory"].settings(default).imagination
    assert spread == dataclasses.replace(alone, real_updates=0)
    chain = ExplorationConfig(dynamics=DynamicsConfig(activation="tanh", target="one_hot"))
    assert METHODS["max"].settings(chain) == chain


def test_settings_are_those_of_maxinforls_code():
    # five networks of 2 x 256 with swish, a step of 3e-4 on 256 transitions for each of SAC's updates, both of whose
    # weights start at 1 and are learned; the generator's own form is the shared one
    default = ExplorationConfig()
    config = METHODS["maxinfo"].settings(default)
    assert (config.dynamics.hidden, config.dynamics.activation) == ((256, 256), "swish")
    assert config.ensemble.num_members == 5
    fit = config.fit
    assert (fit.lr, fit.weight_decay, fit.batch_size, fit.clip_value, fit.clip_norm) == (3e-4, 0.0, 256, 0.0, 0.0)
    assert (config.information.weight, config.information.learn_weight, config.information.noise_std) == (1, True, 1e-3)
    implicit = METHODS["maxinfo_implicit"].settings(default)
    for name in ("dynamics", "generator", "svgd"):
        assert getattr(implicit, name) == getattr(default, name)
    for one in (config, implicit):
        assert (one.fit.epochs, one.fit.steps, one.fit.restart) == (0, one.model_free.updates_per_round, False)
        assert one.task_sac == METHODS["sac_v2"].settings(default).task_sac
        assert (one.task_sac.alpha, one.task_sac.learn_alpha, one.task_sac.lr) == (1.0, True, 3e-4)


def test_rewards_of_the_table():
    # each row's reward of the same prediction, against the function that it stands for, in the units of the settings
    means = np.random.default_rng(0).normal(size=(M, 5, O)).astype(np.float32)
    delta = np.random.default_rng(1).normal(size=(5, O)).astype(np.float32)

    def pairs(means, delta, stats):
        prediction, chances = Prediction(means, jnp.full(means.shape, 0.1)), Prediction(jax.nn.softmax(means))

        def given(name, prediction=prediction, **settings):
            signal = METHODS[name].signal(SIZES, ExplorationConfig(**settings))
            return signal.score((), Seen(None, prediction, delta, stats))

        one_hot = DynamicsConfig(target="one_hot")
        exact = {
            "disagreement": (given("disagreement"), rewards.variance(prediction)),
            "max_trajectory": (given("max_trajectory"), rewards.trajectory_spread(delta)),
            "max on the chain": (
                given("max", prediction=chances, dynamics=one_hot),
                rewards.jensen_shannon(chances),
            ),
        }
        for name in ("max", "max_reactive"):
            for decay in (0.1, 1.0):
                settings = {} if decay == 0.1 else {"renyi_decay": decay}
                exact[f"{name} {decay}"] = given(name, **settings), rewards.jensen_renyi(prediction, decay)
        errors = ("prediction_error", "icm", "icm_active")
        for name in errors:
            exact[name] = given(name, error_units="delta"), rewards.prediction_error(prediction, delta)
        return exact, [given(name) for name in errors]

    stats = real_data(20).normalizers
    exact, errors = jax.jit(pairs)(means, delta, stats)
    for name, (got, want) in exact.items():
        np.testing.assert_array_equal(got, want, err_msg=name)
    error = (means.mean(axis=0) - delta) * np.asarray(stats.delta.std) / np.asarray(stats.obs.std)
    for got in errors:
        np.testing.assert_allclose(got, np.sum(error**2, axis=1), rtol=1e-4)


@pytest.mark.parametrize("name", ["disagreement", "max", "max_reactive", "max_trajectory", "prediction_error"])
def test_static_beliefs_have_as_many_networks_as_the_settings_say(name):
    # Gaussian ones for nnaisense/max's methods, deterministic ones for the others and on the chain
    method = METHODS[name]
    belief = method.signal(SIZES, method.settings(SMALL)).belief
    models = jax.eval_shape(lambda key: belief.sample(key, belief.init(key), M), jax.random.key(0))
    assert models["output"]["kernel"].shape == (M, 8, O if name == "disagreement" else 2 * O)
    chain = dataclasses.replace(SMALL, dynamics=DynamicsConfig(hidden=(8,), target="one_hot"))
    belief = method.signal(CHAIN, chain).belief
    models = jax.eval_shape(lambda key: belief.sample(key, belief.init(key), M), jax.random.key(0))
    assert models["output"]["kernel"].shape == (M, 8, CHAIN.obs)


@pytest.mark.parametrize("name", ["max_trajectory", "icm_active", "rnd_active"])
def test_what_needs_actions_that_are_numbers_is_refused_on_the_chain(name):
    # what it needs, what there is, and the methods that fit
    chain = dataclasses.replace(SMALL, planner="mcts", dynamics=DynamicsConfig(hidden=(8,), target="one_hot"))
    message = rf"method='{name}' takes actions that are numbers.*one of 2 choices.*methods implicit, .*icm, "
    with pytest.raises(ValueError, match=message):
        make_explorer(METHODS[name], CHAIN, chain)


@pytest.mark.parametrize("name", ["max", "icm"])
def test_a_round_of_a_baseline(name):
    # one active, one reactive: models are fitted, the policy moves, and what is reported of new transitions has every
    # method's measure beside its own
    method = METHODS[name]
    config = dataclasses.replace(SMALL, imagination=dataclasses.replace(TINY, real_updates=0))
    explorer = make_explorer(method, SIZES, method.settings(config))
    experience, key = real_data(20), jax.random.key(0)
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[:20], experience.data.rows)
    state = jax.jit(lambda key, rows: explorer.observe(explorer.init(key), rows, jnp.ones(20, bool)))(key, rows)
    after, metrics = jax.jit(explorer.improve)(key, state, experience.obs, np.int32(20))
    assert ("policy/imagined_reward" in metrics) == (name == "max")
    for part in ("belief", "behaviour"):
        pairs = zip(jax.tree.leaves(getattr(state, part)), jax.tree.leaves(getattr(after, part)), strict=True)
        assert any(np.any(np.asarray(a) != np.asarray(b)) for a, b in pairs)
    new = jax.tree.map(lambda leaf: leaf[:9], rows)
    reported = jax.jit(explorer.assess)(key, after, new, np.arange(9) != 2)
    assert {"variance", "divergence", "model_error", "intrinsic_reward_p95"} <= reported.keys()
    assert (float(reported["divergence"]) == pytest.approx(float(reported["intrinsic_reward"]))) == (name == "max")
