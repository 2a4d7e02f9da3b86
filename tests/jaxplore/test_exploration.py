"""Algorithm 1 composed: with a belief and a learner whose every number is known, and with the real ones, small."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import replay, rewards
from jaxplore.behaviours import Experience, ImaginationConfig, make_imagination, uniform_actions
from jaxplore.behaviours.base import AS_THEY_ARE, lesson_of, reward_moments, train
from jaxplore.behaviours.imagination import starts
from jaxplore.beliefs import Belief, FitConfig
from jaxplore.beliefs.generator import GeneratorConfig
from jaxplore.beliefs.svgd import SVGDConfig
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import DynamicsConfig, Prediction
from jaxplore.exploration import make_explorer
from jaxplore.learners import Learner, SACConfig
from jaxplore.methods import METHODS, Method, get_method
from jaxplore.parts import read_off
from jaxplore.signals import Reward
from jaxplore.types import Transition

SIZES = Sizes(obs=3, action=2)
NUM_MODELS = 4
SPREAD = 1.25
"""Population variance of 0, 1, 2, 3."""


# A belief that counts its updates: after n of them its four models predict k n [obs], k = 0..3, plus a number drawn
# with the models. So the variance reward is 1.25 n^2 |obs|^2 (normalised obs) and tells which fit it was read off.


def counting_belief(sizes, config):
    def predict(models, inputs):
        means = models["scale"][:, None, None] * inputs[None, :, : sizes.obs] + models["tag"][:, None, None]
        return Prediction(means)

    def sample(key, state, num):
        tag = jnp.full(num, jax.random.normal(key, ()))
        return {"scale": state.astype(jnp.float32) * jnp.arange(num), "tag": tag}

    def update(key, state, data, normalizers):
        return state + 1, {"updates": state + 1}

    return Belief(
        init=lambda key: jnp.zeros((), jnp.int32),
        update=update,
        sample=sample,
        predict=predict,
        num_models=NUM_MODELS,
        fit_config=config.fit,
    )


def variance_and_change(config):
    """Equation 1, plus 100 times the first entry of the change that happened."""
    return Reward(lambda prediction, delta, normalizers: rewards.variance(prediction) + 100 * delta[:, 0], "its own")


def tagged(config):
    """A number that all models of one draw share."""
    return Reward(lambda prediction, delta, normalizers: prediction.mean[0, :, 0], "its own")


def recording_learner(sizes, batch_size):
    """It keeps its last batch, counts its updates, acts with 5 + tanh of the obs it sees and greedily with that obs."""
    rows = lambda *shape: jnp.zeros((batch_size, *shape))  # noqa: E731
    flag = jnp.zeros(batch_size, bool)
    empty = Transition(rows(sizes.obs), rows(sizes.action), rows(), rows(sizes.obs), flag, flag)
    return Learner(
        init=lambda key: {"updates": jnp.zeros((), jnp.int32), "batch": empty},
        actor=lambda state: state["updates"],
        act=lambda key, actor, obs: 5.0 + jnp.tanh(obs[..., : sizes.action]),
        act_greedily=lambda actor, obs: obs[..., : sizes.action],
        update=lambda key, state, batch: ({"updates": state["updates"] + 1, "batch": batch}, {"one": jnp.ones(())}),
        batch_size=batch_size,
    )


def recording(sizes, config, signal):
    learner = recording_learner(sizes, config.sac.batch_size)
    return make_imagination(signal, learner, sizes.obs, sizes.action, config.imagination)


def make_fake(reward=variance_and_change, fit=None, capacity=64, batch_size=16, belief=counting_belief, **imagination):
    """An explorer of the fakes above; 3 fit steps and one imagined rollout of 4 actors x 2 steps by default."""
    settings = {
        "num_actors": 4,
        "horizon": 2,
        "num_rollouts": 1,
        "num_random_rollouts": 0,
        "updates_per_rollout": 2,
        "real_updates": 0,
        "real_fraction": 0.0,
        "replay_capacity": 256,
    }
    config = ExplorationConfig(
        data_capacity=capacity,
        fit=fit or FitConfig(epochs=0, steps=3, restart=True),
        imagination=ImaginationConfig(**{**settings, **imagination}),
        sac=SACConfig(batch_size=batch_size),
    )
    return make_explorer(Method("counts", read_off(belief, reward), recording), SIZES, config)


def jitted(explorer):
    """With its functions compiled."""
    names = ("init", "observe", "improve", "assess")
    return explorer._replace(**{name: jax.jit(getattr(explorer, name)) for name in names})


@functools.cache
def fake_explorer(**settings):
    """The same for all tests that name the same settings: its programs are compiled once."""
    return jitted(make_fake(**settings))


GOING_ON = {
    "fit": FitConfig(epochs=0, steps=3, restart=False),
    "restart_every": 0,
    "keep_imagined": True,
    "num_rollouts": 2,
    "normalize_reward": True,
}
"""Neither the belief nor the policy starts again, and rewards are divided by their standard deviation."""

RANDOM_AND_REAL = {
    "restart_every": 2,
    "keep_imagined": True,
    "num_actors": 64,
    "horizon": 3,
    "num_rollouts": 3,
    "num_random_rollouts": 2,
    "real_updates": 3,
    "replay_capacity": 2000,
}
"""A policy lives for two rounds, in each of which it has updates on real data and one rollout of its own."""

TAGGED = {
    "reward": tagged,
    "fit": FitConfig(epochs=0, steps=1, restart=True),
    "num_rollouts": 3,
    "real_updates": 1,
    "real_fraction": 0.25,
}
"""The reward tells which draw of models it was read off; a quarter of each batch is real."""


def transitions(num, seed=0, terminated=False):
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(num, SIZES.obs)) * [1.0, 2.0, 3.0] + 1
    action = rng.uniform(-1, 1, size=(num, SIZES.action))
    rows = [jnp.asarray(x, jnp.float32) for x in (obs, action, np.zeros(num), obs + 0.5 * rng.normal(size=obs.shape))]
    return Transition(*rows, jnp.asarray(np.full(num, terminated)), jnp.asarray(np.zeros(num, bool)))


def begin(explorer, num=20, seed=0, **kwargs):
    return explorer.observe(explorer.init(jax.random.key(seed)), transitions(num, **kwargs), np.ones(num, bool))


def normal(state, rows):
    """`(normalised obs, normalised change)` of rows in raw units, by NumPy from the explorer's statistics; the first as
    models see it, within 10."""
    scale = lambda stats, x: (np.asarray(x) - np.asarray(stats.mean)) / np.asarray(stats.std)  # noqa: E731
    stats = state.normalizers
    return np.clip(scale(stats.obs, rows.obs), -10, 10), scale(
        stats.delta, np.asarray(rows.next_obs) - np.asarray(rows.obs)
    )


def held(buffer):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: int(buffer.size)], buffer.rows)


OBS = jnp.array([0.3, -0.4, 2.0])


def test_observe_takes_in_valid_rows_only():
    # NumPy statistics of the rows with `valid`, and those rows alone in the buffer
    rows, valid = transitions(12), np.arange(12) % 4 != 0
    explorer = fake_explorer()
    state = explorer.observe(explorer.init(jax.random.key(0)), rows, jnp.asarray(valid))
    np.testing.assert_array_equal(held(state.data).obs, np.asarray(rows.obs)[valid])
    np.testing.assert_allclose(state.normalizers.obs.mean, np.asarray(rows.obs)[valid].mean(axis=0), rtol=1e-5)
    delta = np.asarray(rows.next_obs - rows.obs)[valid]
    np.testing.assert_allclose(state.normalizers.delta.std, delta.std(axis=0), rtol=1e-4)
    np.testing.assert_allclose(state.normalizers.action.std, np.asarray(rows.action)[valid].std(axis=0), rtol=1e-4)


@pytest.mark.parametrize(("settings", "restart"), [({}, True), (GOING_ON, False)], ids=["restart", "going on"])
def test_imagined_rewards_come_from_the_models_fitted_in_this_round(settings, restart):
    # Algorithm 1: fit, then sample, then imagine. 3 updates a round: the reward is 1.25 n^2 |obs|^2 + 100 delta_0 with
    # n = 3 each round after a restart, and n = 3, 6, 9 without; of the last rollout, 8 transitions, the metrics tell
    explorer = fake_explorer(**settings)
    state = begin(explorer)
    for number in (1, 2, 3):
        state, metrics = explorer.improve(jax.random.key(number), state, OBS, 20)
        n = 3 if restart else 3 * number
        rows = held(state.behaviour.imagined)
        assert len(rows.reward) == (8 if restart else 16 * number)
        rows = jax.tree.map(lambda leaf: leaf[-8:], rows)
        obs, delta = normal(state, rows)
        want = SPREAD * n**2 * np.sum(obs**2, axis=1) + 100 * delta[:, 0]
        np.testing.assert_allclose(rows.reward, want, rtol=1e-3, atol=1e-2)
        assert int(state.belief) == n == int(metrics["fit/updates"])
        assert float(metrics["policy/imagined_reward"]) == pytest.approx(np.mean(rows.reward), rel=1e-4)
        p95 = np.percentile(rows.reward, 95)
        assert float(metrics["policy/imagined_reward_p95"]) == pytest.approx(p95, rel=1e-4)


def test_one_draw_of_models_serves_the_whole_round():
    # the tag of a draw is the same in all rollouts of a round, and on the real data; another round has another
    explorer = fake_explorer(**TAGGED)
    state, tags = begin(explorer, terminated=True), []
    for number in (1, 2):
        state, _ = explorer.improve(jax.random.key(number), state, OBS, 20)
        # Model 0 predicts 0 obs + tag.
        imagined, batch = held(state.behaviour.imagined).reward, state.behaviour.learner["batch"]
        np.testing.assert_allclose(imagined, imagined[0], rtol=1e-6)
        assert len(imagined) == 24
        assert np.any(batch.terminated)  # Some of its rows are real.
        np.testing.assert_allclose(batch.reward, imagined[0], rtol=1e-6)
        tags.append(imagined[0])
    assert tags[0] != tags[1]


@functools.cache
def updates_of_a_fit(fit):
    """`(explorer, program)`: the number of updates that `improve` gives the belief. Nothing else is compiled."""
    explorer = make_fake(fit=fit)
    return jitted(explorer), jax.jit(lambda *args: explorer.improve(*args)[0].belief)


@pytest.mark.parametrize(
    ("num_data", "epochs", "want"), [(5, 2, 2), (39, 2, 2), (40, 2, 4), (119, 2, 10), (119, 0, 7), (400, 3, 60)]
)
def test_epochs_set_the_length_of_a_fit(num_data, epochs, want):
    # epochs * max(1, N // 20) steps, or `steps` where epochs is 0; N is the number given, so the program is one
    fit = FitConfig(epochs=epochs, steps=7, batch_size=20, restart=True)
    assert int(fit.num_steps(jnp.asarray(num_data))) == want
    explorer, updates = updates_of_a_fit(fit)
    assert int(updates(jax.random.key(0), begin(explorer), OBS, num_data)) == want


@pytest.mark.parametrize(
    ("settings", "updates", "rows", "lives"),
    [
        ({}, 2, 8, [1, 1, 1, 1, 1]),
        (GOING_ON, 2 * 2, 2 * 8, [1, 2, 3, 4, 5]),
        (RANDOM_AND_REAL, 3 + 2, 3 * 192, [1, 2, 1, 2, 1]),
    ],
    ids=["every round", "never", "every second round"],
)
def test_restart_resets_the_policy_and_its_imagined_data(settings, updates, rows, lives):
    # a life of k rounds has had k times a round's updates and holds the transitions of k times its rollouts (of three
    # rollouts two are random, and train nothing)
    explorer = fake_explorer(**settings)
    state = begin(explorer)
    for number, k in enumerate(lives):
        state, _ = explorer.improve(jax.random.key(number), state, OBS, 20)
        assert int(state.behaviour.learner["updates"]) == k * updates
        assert int(state.behaviour.imagined.size) == k * rows


def test_what_was_imagined_goes_with_its_round():
    # unless it is to stay: the policy lives on, and what it learns from was said by this round's models
    explorer = fake_explorer(**{**GOING_ON, "keep_imagined": False})
    state = begin(explorer)
    for number in (1, 2, 3):
        state, _ = explorer.improve(jax.random.key(number), state, OBS, 20)
        assert int(state.behaviour.learner["updates"]) == 4 * number
        rows = held(state.behaviour.imagined)
        obs, delta = normal(state, rows)
        want = SPREAD * (3 * number) ** 2 * np.sum(obs**2, axis=1) + 100 * delta[:, 0]
        assert len(rows.reward) == 16
        np.testing.assert_allclose(rows.reward, want, rtol=1e-3, atol=1e-2)


def test_first_rollouts_take_uniform_actions():
    # two random rollouts of 64 actors (768 numbers: mean 0 +- 0.02, variance 1/3 +- 0.011), then the policy's,
    # which sees normalised observations
    explorer = fake_explorer(**RANDOM_AND_REAL)
    state, _ = explorer.improve(jax.random.key(0), begin(explorer), OBS, 20)
    rows = held(state.behaviour.imagined)
    actions = rows.action
    assert np.mean(actions[:384]) == pytest.approx(0, abs=0.08)
    assert np.var(actions[:384]) == pytest.approx(1 / 3, abs=0.04)
    assert np.max(np.abs(actions[:384])) <= 1
    np.testing.assert_allclose(actions[384:], 5 + np.tanh(normal(state, rows)[0][384:, : SIZES.action]), rtol=1e-4)


def test_real_data_get_the_reward_computed_directly():
    # 1,200 rows, over one chunk of 1,024: each row of the last real batch has the reward of its own obs and change,
    # and is seen normalised; rows beyond 1,024 are among them
    explorer = fake_explorer(
        capacity=1300, batch_size=512, real_updates=2, updates_per_rollout=1, num_random_rollouts=1
    )
    state, _ = explorer.improve(jax.random.key(0), begin(explorer, 1200), OBS, 1200)
    batch = jax.tree.map(np.asarray, state.behaviour.learner["batch"])
    stats = state.normalizers
    raw = {
        name: x * np.asarray(stats.obs.std) + np.asarray(stats.obs.mean)
        for name, x in batch._asdict().items()
        if "obs" in name
    }
    delta = (raw["next_obs"] - raw["obs"] - np.asarray(stats.delta.mean)) / np.asarray(stats.delta.std)
    want = SPREAD * 9 * np.sum(batch.obs**2, axis=1) + 100 * delta[:, 0]
    np.testing.assert_allclose(batch.reward, want, rtol=1e-3, atol=0.02)
    rows = held(state.data)
    index = [np.argmin(np.sum((rows.obs - obs) ** 2, axis=1)) for obs in raw["obs"]]
    np.testing.assert_allclose(rows.obs[index], raw["obs"], atol=1e-4)
    assert max(index) >= 1024 and len(set(index)) > 350
    np.testing.assert_array_equal(batch.action, rows.action[index])


@pytest.mark.parametrize(("settings", "want"), [({}, 0), (TAGGED, 4)], ids=["none", "a quarter"])
def test_share_of_real_rows_in_a_batch(settings, want):
    # imagined transitions never terminate; here all real ones do, and their actions are below 4
    explorer = fake_explorer(**settings)
    state, _ = explorer.improve(jax.random.key(0), begin(explorer, terminated=True), OBS, 20)
    batch = state.behaviour.learner["batch"]
    assert int(jnp.sum(batch.terminated)) == want
    assert int(jnp.sum(jnp.all(batch.action > 3.9, axis=1))) == 16 - want


@pytest.mark.parametrize(("fraction", "want"), [(0.0, 0), (0.25, 4), (1.0, 16)])
def test_share_of_real_rows_in_a_draw(fraction, want):
    # two buffers of numbers: positive ones are real
    full = jnp.asarray(np.int32(8))
    real, imagined = (replay.Replay({"x": jnp.asarray(sign * np.arange(1.0, 9))}, 0 * full, full) for sign in (1, -1))
    lesson = lesson_of([(real, round(16 * fraction)), (imagined, 16 - round(16 * fraction))], None, AS_THEY_ARE)
    assert int(jnp.sum(lesson.take(lesson.choose(jax.random.key(0)))["x"] > 0)) == want


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("center", [False, True])
def test_rewards_are_counted_from_their_mean_where_asked(normalize, center):
    # of the four rows held, whose rewards are 2, 4, 6 and 8: mean 5, variance 5; a learner sees the row's number as obs
    own, flag = jnp.array([2.0, 4.0, 6.0, 8.0, 9.0, 9.0]), jnp.zeros(6, bool)
    rows = Transition(jnp.arange(6.0)[:, None], jnp.zeros((6, 1)), own, jnp.zeros((6, 1)), flag, flag)
    data = replay.Replay(rows, jnp.int32(4), jnp.int32(4))
    moments = reward_moments(data, normalize, center)
    assert float(moments.mean) == (5.0 if center else 0.0)
    assert float(moments.std) == pytest.approx(5**0.5 if normalize else 1.0)
    learner = recording_learner(Sizes(1, 1), 32)
    state, _ = train(
        *(learner, jax.random.key(0), learner.init(jax.random.key(1))),
        *(lesson_of([(data, 32)], None, moments), 3, {"one": jnp.zeros(())}),
    )
    batch = state["batch"]
    want = (own[batch.obs[:, 0].astype(int)] - moments.mean) / moments.std
    np.testing.assert_allclose(batch.reward, want, rtol=1e-6)
    assert int(state["updates"]) == 3 and len(np.unique(batch.obs)) == 4


def test_nothing_is_imagined_where_batches_are_all_real():
    # as many updates as after rollouts, on rows whose every state is real, with the round's own rewards
    explorer = fake_explorer(**{**GOING_ON, "real_fraction": 1.0})
    state = begin(explorer)
    for number in (1, 2):
        state, metrics = explorer.improve(jax.random.key(number), state, OBS, 20)
        assert int(state.behaviour.learner["updates"]) == 4 * number
        assert int(state.behaviour.imagined.size) == 0 and "policy/imagined_reward" not in metrics
        batch, rows = state.behaviour.learner["batch"], held(state.data)
        own, delta = normal(state, rows)
        index = [int(np.argmin(np.sum((own - obs) ** 2, axis=1))) for obs in np.asarray(batch.obs)]
        np.testing.assert_allclose(batch.obs, own[index], atol=1e-5)
        want = SPREAD * (3 * number) ** 2 * np.sum(own**2, axis=1) + 100 * delta[:, 0]
        np.testing.assert_allclose(batch.reward, (want / np.std(want))[index], rtol=1e-3, atol=1e-3)


def test_rewards_are_divided_by_their_standard_deviation():
    # over the imagined data held, by NumPy; the buffer keeps the reward's own units
    explorer = fake_explorer(**GOING_ON)
    state = begin(explorer)
    for number in (0, 1):
        state, _ = explorer.improve(jax.random.key(number), state, OBS, 20)
        rows, batch = held(state.behaviour.imagined), state.behaviour.learner["batch"]
        std = np.std(rows.reward)
        own = normal(state, rows)[0]
        index = [np.argmin(np.sum((own - obs) ** 2, axis=1)) for obs in np.asarray(batch.obs)]
        # Actors that start in the same place differ in their change, so compare the multisets of possible rewards.
        for i, reward in zip(index, np.asarray(batch.reward), strict=True):
            same = np.all(np.abs(own - own[i]) < 1e-4, axis=1)
            assert np.min(np.abs(rows.reward[same] / std - reward)) < 1e-3


@pytest.mark.parametrize(("fraction", "num_current"), [(1.0, 8), (0.25, 2), (0.0, 0)])
def test_share_of_actors_that_start_where_the_environment_stands(fraction, num_current):
    # round(fraction * 8) actors at the current observation, the others at observations of the data
    state = begin(fake_explorer())
    found = starts(jax.random.key(0), Experience((), state.data, jnp.int32(20), state.normalizers, OBS), 8, fraction)
    found, past = np.asarray(found), np.asarray(transitions(20).obs)
    here = np.all(found == np.asarray(OBS), axis=1)
    assert here.sum() == num_current
    assert all(np.any(np.all(past == start, axis=1)) for start in found[~here])


def test_imagined_rows_that_are_not_finite_are_dropped():
    # models that blow up where the first entry is positive: 6 of 8 actors start there, and leave no trace
    def exploding(sizes, config):
        belief = counting_belief(sizes, config)

        def predict(models, inputs):
            bad = inputs[None, :, :1] > 0
            return Prediction(jnp.where(bad, jnp.inf, belief.predict(models, inputs).mean))

        return belief._replace(predict=predict)

    explorer = fake_explorer(belief=exploding, num_actors=8, horizon=1, current_fraction=0.25)
    rows = transitions(20)
    rows = rows._replace(obs=rows.obs.at[:, 0].set(jnp.arange(20.0)))
    state = explorer.observe(explorer.init(jax.random.key(0)), rows, jnp.ones(20, bool))
    # Only rows above the mean, 9.5, can be drawn from the buffer; the statistics stay.
    data = state.data.replace(rows=state.data.rows._replace(obs=state.data.rows.obs.at[:, 0].set(15.0)))
    state, metrics = explorer.improve(jax.random.key(0), state.replace(data=data), OBS.at[0].set(2.0), 20)
    assert float(metrics["policy/invalid_imagined"]) == 0.75
    imagined = held(state.behaviour.imagined)
    np.testing.assert_array_equal(imagined.obs[:, 0], [2.0, 2.0])
    assert float(metrics["policy/imagined_reward"]) == pytest.approx(np.mean(imagined.reward), rel=1e-5)


@pytest.mark.parametrize("greedily", [True, False])
def test_acting_sees_normalised_observations(greedily):
    # the fake's greedy action is what it sees, its drawn one 5 + tanh of it; any leading axes
    explorer, state = make_fake(act_greedily=greedily), begin(fake_explorer())
    obs = transitions(6, seed=1).obs.reshape(2, 3, SIZES.obs)
    stats = state.normalizers.obs
    seen = (np.asarray(obs) - np.asarray(stats.mean)) / np.asarray(stats.std)
    want = seen[..., : SIZES.action] if greedily else 5 + np.tanh(seen[..., : SIZES.action])
    np.testing.assert_allclose(explorer.act(jax.random.key(0), explorer.actor(state), obs), want, rtol=1e-4, atol=1e-5)


def test_an_actor_acts_uniformly_or_as_the_behaviour_does():
    # uniform: the very numbers of uniform actions with that key, traced or not; otherwise the behaviour's, which here
    # are above 4
    explorer, state, key = make_fake(act_greedily=False), begin(fake_explorer()), jax.random.key(4)
    obs = transitions(6, seed=1).obs
    uniform = uniform_actions(key, obs, SIZES.action)
    act = jax.jit(lambda wanted: explorer.act(key, explorer.actor(state, uniform=wanted), obs))
    np.testing.assert_array_equal(explorer.act(key, explorer.actor(state, uniform=True), obs), uniform)
    np.testing.assert_array_equal(act(True), uniform)
    np.testing.assert_array_equal(explorer.act_uniformly(key, obs), uniform)
    assert np.max(np.abs(uniform)) <= 1
    seen = normal(state, transitions(6, seed=1))[0][:, : SIZES.action]
    for actions in (act(False), explorer.act(key, explorer.actor(state), obs)):
        np.testing.assert_allclose(actions, 5 + np.tanh(seen), rtol=1e-4)


def test_assess_says_what_the_belief_makes_of_new_transitions():
    # after n = 3 updates: reward 11.25 |obs|^2 + 100 delta_0 over valid rows; the models' mean is 1.5 n obs + tag,
    # their variance 11.25 |obs|^2 and their divergence that of models 0, 3 obs, 6 obs, 9 obs, whatever the reward
    explorer = fake_explorer()
    state, _ = explorer.improve(jax.random.key(0), begin(explorer), OBS, 20)
    rows, valid = transitions(9, seed=2), np.arange(9) < 7
    key = jax.random.key(5)
    got = explorer.assess(key, state, rows, jnp.asarray(valid))
    obs, delta = normal(state, rows)
    reward = (SPREAD * 9 * np.sum(obs**2, axis=1) + 100 * delta[:, 0])[valid]
    error = ((1.5 * 3 * obs + float(jax.random.normal(key, ())) - delta) ** 2)[valid]
    variance = (SPREAD * 9 * np.sum(obs**2, axis=1))[valid]
    means = 3 * np.arange(4)[:, None, None] * obs[None, valid]
    divergence = np.asarray(rewards.jensen_renyi(Prediction(jnp.asarray(means, jnp.float32)), 0.1))
    want: dict[str, object] = {"model_error": error.mean()}
    for name, values in (("intrinsic_reward", reward), ("variance", variance), ("divergence", divergence)):
        want |= {name: values.mean(), f"{name}_p95": np.percentile(values, 95)}
    assert {name: float(value) for name, value in got.items()} == pytest.approx(want, rel=1e-4)


def test_random_method_acts_uniformly_and_learns_nothing():
    # U[-1, 1]: mean 0, variance 1/3 (2,000 numbers); improve returns the state it got, to the bit
    explorer = jitted(make_explorer(METHODS["random"], SIZES, ExplorationConfig(data_capacity=64)))
    state = begin(explorer)
    improved, metrics = explorer.improve(jax.random.key(1), state, OBS, 20)
    assert metrics == {} and explorer.assess(jax.random.key(0), state, transitions(4), jnp.ones(4, bool)) == {}
    assert jax.tree.structure(improved) == jax.tree.structure(state)
    jax.tree.map(np.testing.assert_array_equal, improved, state)
    for draw in (functools.partial(explorer.act, actor=explorer.actor(state)), explorer.act_uniformly):
        actions = np.asarray(draw(jax.random.key(2), obs=np.zeros((1000, 3), np.float32)))
        assert actions.shape == (1000, 2) and np.max(np.abs(actions)) <= 1
        assert np.mean(actions) == pytest.approx(0, abs=0.06) and np.var(actions) == pytest.approx(1 / 3, abs=0.03)


def test_a_new_row_of_the_table_is_a_method(monkeypatch):
    # name -> method, with a belief, a reward and a behaviour that the library does not know: nothing else changes
    row = Method("counts", read_off(counting_belief, tagged), recording)
    monkeypatch.setitem(METHODS, "counting", row)
    assert get_method("counting") is row
    with pytest.raises(ValueError, match=r"method='countin' .*Did you mean 'counting'.*Allowed: .*implicit"):
        get_method("countin")


def test_settings_that_do_not_fit_are_refused():
    # the field, its value, and what is allowed
    with pytest.raises(ValueError, match=r"replay_capacity=10 does not hold one rollout.* = 20"):
        ImaginationConfig(num_actors=4, horizon=5, replay_capacity=10)
    with pytest.raises(ValueError, match=r"ImaginationConfig\.mover='per_rolout' .*Did you mean 'per_rollout'"):
        ImaginationConfig(mover="per_rolout")
    with pytest.raises(ValueError, match=r"FitConfig\.lr=0\.0 .*\(0, inf\)"):
        FitConfig(lr=0.0)
    with pytest.raises(ValueError, match=r"ExplorationConfig\.reward_units='raww' .*Did you mean 'raw'"):
        ExplorationConfig(reward_units="raww")
    with pytest.raises(ValueError, match=r"ExplorationConfig\.steps_per_round=0"):
        ExplorationConfig(steps_per_round=0)


SMALL = ExplorationConfig(
    data_capacity=64,
    dynamics=DynamicsConfig(hidden=(8,)),
    generator=GeneratorConfig(noise_size=4, hidden=(8,)),
    svgd=SVGDConfig(num_particles=4),
    fit=FitConfig(lr=1e-2, batch_size=8, epochs=1, restart=False),
    imagination=ImaginationConfig(
        num_actors=4,
        horizon=3,
        num_rollouts=3,
        num_random_rollouts=1,
        updates_per_rollout=2,
        real_updates=0,
        restart_every=0,
        replay_capacity=64,
    ),
    sac=SACConfig(hidden=(8,), batch_size=8, init="lecun", log_std_min=-5.0),
)


@pytest.fixture(scope="module")
def small():
    """The paper's method at small size, compiled; as it is; and how often `improve` was traced."""
    explorer = make_explorer(METHODS["implicit"], SIZES, SMALL)
    traces = []

    def improve(*args):
        traces.append(1)
        return explorer.improve(*args)

    return jitted(explorer._replace(improve=improve)), explorer, traces


