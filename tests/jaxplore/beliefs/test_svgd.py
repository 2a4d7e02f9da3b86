"""Amortised SVGD against double loops, closed forms and the paper's equation 6 (asvgd.md sections 3 and 5)."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxplore.beliefs import svgd
from jaxplore.beliefs.generator import Generator, GeneratorConfig, make_generator
from jaxplore.beliefs.svgd import MIN_BANDWIDTH, SVGDConfig, bandwidth, make_amortized_svgd, squared_distances

stein_direction = jax.jit(svgd.stein_direction, static_argnames="config")


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def kernel_and_gradient(distance: float, difference: np.ndarray, h: float, kind: str) -> tuple[float, np.ndarray]:
    """K(a, b) and its gradient in b, for `difference = a - b` and `distance = |a - b|^2 / K`."""
    towards = 2.0 * difference / difference.size / h
    if kind == "rbf":
        k = math.exp(-distance / h)
        return k, k * towards
    return (1 + distance / h) ** -0.5, 0.5 * (1 + distance / h) ** -1.5 * towards


def double_loop(scores: np.ndarray, values: np.ndarray, kind: str, self_weight: float) -> tuple[np.ndarray, np.ndarray]:
    """asvgd.md 3.1 as it is written, on `scores [M, n]` and `values [M, r]`, in float64."""
    m = len(values)
    pairs = [np.mean((values[i] - values[j]) ** 2) for i, j in itertools.combinations(range(m), 2)]
    h, norm = float(np.median(pairs)), m - 1 + self_weight
    drive, repulsion = np.zeros_like(scores), np.zeros_like(values)
    for i in range(m):
        for j in range(m):
            difference = values[i] - values[j]
            k, gradient = kernel_and_gradient(float(np.mean(difference**2)), difference, h, kind)
            drive[i] += (k if i != j else self_weight) * scores[j] / norm
            repulsion[i] += gradient / norm
    return drive, repulsion


def particles(m: int = 6, n: int = 4, r: int = 5, outputs: int = 3, seed: int = 0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(m, n, outputs)), 3.0 + 0.7 * rng.normal(size=(m, r, outputs))


@pytest.mark.parametrize("self_weight", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("outputs", ["joint", "per_output"])
@pytest.mark.parametrize("kernel", ["rbf", "imq"])
def test_direction_is_the_double_loop(x64, kernel, outputs, self_weight):
    # T1: NumPy float64, i and j in two Python loops; asvgd.md measured 3e-15
    scores, values = particles()
    config = SVGDConfig(kernel=kernel, kernel_outputs=outputs, self_weight=self_weight)
    got = stein_direction(jnp.asarray(scores), jnp.asarray(values), config)
    if outputs == "joint":
        want = double_loop(scores.reshape(6, -1), values.reshape(6, -1), kernel, self_weight)
    else:
        each = [double_loop(scores[..., d], values[..., d], kernel, self_weight) for d in range(3)]
        want = [np.stack(part, axis=-1) for part in zip(*each, strict=True)]
    np.testing.assert_allclose(got.drive, want[0].reshape(scores.shape), rtol=0, atol=1e-12)
    np.testing.assert_allclose(got.repulsion, want[1].reshape(values.shape), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kernel", ["rbf", "imq"])
def test_repulsion_is_the_autodiff_gradient_of_the_kernel(x64, kernel):
    # T1: jax.grad of K with h held constant, summed over j
    scores, values = particles()
    flat = values.reshape(6, -1)
    h = np.median(np.mean((flat[:, None] - flat[None]) ** 2, axis=-1)[np.triu_indices(6, 1)])

    def k(a, b):
        scaled = jnp.mean((a - b) ** 2) / h
        return jnp.exp(-scaled) if kernel == "rbf" else (1 + scaled) ** -0.5

    gradients = jax.jit(jax.vmap(jax.vmap(jax.grad(k, argnums=1), (None, 0)), (0, None)))(flat, flat)
    got = stein_direction(scores, values, SVGDConfig(kernel=kernel)).repulsion
    np.testing.assert_allclose(got, (np.sum(gradients, axis=1) / 6).reshape(values.shape), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kernel", ["rbf", "imq"])
def test_repulsion_pushes_outwards_and_moves_no_mean(x64, kernel):
    # T2: sum_i rep_i = 0 and <rep, F - mean> > 0 (3 of 5 public codes have the other sign)
    scores, values = particles()
    repulsion = np.asarray(stein_direction(scores, values, SVGDConfig(kernel=kernel)).repulsion)
    np.testing.assert_allclose(np.sum(repulsion, axis=0), 0.0, atol=1e-12)
    assert np.sum(repulsion * (values - values.mean(axis=0, keepdims=True))) > 0.1


def test_bandwidth_lets_no_gradient_through(x64):
    # T3: with h differentiated, sum K does not change with scale and the radial part is 0 (-7e-15 against +26)
    flat = particles()[1].reshape(6, -1)
    centred = flat - flat.mean(axis=0, keepdims=True)

    def kernel_sum(values, config):
        distances = squared_distances(values)
        return -jnp.sum(jnp.exp(-distances / bandwidth(distances, config)))

    def leaking(values):
        distances = squared_distances(values)
        return -jnp.sum(jnp.exp(-distances / jnp.median(distances[jnp.triu_indices(6, 1)])))

    radial = np.sum(jax.jit(jax.grad(kernel_sum), static_argnums=1)(flat, SVGDConfig()) * centred)
    repulsion = np.asarray(stein_direction(flat[:, :, None], flat[:, :, None], SVGDConfig()).repulsion)[..., 0]
    # -sum_ij K_ij holds each pair twice, and a particle in both roles: twice m times the repulsion.
    assert radial == pytest.approx(2 * 6 * np.sum(repulsion * centred), rel=1e-12)
    assert abs(np.sum(jax.jit(jax.grad(leaking))(flat) * centred)) < 1e-12 < radial
    gradients = jax.jit(jax.grad(bandwidth), static_argnums=1)
    for rule in ("median_log", "mean"):
        gradient = gradients(np.mean((flat[:, None] - flat[None]) ** 2, axis=-1), SVGDConfig(bandwidth=rule))
        np.testing.assert_array_equal(gradient, 0.0)


def test_bandwidth_rules_on_three_particles(x64):
    # hand: 0, 1 and 3 on a line have squared distances 1, 4, 9: median 4, mean 14/3 (with the diagonal: 1)
    distances, of = squared_distances(np.array([[0.0], [1.0], [3.0]])), jax.jit(bandwidth, static_argnums=1)
    for rule, want in {"median": 4.0, "median_log": 4 / math.log(3), "mean": 14 / 3, "fixed": 1.0}.items():
        for scale in (1.0, 0.5):
            got = of(distances, SVGDConfig(bandwidth=rule, bandwidth_scale=scale))
            assert got == pytest.approx(scale * want, rel=1e-12)


@pytest.mark.parametrize("rule", ["median", "median_log", "mean", "fixed"])
@pytest.mark.parametrize("self_weight", [0.0, 1.0])
def test_one_particle_follows_its_own_score(self_weight, rule):
    # T4: m = 1 is gradient ascent on the log-likelihood, whatever l
    scores, values = jnp.array([[[2.0, -1.0]]]), jnp.array([[[5.0, 6.0]]])
    direction = stein_direction(scores, values, SVGDConfig(num_particles=1, self_weight=self_weight, bandwidth=rule))
    np.testing.assert_array_equal(direction.drive, scores)
    np.testing.assert_array_equal(direction.repulsion, 0.0)


@pytest.mark.parametrize("self_weight", [0.0, 1.0])
@pytest.mark.parametrize("m", [2, 3, 5])
def test_identical_particles_share_the_mean_score(m, self_weight):
    # T4: K = 1 everywhere, so the drive is the mean score (of the others, with l = 0) and nothing repels
    scores = jnp.arange(2.0 * m).reshape(m, 2, 1)
    direction = stein_direction(scores, jnp.full((m, 2, 1), 3.0), SVGDConfig(self_weight=self_weight))
    others = (jnp.sum(scores, axis=0, keepdims=True) - (1 - self_weight) * scores) / (m - 1 + self_weight)
    np.testing.assert_allclose(direction.drive, others, rtol=1e-6)
    np.testing.assert_array_equal(direction.repulsion, 0.0)
    assert direction.bandwidth == pytest.approx(MIN_BANDWIDTH)


@pytest.mark.parametrize("m", [2, 3])
def test_two_and_three_particles_have_an_off_diagonal_median(m):
    # T4: with the diagonal in the median, h is 0 at m = 2 (torch) and the direction NaN; by hand K_12 = 1/e at m = 2
    values = jnp.arange(float(m))[:, None, None]
    direction = stein_direction(jnp.zeros_like(values), values, SVGDConfig(num_particles=m))
    assert direction.bandwidth == pytest.approx(1.0)
    # RBF at distances 1 (h = 1), and 2 for the outer pair of three: (1/m) sum_j 2 (v_i - v_j) K_ij
    want = {2: 2 * math.exp(-1) / 2, 3: (2 * math.exp(-1) + 4 * math.exp(-4)) / 3}[m]
    assert direction.repulsion[-1, 0, 0] == pytest.approx(want, rel=1e-5)
    assert direction.repulsion[0, 0, 0] == pytest.approx(-want, rel=1e-5)


def settle(particles: np.ndarray, mean: float, std: float, config: SVGDConfig, step: float, steps: int) -> jax.Array:
    """Free particles `[M, D]` that follow `drive + repulsion` towards N(mean, std^2 I)."""

    def move(x, _):
        direction = svgd.stein_direction((mean - x)[:, None] / std**2, x[:, None], config)
        return x + step * std**2 * (direction.drive + direction.repulsion)[:, 0], None

    return jax.device_get(jax.jit(lambda x: jax.lax.scan(move, x, length=steps)[0])(particles))


@pytest.mark.parametrize("std", [0.1, 3.0])
@pytest.mark.parametrize(
    ("rule", "scale", "want"),
    [
        ("median", 1.0, 1 / (math.e - 1)),  # 0.581976707
        ("median_log", 1.0, math.log(2)),  # 0.693147181
        ("median", 1 / math.log(3), math.log(3) / 2),  # over log(m + 1): 0.549306144
    ],
)
def test_two_particles_settle_at_the_closed_form_variance(x64, rule, scale, want, std):
    # T5: variance (ddof 0) over s^2 along the line through two particles, in any dimension
    config = SVGDConfig(num_particles=2, bandwidth=rule, bandwidth_scale=scale)
    start = np.random.default_rng(0).normal(size=(2, 3)) * std
    end = settle(start, 1.5, std, config, step=0.3, steps=500)
    assert np.sum(np.var(end, axis=0)) / std**2 == pytest.approx(want, abs=1e-6)
    np.testing.assert_allclose(end.mean(axis=0), 1.5, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "want"),
    [
        ({}, 4.07384),
        ({"bandwidth": "median_log"}, 2.07944),
        ({"bandwidth_scale": 4.0}, 6.16142),
        ({"kernel": "imq"}, 4.22487),
    ],
)
def test_eight_particles_settle_in_a_simplex(x64, settings, want):
    # T6: trace of the covariance for m = 8 in D = 16 >= m - 1: 7 x / (e^x - 1), x = 1, log 8, 1/4; IMQ: asvgd.md 3.2
    start = np.random.default_rng(1).normal(size=(8, 16))
    end = settle(start, 0.0, 1.0, SVGDConfig(num_particles=8, **settings), step=0.5, steps=4000)
    assert np.sum(np.var(end, axis=0)) == pytest.approx(want, abs=1e-4)
    pairs = np.mean((end[:, None] - end[None]) ** 2, axis=-1)[np.triu_indices(8, 1)]
    np.testing.assert_allclose(pairs, np.mean(pairs), rtol=1e-3)


@pytest.mark.parametrize("rule", ["median", "mean"])
def test_mean_and_sum_of_squared_distances_give_the_same_step(x64, rule):
    # T7: a constant factor on the distance cancels between K and its gradient when h follows the distances
    scores, values = particles()
    flat, s = values.reshape(6, -1), scores.reshape(6, -1)
    sums = np.sum((flat[:, None] - flat[None]) ** 2, axis=-1)
    h = getattr(np, rule)(sums[np.triu_indices(6, 1)])
    k = np.exp(-sums / h)
    repulsion = np.stack([np.sum(k[i][:, None] * 2 * (flat[i] - flat) / h, axis=0) for i in range(6)]) / 6
    got = stein_direction(jnp.asarray(scores), jnp.asarray(values), SVGDConfig(bandwidth=rule))
    np.testing.assert_allclose(got.repulsion, repulsion.reshape(values.shape), rtol=0, atol=1e-12)
    np.testing.assert_allclose(got.drive, (k @ s / 6).reshape(scores.shape), rtol=0, atol=1e-12)


def test_distances_keep_float32_digits_off_the_origin():
    # T14: spread 1e-3 on offset 3, within 1e-4 of float64 (measured 5e-6; uncentred |a|^2 + |b|^2 - 2ab: 3.1)
    values = (3.0 + 1e-3 * np.random.default_rng(0).normal(size=(8, 50))).astype(np.float32)
    exact = np.mean((values[:, None].astype(float) - values[None].astype(float)) ** 2, axis=-1)
    pairs = np.triu_indices(8, 1)
    got = np.asarray(squared_distances(jnp.asarray(values)))
    np.testing.assert_allclose(got[pairs], exact[pairs], rtol=1e-4)
    np.testing.assert_array_equal(np.diagonal(got), 0.0)


# The update, on a generator small enough to write out: theta = eta["w"] z + eta["b"], f(x) = theta_1 tanh(theta_0 x).

TINY = Generator(
    init=lambda key: {"w": jnp.array([[0.5, -0.3], [0.8, 0.4]]), "b": jnp.array([0.7, 0.9])},
    sample_noise=lambda key, num: jax.random.normal(key, (num, 2)),
    generate=lambda eta, z: {"theta": eta["w"] @ z + eta["b"]},
    sample=lambda eta, zs: {"theta": zs @ eta["w"].T + eta["b"][None]},
)


def tiny_apply(params, inputs):
    return params["theta"][1] * jnp.tanh(params["theta"][0] * inputs)


def tiny_values(eta: np.ndarray, zs: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The same in NumPy, for `eta = [w, b]` laid flat, real or complex: `[M, n]`."""
    theta = zs @ eta[:4].reshape(2, 2).T + eta[4:]
    return theta[:, 1:] * np.tanh(theta[:, :1] * x[None])


