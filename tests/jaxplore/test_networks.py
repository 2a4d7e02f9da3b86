"""The tanh-Gaussian policy against numerical integration; the networks' initialisation and bounds."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from jaxplore.networks import MLP, GaussianParams, TanhGaussianPolicy, count_params, sample_tanh_gaussian, tanh_mean


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def density(action, mean, std):
    """Of tanh(mean + std * normal) at `action`, by the change of variables, in NumPy float64."""
    return stats.norm.pdf(np.arctanh(action), mean, std) / (1 - action**2)


def draw(mean, log_std, num, seed=0):
    number = jnp.result_type(float)
    params = GaussianParams(*(np.full((num, np.size(mean)), value, number) for value in (mean, log_std)))
    return jax.device_get(jax.jit(sample_tanh_gaussian)(jax.random.key(seed), params))


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.7, -1.0), (-1.5, -0.3)])
def test_log_prob_is_the_density_of_the_sample(x64, mean, log_std):
    # one dimension: closed form at every draw; and what the draws' density integrates to is the mass between them
    actions, log_probs = draw(mean, log_std, 20_000)
    order = np.argsort(actions[:, 0])
    a, p = actions[order, 0], np.exp(log_probs[order])
    np.testing.assert_allclose(p, density(a, mean, math.exp(log_std)), rtol=1e-7)
    middle = slice(100, -100)
    mass, _ = integrate.quad(density, a[middle][0], a[middle][-1], args=(mean, math.exp(log_std)), limit=200)
    assert integrate.trapezoid(p[middle], a[middle]) == pytest.approx(mass, abs=1e-4)
    assert integrate.quad(density, -1, 1, args=(mean, math.exp(log_std)), limit=200)[0] == pytest.approx(1, abs=1e-6)


def test_entropy_is_the_integral_of_the_density(x64):
    # -int p log p by quadrature against the mean of -log_prob over 40,000 draws (standard error 0.003)
    def integrand(a):
        p = density(a, 0.3, 0.6)
        return -p * np.log(p)

    entropy = integrate.quad(integrand, -1 + 1e-9, 1 - 1e-9, limit=200)[0]
    assert np.mean(-draw(0.3, math.log(0.6), 40_000)[1]) == pytest.approx(entropy, abs=0.015)


def test_entries_of_an_action_are_independent(x64):
    # the log-density of a vector is the sum over its entries
    mean, log_std = np.array([0.2, -0.4, 1.0]), np.array([-0.5, 0.1, -2.0])
    actions, log_probs = draw(mean, log_std, 100)
    want = np.sum(np.log(density(actions, mean, np.exp(log_std))), axis=-1)
    np.testing.assert_allclose(log_probs, want, rtol=1e-7)


@pytest.mark.parametrize(("mean", "log_std"), [(12.0, 2.0), (-40.0, 0.0), (0.0, -20.0)])
def test_saturated_actions_have_a_true_log_prob(mean, log_std):
    # float32, tanh = +-1: log p = log N(u) - 2 (log 2 - u - softplus(-2 u)) at the u that was drawn. The same key draws
    # the same standard normals for N(0, 1), whose u = arctanh(a) can be read off
    eps = np.arctanh(np.clip(draw(0.0, 0.0, 50)[0].astype(float), -1 + 1e-7, 1 - 1e-7))
    keep = np.abs(eps[:, 0]) < 3
    u = mean + math.exp(log_std) * eps
    want = stats.norm.logpdf(eps) - log_std - 2 * (math.log(2) - u - np.logaddexp(0, -2 * u))
    actions, log_probs = draw(mean, log_std, 50)
    np.testing.assert_allclose(log_probs[keep], want[keep, 0], rtol=2e-3, atol=1e-2)
    assert np.all(np.isfinite(log_probs)) and np.all(np.abs(actions) <= 1)
    # d log p / d mean through the sample is 2 tanh(u): the Gaussian's part cancels
    np.testing.assert_allclose(slope_of_the_mean(np.full((4, 1), 30, np.float32)), 2.0, rtol=1e-5)


@jax.jit
@jax.grad
def slope_of_the_mean(mean):
    return jnp.sum(sample_tanh_gaussian(jax.random.key(0), GaussianParams(mean, 0 * mean))[1])


def test_sample_follows_the_gradient_of_its_parameters(x64):
    # reparametrised: da/dmean = 1 - a^2, da/dlog_std = (1 - a^2) (arctanh(a) - mean)
    params = GaussianParams(np.array([0.4]), np.array([-0.7]))
    sample = jax.jit(jax.value_and_grad(lambda params: sample_tanh_gaussian(jax.random.key(3), params)[0][0]))
    action, gradient = jax.device_get(sample(params))
    assert gradient.mean[0] == pytest.approx(1 - action**2, rel=1e-9)
    assert gradient.log_std[0] == pytest.approx((1 - action**2) * (np.arctanh(action) - 0.4), rel=1e-9)


def test_log_std_stays_in_its_bounds():
    # low + (high - low) / 2 (tanh(head) + 1): the middle (-9 for [-20, 2]) at head 0, the ends at +-large
    policy = TanhGaussianPolicy((4,), 1)
    shapes = jax.eval_shape(policy.init, jax.random.key(0), jnp.zeros(2))["params"]
    params, ones = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes), np.ones(2, np.float32)

    def log_std(head):
        params["mlp"]["output"]["bias"][:] = 0.3, head
        out = jax.jit(policy.apply)({"params": params}, ones)
        assert float(tanh_mean(out)[0]) == pytest.approx(math.tanh(0.3), rel=1e-6)
        return float(out.log_std[0])

    assert [log_std(h) for h in (-1e4, 0.0, 1e4)] == [-20.0, -9.0, 2.0]
    assert log_std(0.5) == pytest.approx(-20 + 11 * (math.tanh(0.5) + 1), rel=1e-6)
    policy = TanhGaussianPolicy((4,), 1, log_std_bounds=(-3.0, 1.0))
    assert [log_std(h) for h in (-1e4, 0.0, 1e4)] == [-3.0, -1.0, 1.0]


def test_mlp_is_its_formula():
    # two matrices and a ReLU (leaky: slope 0.01; swish: x sigmoid(x)) in NumPy, for any leading axes
    net = MLP((5,), 2)
    params = jax.device_get(jax.jit(net.init)(jax.random.key(0), np.zeros(3, np.float32)))["params"]
    x = np.random.default_rng(0).normal(size=(4, 6, 3)).astype(np.float32)
    hidden = x @ np.asarray(params["hidden_0"]["kernel"])
    formulas = {
        "relu": np.maximum(hidden, 0),
        "leaky_relu": np.where(hidden > 0, hidden, 0.01 * hidden),
        "swish": hidden / (1 + np.exp(-hidden)),
        "tanh": np.tanh(hidden),
    }
    for name, value in formulas.items():
        got = jax.jit(MLP((5,), 2, activation=name).apply)({"params": params}, x)
        np.testing.assert_allclose(got, value @ np.asarray(params["output"]["kernel"]), rtol=1e-4, atol=1e-5)
    assert count_params(params) == 3 * 5 + 5 + 5 * 2 + 2


@pytest.mark.parametrize(
    ("init", "want"), [("he", 2 / 200), ("lecun", 1 / 200), ("xavier", 2 / 300), ("orthogonal", None)]
)
def test_initialisers_have_the_variance_of_their_name(init, want):
    # He 2 / in, LeCun 1 / in, Xavier 2 / (in + out); orthogonal: columns of length 1 at right angles
    params = jax.jit(MLP((100,), 1, init_name=init).init)(jax.random.key(0), np.zeros(200, np.float32))["params"]
    kernel = np.asarray(params["hidden_0"]["kernel"])
    if want is None:
        np.testing.assert_allclose(kernel.T @ kernel, np.eye(100), atol=1e-5)
    else:
        assert np.var(kernel) == pytest.approx(want, rel=0.05)
    np.testing.assert_array_equal(params["hidden_0"]["bias"], 0.0)


def test_unknown_names_are_refused():
    # with the nearest match
    with pytest.raises(ValueError, match=r"activation='leakyrelu' .*Did you mean 'leaky_relu'"):
        MLP((4,), 1, activation="leakyrelu")
    with pytest.raises(ValueError, match=r"output_init_name='lecunn' .*Did you mean 'lecun'"):
        MLP((4,), 1, output_init_name="lecunn")