def rounds(explorer, key, num=3):
    """Several rounds with 16 more transitions each; the last state and the metrics of each."""
    state, metrics = explorer.init(key), []
    for number in range(num):
        state = explorer.observe(state, transitions(16, seed=number), np.ones(16, bool))
        state, new = explorer.improve(jax.random.fold_in(key, number), state, OBS, np.int32(16 * (number + 1)))
        metrics.append(new)
    return state, metrics


def test_improve_is_traced_once_and_repeats_to_the_bit(small):
    # three rounds, each with more data and so a longer fit, are one trace; a run again with the same key gives the
    # same numbers, with another key others
    explorer, _, traces = small
    first, again, other = (rounds(explorer, jax.random.key(seed)) for seed in (0, 0, 1))
    assert len(traces) == 1
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert float(first[1][-1]["fit/loss"]) != float(other[1][-1]["fit/loss"])


def test_seeds_side_by_side_are_seeds_one_by_one(small):
    # T16: vmap over two seeds gives the numbers of a loop over them, in float32 (reductions may differ in order)
    explorer, plain, _ = small
    keys = [jax.random.key(1), jax.random.key(2)]
    states = [explorer.observe(explorer.init(key), transitions(16), np.ones(16, bool)) for key in keys]

    @jax.jit
    def batched(keys, states):
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        return jax.vmap(plain.improve, in_axes=(0, 0, None, None))(jnp.stack(keys), stacked, OBS, jnp.int32(16))

    together = jax.device_get(batched(keys, states))
    for i, (key, state) in enumerate(zip(keys, states, strict=True)):
        alone = explorer.improve(key, state, OBS, np.int32(16))
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-3, atol=1e-5), together, alone)


