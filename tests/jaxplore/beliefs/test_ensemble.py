"""Static ensembles: each member is the network that would have come of training alone; what Gaussian members state."""

import functools
import itertools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxplore import dynamics, replay
from jaxplore.beliefs import FitConfig
from jaxplore.beliefs.ensemble import (
    EnsembleConfig,
    bootstrap_weights,
    gaussian_head,
    gaussian_nll,
    make_ensemble_belief,
)
from jaxplore.dynamics import DynamicsConfig
from jaxplore.types import Transition

O, A, M, B = 3, 2, 3, 16  # noqa: E741
SMALL = DynamicsConfig(hidden=(8,))


def make_data(num=60, target="delta", seed=0):
    """`(replay, normalizers)` with room for 64 rows."""
    rng = np.random.default_rng(seed)
    if target == "one_hot":
        obs, next_obs = np.eye(O)[rng.integers(0, O, num)], np.eye(O)[rng.integers(0, O, num)]
    else:
        obs = rng.normal(size=(num, O)) * [1.0, 2.0, 5.0] + 1
        next_obs = obs + rng.normal(size=obs.shape)
    action, flag = rng.uniform(-1, 1, (num, A)), np.zeros(num, bool)
    rows = (np.asarray(x, np.float32) for x in (obs, action, np.zeros(num), next_obs))
    return jax.device_get(take_in(Transition(*rows, flag, flag)))


@jax.jit
def take_in(rows):
    data = replay.add(replay.init(jax.tree.map(lambda leaf: leaf[0], rows), 64), rows)
    normalizers = dynamics.update_normalizers(dynamics.init_normalizers(O, A), rows, jnp.ones(len(rows.reward), bool))
    return data, normalizers


def train(belief, data, normalizers, steps):
    """The state after `steps` updates."""

    @jax.jit
    def run(key, data, normalizers):
        def update(i, state):
            return belief.update(jax.random.key(i), state, data, normalizers)[0]

        return jax.lax.fori_loop(0, steps, update, belief.init(key))

    return run(jax.random.key(0), data, normalizers)


def forward(params, x, activation):
    """A network with one hidden layer, from its parameters alone."""
    x = activation(x @ params["hidden_0"]["kernel"] + params["hidden_0"]["bias"][None])
    return x @ params["output"]["kernel"] + params["output"]["bias"][None]