def tiny_move(eta: np.ndarray, zs: np.ndarray, x: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """`sum_i J_i^T phi_i`, with the Jacobian by complex steps: exact to the last digit."""
    steps = 1e-30j * np.eye(6)
    jacobian = np.stack([tiny_values(eta + step, zs, x).imag / 1e-30 for step in steps])
    return np.einsum("emn,mn->e", jacobian, phi)


def one_step(config, x, y, num_data, optimizer=None, **kwargs):
    """Flat eta after one update, the start, and the noise it used."""
    posterior = make_amortized_svgd(TINY, tiny_apply, 1, optimizer or optax.sgd(1.0), config, **kwargs)
    state = jax.jit(posterior.init)(jax.random.key(0))
    new, metrics = jax.jit(posterior.update)(jax.random.key(1), state, x[:, None], y[:, None], num_data)
    flat = [np.concatenate([np.ravel(s.eta["w"]), s.eta["b"]]) for s in (state, new)]
    return flat[0], flat[1], np.asarray(new.z), metrics


def test_defaults_are_equation_6_of_the_paper(x64):
    # the paper as printed: (1/m) sum_l [-k_li grad L(F_l) + grad k_li], L = sum |y - f|^2, d = mean_x |f_i - f_j|^2,
    # h = median; eta moves along sum_i J_i^T phi_i, here over m N (powers of 2: exact in float32, as num_data is)
    m, n = 4, 8
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=n), rng.normal(size=n)
    eta, new, zs, _ = one_step(SVGDConfig(num_particles=m), x, y, num_data=n)
    values = tiny_values(eta, zs, x)
    distances = np.mean((values[:, None] - values[None]) ** 2, axis=-1)
    h = np.median(distances[np.triu_indices(m, 1)])
    phi = np.zeros_like(values)
    for i in range(m):
        for l in range(m):  # noqa: E741 (the paper's index)
            k = math.exp(-distances[l, i] / h)
            phi[i] += (k * 2 * (y - values[l]) + k * 2 * (values[i] - values[l]) / (n * h)) / m
    np.testing.assert_allclose(new - eta, tiny_move(eta, zs, x, phi) / (m * n), rtol=1e-11, atol=1e-14)