def test_the_greedy_action_of_sac_is_its_squashed_mean(small):
    # one leaky-ReLU layer and the first half of the last one, by hand on normalised observations; no key is looked at,
    # and an action that is drawn is another
    drawn = make_explorer(
        METHODS["implicit"],
        SIZES,
        dataclasses.replace(SMALL, imagination=dataclasses.replace(SMALL.imagination, act_greedily=False)),
    )
    state, rows = begin(small[0]), transitions(6, seed=1)
    actor = drawn.actor(state)
    layers = jax.device_get(actor.behaviour)["mlp"]
    hidden = normal(state, rows)[0] @ layers["hidden_0"]["kernel"] + layers["hidden_0"]["bias"]
    last = np.where(hidden > 0, hidden, 0.01 * hidden) @ layers["output"]["kernel"] + layers["output"]["bias"]
    want = np.tanh(last[:, : SIZES.action])

    @jax.jit
    def both(obs):
        return drawn.act_greedily(None, actor, obs), drawn.act(jax.random.key(0), actor, obs)

    greedy, other = both(rows.obs)
    np.testing.assert_allclose(greedy, want, rtol=1e-4, atol=1e-5)
    assert np.max(np.abs(other - want)) > 0.01


def test_raw_rewards_are_in_the_observations_units(small):
    # reward_units="raw": entries times their std squared; stds of 1 give the normalised reward, of 3 nine times it
    explorer, _, _ = small
    raw = jitted(make_explorer(METHODS["implicit"], SIZES, dataclasses.replace(SMALL, reward_units="raw")))
    state, rows = begin(explorer), transitions(8, seed=1)
    count = state.normalizers.delta.count

    def reward(explorer, std):
        delta = state.normalizers.delta.replace(sum_squares=count * std**2)
        new = state.replace(normalizers=state.normalizers.replace(delta=delta))
        return float(explorer.assess(jax.random.key(3), new, rows, np.ones(8, bool))["intrinsic_reward"])

    ones, threes = np.ones(3, np.float32), np.full(3, 3, np.float32)
    normalized = reward(explorer, ones)
    assert reward(explorer, threes) == pytest.approx(normalized, rel=1e-5)
    assert [reward(raw, std) for std in (ones, threes)] == pytest.approx([normalized, 9 * normalized], rel=1e-5)