@pytest.mark.parametrize(("gaussian", "bootstrap"), [(False, "none"), (True, "poisson")])
def test_members_are_networks_trained_alone(gaussian, bootstrap):
    # each member again, in a loop of its own: its batches, its clipping by norm, its weight decay, its Adam
    fit = FitConfig(lr=1e-2, weight_decay=0.1, batch_size=B, clip_value=0.5, clip_norm=0.2)
    network = DynamicsConfig(hidden=(8,), activation="swish" if gaussian else "relu")
    belief = make_ensemble_belief(
        O,
        A,
        M,
        gaussian=gaussian,
        dynamics_config=network,
        ensemble_config=EnsembleConfig(bootstrap),
        fit_config=fit,
    )
    data, normalizers = make_data()
    start = state = belief.init(jax.random.key(0))
    update = jax.jit(belief.update)
    for step in range(5):
        state, metrics = update(jax.random.key(step), state, data, normalizers)

    def standard(statistics, rows):
        return (rows - statistics.mean) / np.asarray(statistics.std)

    inputs = np.hstack([standard(normalizers.obs, data.rows.obs), standard(normalizers.action, data.rows.action)])
    targets = standard(normalizers.delta, data.rows.next_obs - data.rows.obs)

    @jax.jit
    @jax.vmap
    def draws(step):
        index = jax.random.randint(jax.random.key(step), (M, B), 0, 60)
        return index, bootstrap_weights(bootstrap, M, index)

    index, weights = jax.device_get(draws(np.arange(5)))
    adam = optax.adam(1e-2)

    def loss(params, x, y, w):
        last = forward(params, x, nn.swish if gaussian else nn.relu)
        if not gaussian:
            return jnp.mean(w[:, None] * (last - y) ** 2)
        log_var = -5 + 4 / (1 + jnp.exp(-last[:, O:]))
        return jnp.mean(w[:, None] * ((last[:, :O] - y) ** 2 / jnp.exp(log_var) + log_var))

    @jax.jit
    def step_alone(params, opt_state, x, y, w):
        value, gradient = jax.value_and_grad(loss)(params, x, y, w)
        gradient = jax.tree.map(lambda g: jnp.clip(g, -0.5, 0.5), gradient)
        norm = jnp.sqrt(sum(jnp.sum(g**2) for g in jax.tree.leaves(gradient)))
        gradient = jax.tree.map(lambda g, p: g * jnp.minimum(1.0, 0.2 / norm) + 0.1 * p, gradient, params)
        steps, opt_state = adam.update(gradient, opt_state)
        return optax.apply_updates(params, steps), opt_state, value

    losses, (start, state, metrics) = [], jax.device_get((start, state, metrics))
    for i in range(M):
        params, value = jax.tree.map(lambda leaf, i=i: leaf[i], start.params), 0.0
        opt_state = jax.jit(adam.init)(params)
        for step in range(5):
            rows = index[step, i]
            params, opt_state, value = step_alone(params, opt_state, inputs[rows], targets[rows], weights[step, i])
        losses.append(float(value))
        alone, member = jax.tree.leaves(params), jax.tree.leaves(state.params)
        for got, want in zip(member, alone, strict=True):
            np.testing.assert_allclose(got[i], want, rtol=1e-4, atol=2e-6)
    assert float(metrics["loss"]) == pytest.approx(np.mean(losses), rel=1e-4)
    # no two members start, or end, alike
    kernels = np.asarray(state.params["hidden_0"]["kernel"])
    assert all(np.max(np.abs(kernels[a] - kernels[b])) > 0.1 for a, b in itertools.combinations(range(M), 2))


def test_gaussian_nll_by_hand():
    # mean 1, target 3, log var ln 4: (1 - 3)^2 / 4 + ln 4; a perfect mean costs the log variance alone
    got = gaussian_nll(jnp.array([1.0, 3.0]), jnp.log(jnp.array([4.0, 0.5])), jnp.array([3.0, 3.0]))
    np.testing.assert_allclose(got, [1.0 + np.log(4.0), np.log(0.5)], rtol=1e-6)


def test_variance_is_bounded_with_a_gradient_everywhere():
    # nnaisense/max: log var = -5 + 4 sigmoid(head), so -3 at 0, within [-5, -1] however far out
    mean, log_var = gaussian_head(jnp.array([7.0, 8.0, 9.0, -50.0, 0.0, 50.0]))
    np.testing.assert_array_equal(mean, [7.0, 8.0, 9.0])
    np.testing.assert_allclose(log_var, [-5.0, -3.0, -1.0], atol=1e-6)
    slopes = jax.jit(jax.vmap(jax.grad(lambda head: gaussian_head(jnp.stack([0.0, head]))[1][0])))
    slope = slopes(np.array([-8.0, 0.0, 8.0], np.float32))
    assert np.all(np.asarray(slope) > 1e-3) and float(slope[1]) == pytest.approx(1.0)


def test_gaussian_members_learn_the_noise_of_the_data():
    # pure noise of standard deviation 0.3 in normalised units cannot be: normalised targets have variance 1, above the
    # bound exp(-1). With targets shrunk to 0.5 by the statistics the best answer is mean 0 and variance 0.25
    data, normalizers = make_data()
    rows = data.rows._replace(obs=np.zeros((64, O), np.float32), action=np.zeros((64, A), np.float32))
    change = np.tile([[0.5], [-0.5]], (32, O)).astype(np.float32)
    data = data.replace(rows=rows._replace(next_obs=change))
    normalizers = dynamics.init_normalizers(O, A)
    fit = FitConfig(lr=0.05, weight_decay=0.0, batch_size=64)
    belief = make_ensemble_belief(O, A, M, gaussian=True, dynamics_config=SMALL, fit_config=fit)
    state = train(belief, data, normalizers, 200)
    prediction = jax.jit(belief.predict)(state.params, np.zeros((1, O + A), np.float32))
    np.testing.assert_allclose(prediction.mean, np.zeros((M, 1, O)), atol=0.15)
    np.testing.assert_allclose(prediction.var, np.full((M, 1, O), 0.25), rtol=0.15)