def test_minibatch_and_temperature_scale_the_score(x64):
    # asvgd.md 3.1: score (N/n)(y - F) / sigma^2 / T, step T / (m N); l = 0.3, batch of 7 out of N = 70
    m, n, total, temperature, std = 5, 7, 70, 2.5, 0.3
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=n), rng.normal(size=n)
    settings = {"num_particles": m, "self_weight": 0.3, "likelihood_std": std}
    eta, new, zs, _ = one_step(SVGDConfig(**settings, temperature=temperature), x, y, num_data=total)
    values = tiny_values(eta, zs, x)
    scores = total / n * (y - values) / std**2 / temperature
    drive, repulsion = double_loop(scores, values, "rbf", 0.3)
    want = temperature / (m * total) * tiny_move(eta, zs, x, drive + repulsion)
    np.testing.assert_allclose(new - eta, want, rtol=1e-6, atol=1e-12)
    per_datum = SVGDConfig(**settings, temperature=temperature / total, tempering="per_datum")
    np.testing.assert_allclose(one_step(per_datum, x, y, num_data=total)[1], new, rtol=1e-6)


def test_weight_prior_adds_its_kernel_averaged_score(x64):
    # asvgd.md 3.1: prior_i = [sum_{j != i} K_ij (-theta_j / s^2) + l (-theta_i / s^2)] / (m - 1 + l); theta has one
    # axis, so s is prior_bias_std
    m, n = 4, 6
    x = np.linspace(-1.0, 1.0, n)
    config = SVGDConfig(num_particles=m, self_weight=0.3)
    eta, flat, zs, _ = one_step(config, x, x, n)
    prior = SVGDConfig(num_particles=m, self_weight=0.3, prior="weights", prior_bias_std=0.5)
    with_prior = one_step(prior, x, x, n)[1]
    theta = zs @ eta[:4].reshape(2, 2).T + eta[4:]
    move, _ = double_loop(-theta / 0.5**2, tiny_values(eta, zs, x), "rbf", 0.3)
    want = np.concatenate([np.ravel(np.einsum("mi,mj->ij", move, zs)), move.sum(axis=0)]) / (m * n)
    np.testing.assert_allclose(with_prior - flat, want, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("tempering", ["constant", "per_datum"])
def test_with_batches_of_their_own_networks_follow_their_own_scores(x64, tempering):
    # the gradient of the mean over networks and batch of w (y - f)^2 / (2 sigma^2), by complex steps, less that of the
    # weight prior over N data, or over one where T is for one
    m, n, total, temperature, std = 3, 4, 40, 2.5, 0.3
    rng = np.random.default_rng(0)
    x, y, weights = rng.normal(size=(m, n)), rng.normal(size=(m, n)), rng.integers(0, 3, size=(m, n)).astype(float)
    settings = {"batches": "own", "likelihood_std": std, "temperature": temperature, "tempering": tempering}
    for prior in ("flat", "weights"):
        config = SVGDConfig(num_particles=m, prior=prior, prior_bias_std=0.5, **settings)
        posterior = make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(1.0), config)
        state = jax.jit(posterior.init)(jax.random.key(0))
        given = x[..., None], y[..., None], total, None, weights
        new, metrics = jax.jit(posterior.update)(jax.random.key(1), state, *given)
        eta, after = (np.concatenate([np.ravel(one.eta["w"]), one.eta["b"]]) for one in (state, new))
        zs, want = np.asarray(new.z), np.zeros(6)
        residuals = np.zeros((m, n))
        for i in range(m):
            residuals[i] = y[i] - tiny_values(eta, zs[i : i + 1], x[i])[0]
            want += tiny_move(eta, zs[i : i + 1], x[i], (weights[i] * residuals[i])[None] / std**2) / (m * n)
        if prior == "weights":
            move = -(zs @ eta[:4].reshape(2, 2).T + eta[4:]) / 0.5**2
            flat = np.concatenate([np.ravel(np.einsum("mi,mj->ij", move, zs)), move.sum(axis=0)])
            want += temperature / m / (1 if tempering == "per_datum" else total) * flat
        np.testing.assert_allclose(after - eta, want, rtol=1e-6, atol=1e-12)
        assert float(metrics["loss"]) == pytest.approx(np.mean(residuals**2), rel=1e-6)


