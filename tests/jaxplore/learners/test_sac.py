"""SAC on targets worked by hand, against a reference written out, and on probes whose values are known."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, stats

from jaxplore.config import TASK_SAC
from jaxplore.learners.sac import SACConfig, action_values, make_networks, make_sac
from jaxplore.networks import GaussianParams, apply, sample_tanh_gaussian
from jaxplore.types import Transition
from tests.jaxplore import probes


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def zeros(sac):
    """The state of a learner with every number 0: its shapes, without the price of compiling `init`."""
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(sac.init, jax.random.key(0)))


def mlp(params, x, xp=jnp):
    """A leaky-ReLU network with two hidden layers, written out; with `xp=np` in NumPy."""
    for name in ("hidden_0", "hidden_1"):
        x = x @ params[name]["kernel"] + params[name]["bias"][None]
        x = xp.where(x > 0, x, 0.01 * x)
    return x @ params["output"]["kernel"] + params["output"]["bias"][None]


def q_value(params, obs, action, member, xp=jnp):
    one = jax.tree.map(lambda leaf: leaf[member], params["q"])
    return mlp(one, xp.concatenate([obs, action], axis=1), xp)[:, 0]


def constant_networks(sac, q, v, target_v, mean=0.0, head=0.0):
    """Networks that say the same everywhere: zero kernels, and these numbers as the last biases."""
    state = zeros(sac)
    state.params["q"]["output"]["bias"][:] = np.array(q)[:, None]
    state.params["v"]["output"]["bias"][:] = v
    state.params["policy"]["mlp"]["output"]["bias"][:] = mean, head
    state.target_v["output"]["bias"][:] = target_v
    return state


def test_targets_of_one_transition():
    # by hand: Q's target is 5 r + 0.9 V'(next) unless terminated (a time limit still has a value); V's target is
    # min(Q) - alpha log pi; losses 0.5 (x - target)^2; policy: alpha log pi - min(Q) + 0.001 (tanh(mean)^2 + log_std^2)
    sac = make_sac(2, 1, SACConfig(hidden=(3, 3), alpha=0.5, discount=0.9, reward_scale=5.0))
    update = jax.jit(sac.update)
    state = constant_networks(sac, q=[2.0, 3.0], v=1.5, target_v=4.0, mean=0.2, head=1.0)
    obs = np.ones((1, 2), np.float32)
    log_std = -20 + 11 * (math.tanh(1.0) + 1)
    params = GaussianParams(np.array([[0.2]], np.float32), np.array([[log_std]], np.float32))
    log_prob = float(jax.jit(sample_tanh_gaussian)(jax.random.key(1), params)[1][0])
    penalty = 1e-3 * (math.tanh(0.2) ** 2 + log_std**2)
    for terminated, truncated in itertools.product((False, True), repeat=2):
        flags = np.array([terminated]), np.array([truncated])
        batch = Transition(obs, 0 * obs[:, :1], np.array([0.7], np.float32), 2 * obs, *flags)
        metrics = update(jax.random.key(1), state, batch)[1]
        q_target = 5 * 0.7 + (0 if terminated else 0.9 * 4.0)
        want = {
            "q": 2.5,
            "entropy": -log_prob,
            "q_loss": 0.5 * ((2 - q_target) ** 2 + (3 - q_target) ** 2),
            "v_loss": 0.5 * (1.5 - (2 - 0.5 * log_prob)) ** 2,
            "policy_loss": 0.5 * log_prob - 2 + penalty,
        }
        assert {name: float(value) for name, value in metrics.items()} == pytest.approx(want, rel=1e-4)


def adam_step(params, gradient, moments, step, lr, clip):
    """Adam (Kingma & Ba 2015, algorithm 1) on clipped gradients; `moments` is `(m, v)`."""
    clipped = jax.tree.map(lambda g: jnp.clip(g, -clip, clip), gradient)
    m = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, moments[0], clipped)
    v = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, moments[1], clipped)
    m_hat = jax.tree.map(lambda m: m / (1 - 0.9**step), m)
    v_hat = jax.tree.map(lambda v: v / (1 - 0.999**step), v)
    return jax.tree.map(lambda p, m, v: p - lr * m / (jnp.sqrt(v) + 1e-8), params, m_hat, v_hat), (m, v)


def test_update_is_three_adams_in_the_order_of_nnaisense_max(x64):
    # pipeline.md 1.4 written out in float64: a policy step, a Q step and a V step, each with its own Adam and gradient
    # clipped to +-0.02, on one fresh action; then the slow network. Three updates in a row
    config = SACConfig(hidden=(5, 4), alpha=0.3, lr=3e-3, tau=0.1, grad_clip=0.02, reward_scale=2.0, discount=0.8)
    sac = make_sac(3, 2, config)
    rng = np.random.default_rng(0)
    state = jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, zeros(sac))
    draw = lambda leaf: 0.5 * rng.normal(size=leaf.shape)  # noqa: E731
    state = state.replace(params=jax.tree.map(draw, state.params), target_v=jax.tree.map(draw, state.target_v))

    def heads(policy, obs):
        mean, head = jnp.split(mlp(policy["mlp"], obs), 2, axis=1)
        return mean, -20 + 11 * (jnp.tanh(head) + 1)

    def reference(params, target, moments, step, batch, eps):
        obs, action, reward, next_obs, ends, _ = batch

        def soft(policy, q):
            mean, log_std = heads(policy, obs)
            u = mean + jnp.exp(log_std) * eps
            gaussian = -0.5 * eps**2 - log_std - 0.5 * math.log(2 * math.pi)
            q_min = jnp.minimum(*(q_value({"q": q}, obs, jnp.tanh(u), k) for k in (0, 1)))
            penalty = 1e-3 * jnp.mean(jnp.tanh(mean) ** 2) + 1e-3 * jnp.mean(log_std**2)
            return q_min, jnp.sum(gaussian - jnp.log(1 - jnp.tanh(u) ** 2), axis=1), penalty

        q_min, log_prob, _ = soft(params["policy"], params["q"])
        q_target = 2 * reward + 0.8 * jnp.where(ends, 0.0, mlp(target, next_obs)[:, 0])

        def policy_loss(policy):
            q_min, log_prob, penalty = soft(policy, params["q"])
            return jnp.mean(0.3 * log_prob - q_min) + penalty

        losses = {
            "policy": policy_loss,
            "q": lambda q: sum(0.5 * jnp.mean((q_value({"q": q}, obs, action, k) - q_target) ** 2) for k in (0, 1)),
            "v": lambda v: 0.5 * jnp.mean((mlp(v, obs)[:, 0] - (q_min - 0.3 * log_prob)) ** 2),
        }
        gradients = {name: jax.grad(losses[name])(params[name]) for name in losses}
        stepped = {n: adam_step(params[n], gradients[n], moments[n], step, 3e-3, 0.02) for n in losses}
        params = {name: new for name, (new, _) in stepped.items()}
        target = jax.tree.map(lambda slow, new: 0.9 * slow + 0.1 * new, target, params["v"])
        return params, target, {name: new for name, (_, new) in stepped.items()}, gradients

    def noise(key, policy, obs):
        """The normal draws of this key, from the action that the library draws with it."""
        mean, log_std = heads(policy, obs)
        action = sample_tanh_gaussian(key, GaussianParams(mean, log_std))[0]
        return (jnp.arctanh(action) - mean) / jnp.exp(log_std)

    params, target = state.params, state.target_v
    moments = {name: (jax.tree.map(np.zeros_like, params[name]),) * 2 for name in params}
    update, reference, noise = jax.jit(sac.update), jax.jit(reference), jax.jit(noise)
    clipped = total = 0
    for i in range(3):
        obs, next_obs, reward = (rng.normal(size=shape) for shape in ((8, 3), (8, 3), 8))
        action, ends = rng.uniform(-1, 1, size=(8, 2)), rng.uniform(size=8) < 0.3
        batch, key = Transition(obs, action, reward, next_obs, ends, ~ends), jax.random.key(10 + i)
        eps = noise(key, params["policy"], obs)
        params, target, moments, gradients = reference(params, target, moments, i + 1.0, batch, eps)
        state, _ = update(key, state, batch)
        clipped += sum(int(np.sum(np.abs(g) > 0.02)) for g in jax.tree.leaves(gradients))
        total += sum(g.size for g in jax.tree.leaves(gradients))
    assert 0.2 < clipped / total < 0.8
    for got, want in ((state.params, params), (state.target_v, target)):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9), got, want)


def test_init_starts_the_slow_network_at_the_value_network():
    # and the two action values differ, with orthogonal kernels and no biases
    state = jax.jit(make_sac(3, 1, SACConfig(hidden=(8, 8))).init)(jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, state.target_v, state.params["v"])
    kernel = np.asarray(state.params["q"]["hidden_1"]["kernel"])
    assert not np.allclose(kernel[0], kernel[1])
    for member in kernel:
        np.testing.assert_allclose(member.T @ member, np.eye(8), atol=1e-5)


def test_value_networks_alone_are_normalised_where_asked():
    # a value is then bounded by its last layer, however far away the action is; the policy stays as it is
    sac = make_sac(3, 2, SACConfig(hidden=(16, 16), batch_size=4, layer_norm=True))
    state = sac.init(jax.random.key(0))
    assert [name for name in state.params["q"] if "norm" in name] == ["norm_0", "norm_1"]
    assert "norm_0" in state.params["v"] and "norm_0" not in state.params["policy"]["mlp"]
    networks = make_networks(3, 2, SACConfig(hidden=(16, 16), layer_norm=True))
    near, far = (action_values(networks, state.params["q"], jnp.zeros((1, 3)), jnp.full((1, 2), x)) for x in (1e2, 1e6))
    np.testing.assert_allclose(near, far, rtol=1e-2)


def test_actions_are_the_policys():
    # greedy: tanh(mean); drawn: median tanh(mean), and P(a < tanh(mean + std)) = 0.841 (4,000 draws: +-0.018)
    sac = make_sac(2, 1, SACConfig(hidden=(3, 3), log_std_min=-2.0, log_std_max=0.0))
    actor = sac.actor(constant_networks(sac, [0.0, 0.0], 0.0, 0.0, mean=0.4))
    greedy = jax.jit(sac.act_greedily)(actor, np.ones(2, np.float32))
    assert float(greedy[0]) == pytest.approx(math.tanh(0.4), rel=1e-6)
    actions = np.asarray(jax.jit(sac.act)(jax.random.key(1), actor, np.ones((4000, 2), np.float32)))
    assert actions.shape == (4000, 1)
    assert np.mean(actions < math.tanh(0.4)) == pytest.approx(0.5, abs=0.03)
    assert np.mean(actions < math.tanh(0.4 + math.exp(-1))) == pytest.approx(stats.norm.cdf(1), abs=0.02)


def test_a_clipped_head_is_the_log_standard_deviation():
    # the task's SAC starts at a standard deviation of 1, where nnaisense/max's map starts in the middle of its bounds
    for config, want in ((TASK_SAC, 0.0), (SACConfig(), -9.0)):
        networks = make_networks(5, 2, config)
        params = networks.policy.init(jax.random.key(0), jnp.zeros(5))["params"]
        obs = jax.random.normal(jax.random.key(1), (1_000, 5))
        assert float(jnp.mean(apply(networks.policy, params, obs).log_std)) == pytest.approx(want, abs=0.25)
    sac = make_sac(2, 1, SACConfig(hidden=(3, 3), log_std_map="clip", log_std_min=-2.0, log_std_max=1.0))
    networks = make_networks(2, 1, SACConfig(hidden=(3, 3), log_std_map="clip", log_std_min=-2.0, log_std_max=1.0))
    for head, want in ((-7.0, -2.0), (-0.5, -0.5), (4.0, 1.0)):
        actor = sac.actor(constant_networks(sac, [0.0, 0.0], 0.0, 0.0, head=head))
        assert float(apply(networks.policy, actor, jnp.zeros(2)).log_std[0]) == pytest.approx(want)


def train(names, steps, starts=None, **settings):
    """SAC on batches from each probe, side by side in one program: `(sac, states, metrics)`, lists.

    With a learned entropy weight, `starts` are the weights at the start.
    """
    shared = {"hidden": (32, 32), "lr": 3e-3, "tau": 0.05, "policy_penalty": 0.0, "log_std_min": -5.0, "init": "lecun"}
    sac = make_sac(1, 1, SACConfig(**shared, **settings))

    def learn(rows, start=None):
        first = sac.init(jax.random.key(0))
        if start is not None:
            first = first.replace(params={**first.params, "log_alpha": jnp.log(start)})
        step = lambda state, scanned: sac.update(scanned[0], state, scanned[1])  # noqa: E731
        return jax.lax.scan(step, first, (jax.random.split(jax.random.key(1), steps), rows))

    more = () if starts is None else (jnp.array(starts),)
    learned = probes.train_on_each([probes.PROBES[name] for name in names], learn, steps, *more)
    return sac, *(list(part) for part in zip(*learned, strict=True))


@pytest.fixture(scope="module")
def trained():
    """On every probe with a discount of 0.5; alpha is so small that the entropy is worth at most 0.01."""
    sac, states, _ = train(list(probes.PROBES), steps=2000, alpha=1e-3, discount=0.5)
    return sac, dict(zip(probes.PROBES, states, strict=True))


def values(state, obs, action=0.0):
    """`(Q of each member, V)` at one observation."""
    obs, action = np.array([[obs]]), np.array([[action]])
    both = [float(q_value(state.params, obs, action, k, np)[0]) for k in (0, 1)]
    return [*both, float(mlp(state.params["v"], obs, np)[0, 0])]


@pytest.mark.parametrize(
    ("probe", "want"),
    [
        ("constant", {0.0: 1.0}),
        ("predictable", {-1.0: -1.0, 1.0: 1.0}),
        ("two_steps", {-1.0: 0.5, 1.0: 1.0}),
        ("endless", {0.0: 2.0}),
    ],
)
def test_values_of_the_probes(trained, probe, want):
    # see probes.py
    for obs, value in want.items():
        np.testing.assert_allclose(values(trained[1][probe], obs), value, atol=0.05)


def test_policy_finds_the_best_action(trained):
    # reward -(action - obs / 2)^2: the best action is obs / 2, worth 0; at -obs it is -(3/2)^2
    sac, state = trained[0], trained[1]["target_action"]
    act = jax.jit(sac.act_greedily)
    for obs in (-1.0, 1.0):
        assert float(act(sac.actor(state), np.array([obs], np.float32))[0]) == pytest.approx(obs / 2, abs=0.05)
        np.testing.assert_allclose(values(state, obs, obs / 2), 0.0, atol=0.05)
        np.testing.assert_allclose(values(state, obs, -obs)[:2], -2.25, atol=0.15)


def test_entropy_is_worth_alpha_per_nat():
    # where reward says nothing, V = r + alpha * the largest entropy that a squashed Gaussian has, by quadrature (0.68
    # of the uniform's log 2 = 0.69), and the policy's std is the one that has it
    def negative_entropy(log_std):
        def integrand(u):
            return stats.norm.pdf(u, 0, math.exp(log_std)) * (2 * (math.log(2) - u - np.logaddexp(0, -2 * u)))

        squash = integrate.quad(integrand, -12, 12, limit=200)[0]
        return -(log_std + 0.5 * math.log(2 * math.pi * math.e) + squash)

    best = optimize.minimize_scalar(negative_entropy, bounds=(-2, 1), method="bounded")
    _, (state,), (metrics,) = train(["constant"], steps=2000, alpha=2.0)
    q_0, q_1, v = values(state, 0.0)
    np.testing.assert_allclose([q_0, q_1], 1.0, atol=0.05)
    assert v == pytest.approx(1 - 2 * best.fun, abs=0.06)
    assert np.mean(metrics["entropy"][-500:]) == pytest.approx(-best.fun, abs=0.02)


def test_a_learned_entropy_weight_settles_where_the_entropy_is_the_target():
    # reward -(a - obs / 2)^2: the policy of weight alpha is close to a Gaussian of variance alpha / 2, with entropy
    # log(pi e alpha) / 2 nats; it is -1 at alpha = exp(-3) / pi = 0.016, from above and from below
    starts = (0.5, 1e-3)
    _, _, metrics = train(["target_action"] * 2, steps=2500, starts=starts, learn_alpha=True)
    for start, seen in zip(starts, metrics, strict=True):
        assert seen["alpha"][0] == pytest.approx(start, rel=0.01)
        assert np.mean(seen["entropy"][-500:]) == pytest.approx(-1.0, abs=0.1)
        assert np.mean(seen["alpha"][-500:]) == pytest.approx(math.exp(-3) / math.pi, rel=0.3)


def test_bad_settings_are_refused():
    # field, value and range
    with pytest.raises(ValueError, match=r"SACConfig\.discount=1\.01 .*\[0, 1\]"):
        SACConfig(discount=1.01)
    with pytest.raises(ValueError, match=r"SACConfig\.tau=0\.0 .*\(0, 1\]"):
        SACConfig(tau=0.0)
    with pytest.raises(ValueError, match=r"SACConfig\.log_std_min=3\.0"):
        SACConfig(log_std_min=3.0)
    with pytest.raises(ValueError, match=r"SACConfig\.alpha=0\.0 .*\(0, inf"):
        SACConfig(alpha=0.0, learn_alpha=True)
    with pytest.raises(ValueError, match=r"SACConfig\.target_entropy=1\.0 "):
        SACConfig(target_entropy=1.0)
    with pytest.raises(ValueError, match=r"SACConfig\.log_std_map='clipp' .*Did you mean 'clip'"):
        SACConfig(log_std_map="clipp")
    with pytest.raises(ValueError, match=r"SACConfig\.init='ortogonal' .*Did you mean 'orthogonal'"):
        SACConfig(init="ortogonal")