def test_predictions_are_the_members_own():
    # member by member, NumPy on its parameters; Gaussian ones with their variance
    inputs = np.random.default_rng(1).normal(size=(5, O + A)).astype(np.float32)
    for gaussian in (False, True):
        belief = make_ensemble_belief(O, A, M, gaussian=gaussian, dynamics_config=SMALL)
        models = jax.device_get(belief.sample(jax.random.key(1), belief.init(jax.random.key(0)), M))
        prediction = jax.jit(belief.predict)(models, inputs)
        for i in range(M):
            last = forward(jax.tree.map(lambda leaf, i=i: leaf[i], models), inputs, lambda x: np.maximum(x, 0))
            np.testing.assert_allclose(prediction.mean[i], last[:, :O], rtol=1e-4, atol=1e-5)
            if gaussian:
                np.testing.assert_allclose(prediction.var[i], np.exp(-5 + 4 / (1 + np.exp(-last[:, O:]))), rtol=1e-4)
        assert (prediction.var is None) == (not gaussian)


def test_probabilities_of_states():
    # target="one_hot": each member gives probabilities, and learns a fixed successor
    data, normalizers = make_data(target="one_hot")
    data = data.replace(rows=data.rows._replace(next_obs=np.roll(data.rows.obs, 1, axis=1)))
    network = DynamicsConfig(hidden=(16,), activation="tanh", target="one_hot")
    fit = FitConfig(lr=0.03, weight_decay=0.0, batch_size=B)
    belief = make_ensemble_belief(O, A, M, dynamics_config=network, fit_config=fit)
    state = train(belief, data, normalizers, 150)
    inputs = np.hstack([np.eye(O, dtype=np.float32), np.zeros((O, A), np.float32)])
    mean = np.asarray(jax.jit(belief.predict)(state.params, inputs).mean)
    np.testing.assert_allclose(np.sum(mean, axis=-1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(mean, np.tile(np.roll(np.eye(O), 1, axis=1), (M, 1, 1)), atol=0.1)


def test_members_never_asked_to_agree_differ_off_the_data():
    # conjugate check on the two ends: trained on one constant input, members agree there (the mean of the targets, 2)
    # and keep the spread of their starts elsewhere
    data, _ = make_data()
    ones = np.ones((64, O), np.float32)
    rows = data.rows._replace(obs=ones, action=ones[:, :A], next_obs=3 * ones)
    data, normalizers = data.replace(rows=rows), dynamics.init_normalizers(O, A)
    fit = FitConfig(lr=0.01, weight_decay=0.0, batch_size=B)
    belief = make_ensemble_belief(O, A, 8, dynamics_config=DynamicsConfig(hidden=(32,)), fit_config=fit)
    state, predict = train(belief, data, normalizers, 300), jax.jit(belief.predict)
    at, away = (np.asarray(predict(state.params, np.full((1, O + A), x, np.float32)).mean) for x in (1.0, -1.0))
    np.testing.assert_allclose(at, 2.0, atol=1e-2)
    assert np.min(np.var(away, axis=0)) > 100 * np.max(np.var(at, axis=0))
    assert np.min(np.var(away, axis=0)) > 0.1


@pytest.mark.parametrize("kind", ["poisson", "multinomial"])
def test_bootstrap_weights_are_fixed_and_have_mean_one(kind):
    # 8 members x 2,000 places: mean 1 +- 0.008, variance 1 or 1 - 1/8, whatever batch a place turns up in; Poisson
    # counts: 0 with probability 1/e; 8 copies of each transition in the multinomial one
    members, places = 8, 2_000
    weigh = jax.jit(functools.partial(bootstrap_weights, kind, members))
    table = np.asarray(weigh(np.tile(np.arange(places), (members, 1))))
    assert table.mean() == pytest.approx(1.0, abs=0.04)
    assert table.var() == pytest.approx(1.0 if kind == "poisson" else 1 - 1 / 8, abs=0.05)
    zero = np.exp(-1) if kind == "poisson" else (1 - 1 / 8) ** 8
    assert np.mean(table == 0) == pytest.approx(zero, abs=0.02)
    assert (kind == "multinomial") == np.all(table.sum(axis=0) == members)
    assert (
        np.max(np.abs(np.corrcoef(table) - np.eye(members) + (kind == "multinomial") * (1 - np.eye(members)) / 7)) < 0.1
    )
    batch = np.random.default_rng(0).integers(0, places, (members, 50))
    again = weigh(batch)
    np.testing.assert_array_equal(again, np.take_along_axis(table, batch, axis=1))


def test_no_bootstrap_weighs_all_alike():
    # and a member of a bootstrap that never saw a transition's weight above 0 does not move for it
    np.testing.assert_array_equal(bootstrap_weights("none", 2, jnp.zeros((2, 3), jnp.int32)), np.ones((2, 3)))
    weigh = jax.jit(functools.partial(bootstrap_weights, "poisson", M))
    weights = np.asarray(weigh(np.zeros((M, 1), np.int32)))[:, 0]
    (data, _), normalizers = make_data(1), dynamics.init_normalizers(O, A)
    fit = FitConfig(lr=0.1, weight_decay=0.0, batch_size=B)
    belief = make_ensemble_belief(
        O, A, M, dynamics_config=SMALL, ensemble_config=EnsembleConfig("poisson"), fit_config=fit
    )
    update = jax.jit(belief.update)
    for seed in (0, 1):  # Rounds that start again leave the weights as they are.
        state = belief.init(jax.random.key(seed))
        after, _ = update(jax.random.key(seed + 5), state, data, normalizers)
        first, last = (np.asarray(part.params["output"]["bias"]) for part in (state, after))
        moved = np.max(np.abs(last - first), axis=1) > 0
        np.testing.assert_array_equal(moved, weights > 0)


def test_fewer_models_are_different_members():
    # drawn without replacement; all of them in their own order; more are refused
    belief = make_ensemble_belief(O, A, 6, dynamics_config=SMALL)
    state = belief.init(jax.random.key(0))
    every = np.asarray(state.params["output"]["kernel"])
    np.testing.assert_array_equal(belief.sample(jax.random.key(1), state, 6)["output"]["kernel"], every)
    few = np.asarray(jax.jit(belief.sample, static_argnums=2)(jax.random.key(1), state, 4)["output"]["kernel"])
    found = [np.flatnonzero(np.all(every == one, axis=(1, 2))) for one in few]
    assert len({int(i) for (i,) in found}) == 4
    with pytest.raises(ValueError, match=r"num=7 models cannot be drawn from 6 members\. Allowed: 1 to 6"):
        belief.sample(jax.random.key(1), state, 7)


def test_as_many_models_are_drawn_for_a_round_as_there_are_members():
    # those of the settings, or those of the argument in their place
    for num, want in ((None, 6), (4, 4)):
        settings = EnsembleConfig(num_members=6)
        belief = make_ensemble_belief(O, A, num, dynamics_config=SMALL, ensemble_config=settings)
        assert belief.num_models == want
        state = jax.eval_shape(belief.init, jax.random.key(0))
        models = jax.eval_shape(functools.partial(belief.sample, num=want), jax.random.key(1), state)
        assert {leaf.shape[0] for leaf in jax.tree.leaves(models)} == {want}


def test_what_does_not_fit_is_refused():
    # the field, its value, and what is allowed
    with pytest.raises(ValueError, match=r"num_members=0 .*1 or more"):
        make_ensemble_belief(O, A, 0)
    with pytest.raises(ValueError, match=r"gaussian=True does not fit .*'one_hot'.*Allowed: 'delta'"):
        make_ensemble_belief(O, A, 2, gaussian=True, dynamics_config=DynamicsConfig(target="one_hot"))
    with pytest.raises(ValueError, match=r"EnsembleConfig\.bootstrap='poison' .*Did you mean 'poisson'"):
        EnsembleConfig("poison")  # pyright: ignore[reportArgumentType]