def test_weights_scale_the_scores_of_a_shared_batch(x64):
    # data that count twice, once and not at all are those in a batch with the first one doubled, but for N / n
    x, y = np.array([0.5, -1.0, 2.0]), np.array([1.0, 0.3, -0.4])
    posterior = make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(1.0), SVGDConfig(num_particles=1))
    state, update = jax.jit(posterior.init)(jax.random.key(0)), jax.jit(posterior.update)
    weighted, _ = update(jax.random.key(1), state, x[:, None], y[:, None], 3, None, np.array([2.0, 1.0, 0.0]))
    doubled, _ = update(jax.random.key(1), state, x[[0, 0, 1], None], y[[0, 0, 1], None], 3)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), weighted.eta, doubled.eta)


def test_gp_prior_adds_its_kernel_averaged_score(x64):
    # -K^-1 f with K = a^2 exp(-d^2 / (2 l^2)) + 1e-4 a^2 I, solved by NumPy
    m, n, amplitude, scale = 4, 6, 2.0, 0.4
    x = np.linspace(-1.0, 1.0, n)
    eta, flat, zs, _ = one_step(SVGDConfig(num_particles=m), x, x, n)
    prior = SVGDConfig(num_particles=m, prior="gp", prior_scale=amplitude, prior_lengthscale=scale)
    with_prior = one_step(prior, x, x, n)[1]
    values = tiny_values(eta, zs, x)
    covariance = amplitude**2 * (np.exp(-0.5 * (x[:, None] - x[None]) ** 2 / scale**2) + 1e-4 * np.eye(n))
    move, _ = double_loop(-np.linalg.solve(covariance, values.T).T, values, "rbf", 1.0)
    np.testing.assert_allclose(with_prior - flat, tiny_move(eta, zs, x, move) / (m * n), rtol=1e-5, atol=1e-10)


