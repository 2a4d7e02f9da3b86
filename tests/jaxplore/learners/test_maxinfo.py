"""SAC that also seeks information: SAC itself where the information counts for nothing, and what its weight follows."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import normalizer
from jaxplore.learners import maxinfo
from jaxplore.learners.maxinfo import InformationConfig, make_maxinfo_sac
from jaxplore.learners.sac import SACConfig, make_sac
from jaxplore.types import Transition

CONFIG = SACConfig(hidden=(8, 8), batch_size=16, learn_alpha=True, alpha=0.5, lr=1e-2, tau=0.1)


def batch_of(seed, num=16):
    rng = np.random.default_rng(seed)
    obs, action, reward, next_obs = (
        rng.normal(size=shape).astype(np.float32) for shape in ((num, 3), (num, 2), num, (num, 3))
    )
    flag = np.zeros(num, bool)
    return Transition(obs, np.tanh(action), reward, next_obs, flag, flag)


def to_the_right(obs, action):
    """A gain that is known: the first entry of the action."""
    return action[:, 0]


def make(gain=to_the_right, config=CONFIG, **information):
    return make_maxinfo_sac(3, 2, gain, config, InformationConfig(**information))


@pytest.mark.parametrize("normalize", [True, False])
def test_information_of_no_weight_leaves_sac_as_it_is(normalize):
    # three updates with the same keys, networks, optimiser and entropy weight alike
    plain, informed = make_sac(3, 2, CONFIG), make(weight=0.0, learn_weight=False, normalize=normalize)

    def train(learner):
        state, told = learner.init(jax.random.key(0)), []
        update = jax.jit(learner.update)
        for i in range(3):
            state, metrics = update(jax.random.key(10 + i), state, batch_of(i))
            told.append(metrics)
        return state, told

    (want, plain_told), (got, informed_told) = train(plain), train(informed)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-7), got.sac, want)
    for one, other in zip(plain_told, informed_told, strict=True):
        assert other.keys() - one.keys() == {"information", "slow_information"}
        for name, value in one.items():
            np.testing.assert_allclose(other[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(("slow_mean", "rises"), [(2.0, True), (-2.0, False)])
@pytest.mark.parametrize("normalize", [True, False])
def test_the_weight_rises_while_the_slow_copy_gains_more(slow_mean, rises, normalize):
    # the policy's actions are around 0, those of the slow copy at tanh(+-2): one step of Adam is the rate, up or down
    learner = make(normalize=normalize)
    state = jax.tree.map(jnp.zeros_like, learner.init(jax.random.key(0)))
    slow = jax.tree.map(lambda leaf: leaf, state.slow_policy)
    slow["mlp"]["output"]["bias"] = jnp.array([[slow_mean, 0.0], [0.0, 0.0]]).reshape(
        slow["mlp"]["output"]["bias"].shape
    )
    after, metrics = jax.jit(learner.update)(
        jax.random.key(1), dataclasses.replace(state, slow_policy=slow), batch_of(0)
    )
    assert float(metrics["slow_information"]) == pytest.approx(math.tanh(slow_mean), abs=1e-2)
    assert abs(float(metrics["information"])) < 1e-2
    moved = float(after.sac.params["log_information_weight"])
    assert moved == pytest.approx(CONFIG.lr if rises else -CONFIG.lr, rel=1e-3)
    assert float(metrics["information_weight"]) == pytest.approx(math.exp(moved), rel=1e-6)


def test_information_is_worth_its_weight():
    # by hand: all else 0, so that the value aimed at is weight * gain and the policy's loss its negative; a gain of 0.7
    # everywhere is 0.7 in its own units, and no deviation from the mean of all
    config = dataclasses.replace(CONFIG, learn_alpha=False, alpha=0.0, policy_penalty=0.0)
    for normalize, gain in ((False, 0.7), (True, 0.0)):
        learner = make(lambda obs, action: jnp.full(obs.shape[0], 0.7), config, normalize=normalize, weight=3.0)
        state = learner.init(jax.random.key(0))
        params = jax.tree.map(jnp.zeros_like, state.sac.params) | {"log_information_weight": jnp.log(3.0)}
        nothing = dataclasses.replace(
            state.sac, params=params, target_v=jax.tree.map(jnp.zeros_like, state.sac.target_v)
        )
        metrics = jax.jit(learner.update)(jax.random.key(1), dataclasses.replace(state, sac=nothing), batch_of(0))[1]
        want = {"policy_loss": -3.0 * gain, "v_loss": 0.5 * (3.0 * gain) ** 2, "information": 0.7}
        assert {name: float(metrics[name]) for name in want} == pytest.approx(want, rel=1e-5, abs=1e-6)


def test_the_policy_climbs_the_gain():
    # nothing else to seek: it goes to the right, and with the sign turned to the left
    config = dataclasses.replace(CONFIG, learn_alpha=False, alpha=0.0, policy_penalty=0.0)
    flat = batch_of(0)._replace(reward=np.zeros(16, np.float32))
    for sign in (1.0, -1.0):
        gain = lambda obs, action, sign=sign: sign * action[:, 0]  # noqa: E731
        learner = make(gain, config, learn_weight=False, normalize=False)

        @jax.jit
        def train(key, learner=learner):
            step = lambda i, carry: learner.update(jax.random.fold_in(key, i), carry, flat)[0]  # noqa: E731
            return jax.lax.fori_loop(0, 150, step, learner.init(key))

        state = train(jax.random.key(0))
        action = np.asarray(learner.act_greedily(learner.actor(state), flat.obs))
        assert np.all(sign * action[:, 0] > 0.8)
        # and the slow copy follows
        slow = np.asarray(learner.act_greedily(state.slow_policy, flat.obs))
        assert np.all(sign * slow[:, 0] > 0.7)


def test_gains_are_counted_in_deviations_of_those_that_came():
    # numpy's over all batches; beyond a million the oldest fade, and the deviation stays that of what comes
    rng = np.random.default_rng(0)
    batches = [rng.normal(3.0, 2.0, size=64).astype(np.float32) for _ in range(5)]
    state = normalizer.init(1)
    for gains in batches:
        state = maxinfo.remember(state, gains)
    assert float(state.mean[0]) == pytest.approx(np.mean(batches), rel=1e-5)
    assert float(state.std[0]) == pytest.approx(np.std(batches), rel=1e-5)
    full = dataclasses.replace(
        state, count=jnp.float32(maxinfo.MEMORY), sum_squares=jnp.full(1, 4.0 * maxinfo.MEMORY, jnp.float32)
    )
    after = maxinfo.remember(full, batches[0])
    assert float(after.count) == maxinfo.MEMORY
    assert float(after.std[0]) == pytest.approx(2.0, rel=1e-3)


def test_a_policy_is_taken_over_with_its_slow_copy():
    learner = make()
    ours, theirs = (learner.init(jax.random.key(seed)) for seed in (0, 1))
    taken = learner.adopt(ours, learner.actor(theirs))
    for policy in (learner.actor(taken), taken.slow_policy):
        jax.tree.map(np.testing.assert_array_equal, policy, learner.actor(theirs))
    jax.tree.map(np.testing.assert_array_equal, taken.sac.params["q"], ours.sac.params["q"])


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match=r"InformationConfig\.weight=0\.0 .*\(0, inf"):
        InformationConfig(weight=0.0)
    with pytest.raises(ValueError, match=r"InformationConfig\.weight=-1\.0 .*\[0, inf"):
        InformationConfig(weight=-1.0, learn_weight=False)
    with pytest.raises(ValueError, match=r"InformationConfig\.noise_std=0\.0 .*\(0, inf"):
        InformationConfig(noise_std=0.0)
    with pytest.raises(ValueError, match="obs_size=0"):
        make_maxinfo_sac(0, 2, to_the_right)
