"""The generator of networks: spread at the start, layout of the tree, noise, gradients (paper, section 3.1)."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore.generator import GeneratorConfig, make_generator
from jaxplore.networks import MLP, count_params

TARGET = MLP(hidden=(48,), output_size=3)
KERNELS = {"hidden_0": (6, "he"), "output": (48, "lecun")}
"""Layer -> (fan in, initialiser), as `MLP` has them by default."""


def example(seed=0):
    return TARGET.init(jax.random.key(seed), jnp.zeros(6))["params"]


def draws(config, tree=None, num_inits=64, num_networks=32):
    """Networks of many generators, fresh from `init`: every leaf `[inits, networks, ...]`."""
    generator = make_generator(example() if tree is None else tree, config)

    def one(key):
        init_key, noise_key = jax.random.split(key)
        return generator.sample(generator.init(init_key), generator.sample_noise(noise_key, num_networks))

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), num_inits)))


@pytest.mark.parametrize(("rule", "noise"), [("match_example", "shared"), ("he", "per_layer"), ("lecun", "shared")])
def test_sampled_networks_start_with_the_initialisers_spread(rule, noise):
    # He: sqrt(2 / fan_in), LeCun: sqrt(1 / fan_in), over inits and networks; biases: mean 0, std bias_std
    networks = draws(GeneratorConfig(noise=noise, init_std=rule, bias_std=0.2))
    for layer, (inputs, own_rule) in KERNELS.items():
        used = own_rule if rule == "match_example" else rule
        want = math.sqrt({"he": 2, "lecun": 1}[used] / inputs)
        # The example's own spread is itself a sample, of 144 numbers in the smaller kernel.
        tolerance = 0.15 if rule == "match_example" else 0.05
        assert np.std(networks[layer]["kernel"]) == pytest.approx(want, rel=tolerance)
        assert abs(np.mean(networks[layer]["kernel"])) < 0.05 * want
        assert np.std(networks[layer]["bias"]) == pytest.approx(0.2, rel=0.15)


def test_matching_an_example_matches_its_own_numbers():
    # the root mean square of the example's entries per leaf, whatever drew them
    tree = {"a": {"kernel": jnp.full((20, 30), 0.01), "other": jnp.full((3, 20, 10), -4.0)}}
    networks = draws(GeneratorConfig(), tree)
    assert np.std(networks["a"]["kernel"]) == pytest.approx(0.01, rel=0.05)
    assert np.std(networks["a"]["other"]) == pytest.approx(4.0, rel=0.05)


def relu_correlation(rho: float) -> float:
    """Correlation (about 0) of ReLU features of Gaussians with correlation rho (arc-cosine kernel, Cho & Saul 2009)."""
    return (math.sqrt(1 - rho**2) + rho * (math.pi - math.acos(rho))) / math.pi


@pytest.mark.parametrize("constant_fraction", [0.0, 0.5])
def test_share_of_the_variance_that_z_moves(constant_fraction):
    # E[Var_z] / total: the features of unrelated z are correlated by relu_correlation twice, 0.494, so that z moves
    # 0.506 of what constant_fraction leaves it
    tree = {"kernel": jnp.ones((20, 30))}
    kernel = draws(GeneratorConfig(constant_fraction=constant_fraction), tree, num_inits=128)["kernel"]
    share = np.mean(np.var(kernel, axis=1, ddof=1)) / np.mean(kernel**2)
    moved = 1 - relu_correlation(relu_correlation(0.0))
    assert share == pytest.approx((1 - constant_fraction) * moved, rel=0.05)


def test_leaves_with_one_axis_start_around_the_example():
    # a LayerNorm's scale is 1 and its bias 0 in the example; sampled networks must stay near that, not near 0
    norm = nn.LayerNorm().init(jax.random.key(0), jnp.zeros(50))["params"]
    networks = draws(GeneratorConfig(bias_std=0.1), {"norm": norm})
    for name, want in {"scale": 1.0, "bias": 0.0}.items():
        assert np.mean(networks["norm"][name]) == pytest.approx(want, abs=0.01)
        assert np.std(networks["norm"][name]) == pytest.approx(0.1, rel=0.1)


class Nested(nn.Module):
    """A network with an array at the root, two levels of modules, a convolution and a scalar."""

    @nn.compact
    def __call__(self, x):
        gain = self.param("gain", nn.initializers.ones, (1,))
        x = nn.Conv(4, (3,))(x[:, None])
        x = MLP((5,), 2, name="inner")(x.reshape(-1))
        return nn.LayerNorm()(x) * gain


@pytest.fixture(scope="module")
def nested():
    """`(example, generator of per-layer noise, eta)` of a nested network."""
    tree = Nested().init(jax.random.key(0), jnp.zeros(6))["params"]
    generator = make_generator(tree, GeneratorConfig(noise_size=3, hidden=(8,), noise="per_layer"))
    return tree, generator, jax.jit(generator.init)(jax.random.key(1))


def test_sampled_tree_is_the_examples_tree(nested):
    # structure, shapes and dtypes, and the network runs on it; layers: root, Conv_0, LayerNorm_0, inner/*
    tree, generator, eta = nested
    thetas = generator.sample(eta, generator.sample_noise(jax.random.key(2), 4))
    assert jax.tree.map(lambda a: ((4, *a.shape), a.dtype), tree) == jax.tree.map(lambda a: (a.shape, a.dtype), thetas)
    assert sorted(eta) == ["Conv_0", "LayerNorm_0", "inner/hidden_0", "inner/output", "root"]
    assert sum(p["output"]["bias"].size for p in eta.values()) == count_params(tree)
    outputs = jax.vmap(lambda theta: Nested().apply({"params": theta}, jnp.ones(6)))(thetas)
    assert outputs.shape == (4, 2)


def test_each_layer_listens_to_its_own_noise(nested):
    # per_layer: changing z of layer k changes the leaves of layer k and no other
    _, generator, eta = nested
    names = ["Conv_0", "LayerNorm_0", "root", "inner/hidden_0", "inner/output"]  # in the order of the tree's leaves
    z = generator.sample_noise(jax.random.key(2), 1)[0]
    assert z.shape == (5, 3)
    base = generator.generate(eta, z)
    for k, name in enumerate(names):
        changed = generator.generate(eta, z.at[k].add(1.0))
        moved = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), base, changed)
        paths = [jax.tree_util.keystr(p, simple=True, separator="/") for p, m in jax.tree.leaves_with_path(moved) if m]
        assert paths
        assert {path.rpartition("/")[0] or "root" for path in paths} == {name}


@pytest.mark.parametrize(("noise", "linked"), [("shared", True), ("per_layer", False)])
def test_layers_share_their_noise_or_not(noise, linked):
    # by least squares: with one z for both layers a linear map of the first layer's numbers gives the second's (a
    # generator of one hidden layer has 16 features, the first layer 40 numbers); with a z each it gives nothing
    tree = {"a": {"kernel": jnp.ones((4, 10))}, "b": {"kernel": jnp.ones((3, 3))}}
    generator = make_generator(tree, GeneratorConfig(noise_size=2, hidden=(16,), noise=noise))
    eta = generator.init(jax.random.key(0))
    eta["b"]["hidden_0"] = eta["a"]["hidden_0"]
    thetas = generator.sample(eta, generator.sample_noise(jax.random.key(1), 2000))
    a, b = (np.asarray(thetas[n]["kernel"]).reshape(2000, -1) for n in "ab")
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    residual = b - a @ np.linalg.lstsq(a, b, rcond=1e-5)[0]
    unexplained = np.sum(residual**2) / np.sum(b**2)
    assert unexplained < 1e-4 if linked else unexplained > 0.95


def test_layer_order_and_offsets():
    # each number of theta is one output of its layer's MLP, leaves in the tree's order: with zero kernels, its biases
    tree = {"layer": {"kernel": jnp.ones((2, 3)), "bias": jnp.zeros(3)}}
    generator = make_generator(tree, GeneratorConfig(hidden=(4,)))
    eta = jax.tree.map(jnp.zeros_like, generator.init(jax.random.key(0)))
    eta["layer"]["output"]["bias"] = jnp.arange(9.0)
    theta = generator.generate(eta, jnp.ones(32))["layer"]
    np.testing.assert_array_equal(theta["bias"], [0, 1, 2])
    np.testing.assert_array_equal(theta["kernel"], [[3, 4, 5], [6, 7, 8]])


@pytest.mark.parametrize("noise", ["shared", "per_layer"])
def test_sample_is_generate_for_each_z(noise):
    # vmap against a loop
    generator = make_generator(example(), GeneratorConfig(noise=noise))
    eta = generator.init(jax.random.key(1))
    zs = generator.sample_noise(jax.random.key(2), 3)
    thetas = generator.sample(eta, zs)
    for i, z in enumerate(zs):
        one = generator.generate(eta, z)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-5, atol=1e-6), thetas, one)


def test_every_parameter_of_the_generator_learns(nested):
    # the network's output depends on every leaf of eta
    _, generator, eta = nested
    zs = generator.sample_noise(jax.random.key(2), 16)

    def loss(eta):
        outputs = jax.vmap(lambda theta: Nested().apply({"params": theta}, jnp.arange(6.0)))(generator.sample(eta, zs))
        return jnp.sum(outputs * jnp.array([[1.0, 2.0]]))

    gradient = jax.jit(jax.grad(loss))(eta)
    still = [jax.tree_util.keystr(p) for p, g in jax.tree.leaves_with_path(gradient) if not jnp.any(g != 0)]
    assert still == []


def test_bad_input_is_refused():
    # each message names the field, the value and what is allowed
    with pytest.raises(ValueError, match="example has no leaves"):
        make_generator({})
    with pytest.raises(ValueError, match=r"example\['a'\]\['kernel'\] is all zeros.*init_std='he'"):
        make_generator({"a": {"kernel": jnp.zeros((2, 3))}})
    make_generator({"a": {"kernel": jnp.zeros((2, 3))}}, GeneratorConfig(init_std="he"))
    with pytest.raises(ValueError, match=r"GeneratorConfig\.noise='per_leyer' .*Did you mean 'per_layer'"):
        GeneratorConfig(noise="per_leyer")
    with pytest.raises(ValueError, match=r"GeneratorConfig\.constant_fraction=1\.0 .*\[0, 1\)"):
        GeneratorConfig(constant_fraction=1.0)
    with pytest.raises(ValueError, match=r"GeneratorConfig\.bias_std=-0\.1"):
        GeneratorConfig(bias_std=-0.1)
    with pytest.raises(ValueError, match=r"GeneratorConfig\.hidden=\(\)"):
        GeneratorConfig(hidden=())
    with pytest.raises(ValueError, match=r"GeneratorConfig\.noise_size=0"):
        GeneratorConfig(noise_size=0)