@pytest.mark.parametrize("self_weight", [0.0, 1.0])
def test_without_residuals_a_step_spreads_the_networks(x64, self_weight):
    # T2: zero score (targets are out of the batch's reach: sigma is huge), so a descent step must widen the networks
    x = np.linspace(0.5, 1.5, 6)
    config = SVGDConfig(num_particles=8, likelihood_std=1e6, self_weight=self_weight)
    eta, new, zs, metrics = one_step(config, x, 0 * x, 6, optax.sgd(0.1))
    before, after = (tiny_values(e, zs, x).var(axis=0).mean() for e in (eta, new))
    assert metrics["variance"] == pytest.approx(before, rel=1e-10)
    assert after > before * 1.0001


def test_independent_points_take_the_repulsion_and_the_batch_the_score(x64):
    # asvgd.md 3.1 with R another batch: drive on B with the kernel of R, repulsion on R
    m, n = 5, 4
    rng = np.random.default_rng(0)
    x, y, r = rng.normal(size=n), rng.normal(size=n), rng.normal(size=n)
    config = SVGDConfig(num_particles=m, repulsion_points="independent", likelihood_std=1.0)
    posterior = make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(1.0), config)
    state = jax.jit(posterior.init)(jax.random.key(0))
    columns = [a[:, None] for a in (x, y, r)]
    new, _ = jax.jit(posterior.update)(jax.random.key(1), state, *columns[:2], n, columns[2])
    eta, end = (np.concatenate([np.ravel(s.eta["w"]), s.eta["b"]]) for s in (state, new))
    zs = np.asarray(new.z)
    drive, repulsion = double_loop(y - tiny_values(eta, zs, x), tiny_values(eta, zs, r), "rbf", 1.0)
    want = (tiny_move(eta, zs, x, drive) + tiny_move(eta, zs, r, repulsion)) / (m * n)
    np.testing.assert_allclose(end - eta, want, rtol=1e-6, atol=1e-12)
    with pytest.raises(ValueError, match="extra_inputs"):
        posterior.update(jax.random.key(1), state, *columns[:2], n)


