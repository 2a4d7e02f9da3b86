"""The generator of networks: spread at the start, layout of the tree, noise, gradients (paper, section 3.1)."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore.beliefs.generator import GeneratorConfig, dead_share, make_generator
from jaxplore.networks import MLP, count_params

TARGET = MLP(hidden=(48,), output_size=3)


def draws(config, tree=None, num_inits=128, num_networks=32):
    """Networks of many generators, fresh from `init`: every leaf `[inits, networks, ...]`."""
    if tree is None:
        tree = jax.jit(TARGET.init)(jax.random.key(0), np.zeros(6, np.float32))["params"]
    generator = make_generator(tree, config)

    def one(key):
        init_key, noise_key = jax.random.split(key)
        return generator.sample(generator.init(init_key), generator.sample_noise(noise_key, num_networks))

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), num_inits)))


@pytest.mark.parametrize(
    ("rule", "constant_fraction", "want"),
    [
        ("match_example", 0.5, (0.01, 4.0)),
        ("he", 0.0, (math.sqrt(2 / 20), math.sqrt(2 / 60))),
        ("lecun", 0.5, (math.sqrt(1 / 20), math.sqrt(1 / 60))),
    ],
)
def test_sampled_networks_start_with_the_spread_that_the_rule_gives(rule, constant_fraction, want):
    # over inits and networks. Kernels: mean 0, and the std of He, LeCun or the example's root mean square; a leaf with
    # one axis: around the example's value (a LayerNorm's scale is 1) with std bias_std
    tree = {
        name: np.full(shape, value, np.float32)
        for name, shape, value in (("dense", (20, 30), 0.01), ("conv", (3, 20, 10), -4.0), ("scale", (50,), 1.0))
    }
    config = GeneratorConfig(init_std=rule, constant_fraction=constant_fraction, bias_std=0.2)
    networks = draws(config, tree)
    for name, std in zip(("dense", "conv"), want, strict=True):
        assert np.std(networks[name]) == pytest.approx(std, rel=0.05)
        assert abs(np.mean(networks[name])) < 0.05 * std
        # The share that z moves, E[Var_z] / total, is what constant_fraction leaves it.
        share = np.mean(np.var(networks[name], axis=1, ddof=1)) / np.mean(networks[name] ** 2)
        assert share == pytest.approx(1 - constant_fraction, rel=0.05)
    assert np.mean(networks["scale"]) == pytest.approx(1.0, abs=0.02)
    assert np.std(networks["scale"]) == pytest.approx(0.2, rel=0.05)


@pytest.mark.parametrize("activation", ["relu", "leaky_relu", "tanh", "swish"])
@pytest.mark.parametrize("normalize", [False, True])
def test_the_share_is_what_it_says_with_any_features(activation, normalize):
    config = GeneratorConfig(hidden=(64,), constant_fraction=0.3, activation=activation, normalize=normalize)
    kernel = draws(config, {"dense": np.full((20, 30), 0.5, np.float32)})["dense"]
    assert np.std(kernel) == pytest.approx(0.5, rel=0.05)
    share = np.mean(np.var(kernel, axis=1, ddof=1)) / np.mean(kernel**2)
    assert share == pytest.approx(0.7, rel=0.05)


def test_features_that_are_the_same_for_every_z_are_counted():
    # two layers of three features: one is cut off for every z, one hardly moves
    tree = {"a": {"kernel": np.ones((2, 3), np.float32)}, "b": {"kernel": np.ones((2, 3), np.float32)}}
    generator = make_generator(tree, GeneratorConfig(noise_size=4, hidden=(3,)))
    eta = jax.tree.map(np.array, generator.init(jax.random.key(0)))
    eta["a"]["features"]["output"]["bias"][:] = (-1e3, 1e3, 1e3)
    eta["b"]["features"]["output"]["bias"][:] = 1e3
    eta["b"]["features"]["output"]["kernel"][:, 2] = 1e-6
    zs = generator.sample_noise(jax.random.key(1), 512)
    assert generator.features is not None
    found = np.asarray(generator.features(eta, zs))
    assert found.shape == (2, 512, 3)
    assert np.all(found[0, :, 0] == 0)
    assert float(dead_share(found)) == pytest.approx(2 / 6)


def test_networks_of_an_mlp_start_like_the_mlp():
    # hidden layers sqrt(2 / fan_in), the last sqrt(1 / fan_in); the example's spread is itself a sample of 144 numbers
    networks = draws(GeneratorConfig(noise="per_layer", hidden=(64,), bias_std=0.2))
    for layer, want in {"hidden_0": math.sqrt(2 / 6), "output": math.sqrt(1 / 48)}.items():
        assert np.std(networks[layer]["kernel"]) == pytest.approx(want, rel=0.15)
        assert np.std(networks[layer]["bias"]) == pytest.approx(0.2, rel=0.2)


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
    tree = jax.jit(Nested().init)(jax.random.key(0), np.zeros(6, np.float32))["params"]
    generator = make_generator(tree, GeneratorConfig(noise_size=3, hidden=(8,), noise="per_layer"))
    generator = generator._replace(generate=jax.jit(generator.generate), sample=jax.jit(generator.sample))
    return tree, generator, jax.jit(generator.init)(jax.random.key(1))


ONES = np.ones(6, np.float32)
run = jax.jit(jax.vmap(lambda theta, x: Nested().apply({"params": theta}, x), in_axes=(0, None)))


def test_sampled_tree_is_the_examples_tree(nested):
    # structure, shapes and dtypes, and the network runs on it; layers: root, Conv_0, LayerNorm_0, inner/*
    tree, generator, eta = nested
    thetas = generator.sample(eta, generator.sample_noise(jax.random.key(2), 4))
    assert jax.tree.map(lambda a: ((4, *a.shape), a.dtype), tree) == jax.tree.map(lambda a: (a.shape, a.dtype), thetas)
    assert sorted(eta) == ["Conv_0", "LayerNorm_0", "inner/hidden_0", "inner/output", "root"]
    heads = [head for layer in eta.values() for name, head in layer.items() if name != "features"]
    assert sum(head.shape[1] for head in heads) == count_params(tree)
    assert run(thetas, ONES).shape == (4, 2)


def test_each_layer_listens_to_its_own_noise(nested):
    # per_layer: changing z of layer k changes the leaves of layer k and no other
    _, generator, eta = nested
    names = ["Conv_0", "LayerNorm_0", "root", "inner/hidden_0", "inner/output"]  # in the order of the tree's leaves
    z = np.asarray(generator.sample_noise(jax.random.key(2), 1))[0]
    assert z.shape == (5, 3)
    base = generator.generate(eta, z)
    for k, name in enumerate(names):
        changed = generator.generate(eta, z + (np.arange(5) == k)[:, None].astype(np.float32))
        moved = jax.tree.map(lambda a, b: np.any(np.asarray(a) != np.asarray(b)), base, changed)
        paths = [jax.tree_util.keystr(p, simple=True, separator="/") for p, m in jax.tree.leaves_with_path(moved) if m]
        assert paths
        assert {path.rpartition("/")[0] or "root" for path in paths} == {name}


@pytest.mark.parametrize(("noise", "linked"), [("shared", True), ("per_layer", False)])
def test_layers_share_their_noise_or_not(noise, linked):
    # by least squares: with one z for both layers a linear map of the first layer's numbers gives the second's (a
    # generator of one hidden layer has 16 features, the first layer 40 numbers); with a z each it gives nothing
    tree = {"a": {"kernel": np.ones((4, 10), np.float32)}, "b": {"kernel": np.ones((3, 3), np.float32)}}
    generator = make_generator(tree, GeneratorConfig(noise_size=2, hidden=(16,), noise=noise))

    @jax.jit
    def draw(key, noise_key):
        eta = generator.init(key)
        eta["b"]["features"] = eta["a"]["features"]
        return generator.sample(eta, generator.sample_noise(noise_key, 2000))

    thetas = draw(jax.random.key(0), jax.random.key(1))
    a, b = (np.asarray(thetas[n]["kernel"]).reshape(2000, -1) for n in "ab")
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    residual = b - a @ np.linalg.lstsq(a, b, rcond=1e-5)[0]
    unexplained = np.sum(residual**2) / np.sum(b**2)
    assert unexplained < 1e-4 if linked else unexplained > 0.95


def test_layer_order_and_offsets():
    # each number of theta is one column of its leaf's head, in order: with zero kernels, the column's last entry
    tree = {"layer": {"kernel": np.ones((2, 3), np.float32), "bias": np.zeros(3, np.float32)}}
    generator = make_generator(tree, GeneratorConfig(hidden=(4,)))
    shapes = jax.eval_shape(generator.init, jax.random.key(0))
    eta = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    for leaf in ("0", "1"):
        eta["layer"][leaf][-1] = 10 * int(leaf) + np.arange(eta["layer"][leaf].shape[1])
    theta = jax.jit(generator.generate)(eta, np.ones(32, np.float32))["layer"]
    np.testing.assert_array_equal(theta["bias"], [0, 1, 2])
    np.testing.assert_array_equal(theta["kernel"], [[10, 11, 12], [13, 14, 15]])


def test_sample_is_generate_for_each_z(nested):
    # vmap against a loop
    _, generator, eta = nested
    zs = generator.sample_noise(jax.random.key(2), 3)
    thetas = jax.device_get(generator.sample(eta, zs))
    for i, z in enumerate(np.asarray(zs)):
        one = generator.generate(eta, z)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-5, atol=1e-6), thetas, one)


def test_every_parameter_of_the_generator_learns(nested):
    # the network's output depends on every leaf of eta
    _, generator, eta = nested
    zs = generator.sample_noise(jax.random.key(2), 16)

    def loss(eta):
        outputs = run(generator.sample(eta, zs), jnp.arange(6.0))
        return jnp.sum(outputs * jnp.array([[1.0, 2.0]]))

    gradient = jax.jit(jax.grad(loss))(eta)
    still = [jax.tree_util.keystr(p) for p, g in jax.tree.leaves_with_path(gradient) if not np.any(g)]
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
    generator = make_generator({"a": {"kernel": jnp.ones((2, 3))}}, GeneratorConfig(hidden=(4,), noise_size=2))
    with pytest.raises(ValueError, match="num=0 is out of range"):
        generator.sample_noise(jax.random.key(0), 0)
