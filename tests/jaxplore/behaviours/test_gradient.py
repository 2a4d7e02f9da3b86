"""Gradient ascent through models: the gradient against finite differences, and the action that it finds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxplore import beliefs, dynamics, replay, rewards
from jaxplore.behaviours import Experience, World
from jaxplore.behaviours.gradient import GradientPolicyConfig, imagined_return, make_gradient_policy
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import Prediction
from jaxplore.exploration import make_explorer
from jaxplore.methods import METHODS
from jaxplore.networks import TanhGaussianPolicy
from jaxplore.signals import Signal
from jaxplore.types import Transition

OBS, ACTION, BEST = 2, 1, 0.6


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def predict(models, inputs):
    """Smooth models `[M]` that differ in a gain: the change is gain * sin(obs + 2 action)."""
    obs, action = inputs[:, :OBS], inputs[:, OBS:]
    return Prediction(models[:, None, None] * jnp.sin(obs + 2 * action)[None])


def variance(seen):
    return rewards.variance(seen.prediction)


def written_out(key, models, policy, params, start, horizon):
    """J in plain loops. The keys are the library's, so that chance is the same."""
    member_key, scan_key = jax.random.split(key)
    members = jax.random.randint(member_key, (len(start),), 0, len(models))
    total, obs = 0.0, start
    for t, step_key in enumerate(jax.random.split(scan_key, horizon)):
        gaussian = policy.apply({"params": params}, obs)
        act_key, _ = jax.random.split(step_key)
        # the normal draws, from what the library draws with mean 0 and standard deviation 1
        noise = jnp.arctanh(draw(act_key, gaussian.mean.shape))
        action = jnp.tanh(gaussian.mean + jnp.exp(gaussian.log_std) * noise)
        moved = models[:, None, None] * jnp.sin(obs + 2 * action)[None]
        centre = sum(moved) / len(models)
        total += 0.9**t * jnp.mean(sum(jnp.sum((one - centre) ** 2, axis=1) for one in moved) / len(models))
        obs = obs + jnp.stack([moved[members[i], i] for i in range(len(start))])
    return total


def draw(key, shape):
    from jaxplore.networks import GaussianParams, sample_tanh_gaussian

    return sample_tanh_gaussian(key, GaussianParams(jnp.zeros(shape), jnp.zeros(shape)))[0]


@pytest.mark.parametrize("horizon", [1, 3])
def test_the_gradient_is_that_of_the_printed_objective(x64, horizon):
    # against J written out, and its gradient against central differences in every direction
    policy, models = TanhGaussianPolicy((3,), ACTION, "tanh", "lecun", (-2.0, 0.0)), jnp.array([0.5, 1.0, 1.4])
    shapes = jax.eval_shape(policy.init, jax.random.key(0), jnp.zeros(OBS))["params"]
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), shapes)
    start = jnp.asarray(rng.normal(size=(5, OBS)))
    config = GradientPolicyConfig(horizon=horizon, discount=0.9)
    flat, unravel = ravel_pytree(params)
    normalizers = jax.tree.map(lambda x: x.astype(float), dynamics.init_normalizers(OBS, ACTION))
    world = World(make_belief(predict), models, normalizers, variance)

    def expected(flat):
        key = jax.random.key(2)
        return imagined_return(key, policy, unravel(flat), world, start, config)[0]

    @jax.jit
    def by_hand(flat):
        return written_out(jax.random.key(2), models, policy, unravel(flat), start, horizon)

    @jax.jit
    def central(flat, step):
        ends = jax.vmap(expected)(jnp.concatenate([flat[None] + step * jnp.eye(len(flat)) for step in (step, -step)]))
        return (ends[: len(flat)] - ends[len(flat) :]) / (2 * step)

    value, gradient = jax.jit(jax.value_and_grad(expected))(flat)
    assert float(value) == pytest.approx(float(by_hand(flat)), rel=1e-9)
    differences = central(flat, 1e-6)
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-9)
    assert np.abs(differences).max() > 1e-2


def make_belief(predict):
    return beliefs.make_no_belief()._replace(predict=predict)


def variance_of(belief):
    return Signal(lambda own, seen: variance(seen), "its own", belief)


@jax.jit
def experience():
    obs, num = jax.random.normal(jax.random.key(5), (64, OBS)), 64
    flags = jnp.zeros(num, bool)
    rows = Transition(obs, jnp.zeros((num, ACTION)), jnp.zeros(num), obs, flags, flags)
    data = replay.add(replay.init(jax.tree.map(lambda x: x[0], rows), num), rows)
    return Experience(jnp.array([0.5, 1.5]), data, jnp.int32(num), dynamics.init_normalizers(OBS, ACTION), obs[0])


def bent(models, inputs):
    """Models that disagree most where the action is BEST: their gain times 1 - (action - BEST)^2 / 3."""
    height = 1 - (inputs[:, OBS:] - BEST) ** 2 / 3
    return Prediction(models[:, None, None] * jnp.repeat(height, OBS, axis=1)[None])


@pytest.fixture(scope="module")
def climbers():
    """By whether a round starts from a new policy: without a penalty it does, with a heavy one it continues.

    Each as `round(init_key, improve_key) -> (policy, what it does, metrics)`, compiled.
    """
    seen = experience()

    def make(restart):
        settings = {} if restart else {"policy_penalty": 100.0, "normalize_reward": True}
        config = GradientPolicyConfig(
            updates=300, batch_size=32, lr=1e-2, hidden=(8,), restart=restart, **{"policy_penalty": 0.0, **settings}
        )
        behaviour = make_gradient_policy(variance_of(make_belief(bent)), OBS, ACTION, config)

        @jax.jit
        def one_round(init_key, improve_key):
            state, metrics = behaviour.improve(improve_key, behaviour.init(init_key), seen)
            actor = behaviour.actor(state)
            return state.params, behaviour.act(improve_key, actor, seen.normalizers, seen.data.rows.obs), metrics

        return one_round

    return {restart: make(restart) for restart in (True, False)}


def test_ascent_finds_the_best_action_and_the_penalty_pulls_it_back(climbers):
    # the reward is 2 (gain spread 0.5)^2 (1 - (a - 0.6)^2 / 3)^2, largest at 0.6; a heavy penalty holds the mean at 0
    for restart, want in ((True, BEST), (False, 0.0)):
        _, action, metrics = climbers[restart](jax.random.key(0), jax.random.key(1))
        np.testing.assert_allclose(action, want, atol=0.1)
    assert float(metrics["saturation"]) < 0.1


def test_a_round_starts_from_a_new_policy_or_continues(climbers):
    # from two policies, with the same draws: the same end, or not
    for restart, one_round in climbers.items():
        ends = [ravel_pytree(one_round(jax.random.key(i), jax.random.key(2))[0])[0] for i in (0, 1)]
        assert np.array_equal(*ends) == restart


def test_refusals():
    chances = variance_of(make_belief(predict)._replace(encoding=dynamics.ONE_HOT))
    with pytest.raises(ValueError, match=r"cannot be differentiated\. Allowed: .*target='delta'"):
        make_gradient_policy(chances, OBS, ACTION)
    with pytest.raises(ValueError, match=r"GradientPolicyConfig\.horizon=0 .*1 or more"):
        GradientPolicyConfig(horizon=0)
    with pytest.raises(ValueError, match=r"method='implicit_grad' takes .*numbers.*one of 2 choices.*Allowed: "):
        make_explorer(METHODS["implicit_grad"], Sizes(3, 2, discrete=True), ExplorationConfig())