@pytest.mark.parametrize("points", ["perturbed", "uniform", "own"])
def test_further_points_join_the_batch(x64, points):
    # with repulsion points R = B + extra, the values of `repulsion_variance` are those on R, not on B
    x = np.linspace(-0.1, 0.1, 6)
    own = (lambda key, inputs: jnp.full((3, 1), 2.0)) if points == "own" else None
    settings = {} if points == "own" else {"repulsion_points": points}
    config = SVGDConfig(num_particles=8, prior="weights", repulsion_scale=2.0, num_repulsion_points=5, **settings)
    eta, _, zs, metrics = one_step(config, x, x, 6, repulsion_inputs=own)
    key = jax.random.split(jax.random.key(1))[1]
    extra = {
        "perturbed": lambda: x + 2.0 * np.asarray(jax.random.normal(key, (6, 1)))[:, 0],
        "uniform": lambda: np.asarray(jax.random.uniform(key, (5, 1), minval=-2.0, maxval=2.0))[:, 0],
        "own": lambda: np.full(3, 2.0),
    }[points]()
    variance = tiny_values(eta, zs, np.concatenate([x, extra])).var(axis=0).mean()
    assert metrics["repulsion_variance"] == pytest.approx(variance, rel=1e-10)
    assert metrics["variance"] == pytest.approx(tiny_values(eta, zs, x).var(axis=0).mean(), rel=1e-10)


def test_noise_is_redrawn_or_kept():
    # `fixed` keeps the z of init for good; `every_step` never uses the same z twice
    x, key = np.linspace(-1.0, 1.0, 6, dtype=np.float32)[:, None], jax.random.key(0)
    for redraw in ("fixed", "every_step"):
        posterior = make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(0.1), SVGDConfig(num_particles=4, redraw=redraw))
        first, update = jax.jit(posterior.init)(key), jax.jit(posterior.update)
        second, _ = update(jax.random.key(1), first, x, x, 6)
        third, _ = update(jax.random.key(2), second, x, x, 6)
        same = [bool(np.any(np.asarray(a.z) == np.asarray(b.z))) for a, b in ((first, second), (second, third))]
        assert same == [redraw == "fixed"] * 2


def test_guards():
    # T12: what diverges is refused, what has no posterior is announced
    with pytest.raises(ValueError, match=r"self_weight=0\.1 diverges with redraw='fixed'"):
        SVGDConfig(self_weight=0.1, redraw="fixed")
    with pytest.raises(ValueError, match=r"SVGDConfig\.self_weight=1\.5 .*\[0, 1\]"):
        SVGDConfig(self_weight=1.5)
    with pytest.raises(ValueError, match=r"SVGDConfig\.kernel='rbff' .*Did you mean 'rbf'"):
        SVGDConfig(kernel="rbff")
    with pytest.raises(ValueError, match=r"SVGDConfig\.likelihood_std=0"):
        SVGDConfig(likelihood_std=0.0)
    with pytest.raises(ValueError, match=r"SVGDConfig\.num_particles=0"):
        SVGDConfig(num_particles=0)
    with pytest.raises(
        ValueError, match=r"batches='own' leaves networks no points in common.*repulsion_points='batch'"
    ):
        SVGDConfig(batches="own", repulsion_points="perturbed")
    with pytest.raises(ValueError, match=r"batches='own' leaves networks no points in common"):
        SVGDConfig(batches="own", prior="gp")
    for points in ("perturbed", "uniform"):
        with pytest.warns(UserWarning, match="variance grows without bound"):
            make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(1.0), SVGDConfig(repulsion_points=points))
    with pytest.warns(UserWarning, match="variance grows without bound"):
        make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(1.0), repulsion_inputs=lambda key, inputs: inputs)
    # Warnings are errors here: these have a prior, or no points beyond the data, or are to be let through.
    make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(1.0), SVGDConfig(repulsion_points="uniform", prior="gp"))
    make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(1.0), SVGDConfig(repulsion_points="independent"))
    accepted = SVGDConfig(repulsion_points="uniform", accept_improper=True)
    make_amortized_svgd(TINY, tiny_apply, 1, optax.sgd(1.0), accepted)


@pytest.mark.parametrize("rule", ["median", "median_log", "mean"])
def test_bandwidth_has_a_floor_in_float32(rule):
    # T12: particles 1e-5 apart have a squared distance of 1e-10 < 1e-6; K is then 1 - 1e-4, not exp(-1) or NaN
    values = jnp.array([[[1.0]], [[1.0 + 1e-5]]], jnp.float32)
    direction = stein_direction(jnp.zeros_like(values), values, SVGDConfig(bandwidth=rule))
    assert direction.bandwidth == pytest.approx(MIN_BANDWIDTH)
    assert direction.kernel_mean == pytest.approx(1 - 1e-4, abs=2e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_data": 0}, r"num_data=0 is out of range\. Allowed: 1 or more"),
        (
            {"inputs": np.zeros((0, 2)), "targets": np.zeros((0, 1))},
            r"inputs=\(0, 2\) is their .*B of 1 or more",
        ),
        ({"targets": np.zeros((5, 2))}, r"targets=\(5, 2\) is their shape\. Allowed: shape \(5, 1\)"),
        ({"targets": np.zeros((1, 1))}, r"targets=\(1, 1\) is their shape\. Allowed: shape \(5, 1\)"),
    ],
)
def test_data_that_do_not_go_together_are_refused(changes, message):
    example = {"dense": {"kernel": np.ones((2, 1), np.float32)}}
    posterior = make_amortized_svgd(
        make_generator(example, GeneratorConfig(hidden=(4,), noise_size=2)),
        lambda params, x: x @ params["dense"]["kernel"],
        1,
        optax.adam(1e-3),
        SVGDConfig(num_particles=2),
    )
    given = {"inputs": np.zeros((5, 2)), "targets": np.zeros((5, 1)), "num_data": 5, **changes}
    with pytest.raises(ValueError, match=message):
        posterior.update(jax.random.key(0), posterior.init(jax.random.key(1)), **given)
