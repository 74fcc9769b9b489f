"""Densities against independent formulas, and the ensemble."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from qdos_brax.nn import networks
from qdos_brax.nn.layer_norm import layer_norm_relu


def test_gaussian_log_prob_is_scipys():
    rng = np.random.default_rng(0)
    x, mean, log_std = rng.normal(size=(3, 5)), rng.normal(size=(3, 5)), rng.normal(size=(3, 5)) * 0.3
    expected = scipy.stats.norm.logpdf(x, mean, np.exp(log_std)).sum(axis=-1)
    np.testing.assert_allclose(networks.gaussian_log_prob(x, mean, log_std), expected, rtol=1e-5)


def test_gaussian_kl_by_hand():
    # KL(N(1, 2^2) || N(0, 1)) = log(1/2) + (4 + 1) / 2 - 1/2 = 2 - log 2, and KL(p || p) = 0.
    kl = networks.gaussian_kl(jnp.array([1.0, 0.3]), jnp.log(jnp.array([2.0, 0.7])), jnp.array([0.0, 0.3]),
                              jnp.log(jnp.array([1.0, 0.7])))  # fmt: skip
    np.testing.assert_allclose(kl, 2 - np.log(2), rtol=1e-6)


def test_tanh_gaussian_density_integrates_like_the_change_of_variables():
    mean, log_std = jnp.array([0.3]), jnp.array([-0.2])
    u, log_prob = networks.tanh_gaussian_sample(jax.random.key(3), mean, log_std)
    pre = np.arctanh(float(u[0]))
    expected = scipy.stats.norm.logpdf(pre, 0.3, np.exp(-0.2)) - np.log(1 - float(u[0]) ** 2)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-4)
    np.testing.assert_allclose(networks.tanh_gaussian_log_prob(u, mean, log_std), expected, rtol=1e-4)


def test_tanh_gaussian_log_prob_is_finite_in_the_corners():
    u, log_prob = networks.tanh_gaussian_sample(jax.random.key(0), jnp.array([40.0, -40.0]), jnp.zeros(2))
    assert np.all(np.isfinite(log_prob)) and np.all(np.abs(u) <= 1)


def test_ensemble_members_differ_and_do_not_mix():
    ensemble = networks.Ensemble((8,), size=3)
    x = jax.random.normal(jax.random.key(0), (5, 4))
    params = ensemble.init(jax.random.key(1), x)
    outputs = ensemble.apply(params, x)
    assert outputs.shape == (3, 5)
    assert not np.allclose(outputs[0], outputs[1])
    changed = jax.tree.map(lambda p: p.at[0].set(0.0), params)
    np.testing.assert_array_equal(ensemble.apply(changed, x)[1:], outputs[1:])


def test_layer_norm_and_relu_are_flax_s_and_so_are_their_gradients():
    width, keys = 48, jax.random.split(jax.random.key(0), 4)
    x = 3.0 + 2.0 * jax.random.normal(keys[0], (5, 7, width))
    scale, bias, into = (
        jax.random.normal(key, shape) for key, shape in zip(keys[1:], ((width,), (width,), x.shape), strict=True)
    )

    def plain(x, scale, bias):
        return nn.relu(nn.LayerNorm().apply({"params": {"scale": scale, "bias": bias}}, x))

    np.testing.assert_allclose(layer_norm_relu(x, scale, bias), plain(x, scale, bias), rtol=1e-5, atol=1e-5)
    gradients = [
        jax.grad(lambda *args, f=f: jnp.sum(into * f(*args)), (0, 1, 2))(x, scale, bias)
        for f in (layer_norm_relu, plain)
    ]
    for found, expected in zip(*gradients, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e5])
def test_a_dense_layer_s_features_keep_their_variance_whatever_raw_positions_are(offset: float):
    """A common offset would cost it: features of deviation 1 around 1,000 are wrong by a tenth and more."""
    observation = offset + jax.random.normal(jax.random.key(0), (64, 29))
    width, ones = 256, jnp.ones(256)
    features = nn.Dense(width).init_with_output(jax.random.key(1), observation)[0]

    def error(x: jax.Array) -> float:
        exact = np.asarray(x, np.float64)
        exact = (exact - exact.mean(-1, keepdims=True)) / np.sqrt(exact.var(-1, keepdims=True) + 1e-6)
        return float(np.abs(layer_norm_relu(x, ones, 0 * ones) - np.maximum(exact, 0)).max())

    assert error(features) < 1e-5
    assert error(1e3 + jax.random.normal(jax.random.key(2), (64, width))) > 0.1


def test_a_layer_norm_s_parameters_are_named_as_flax_s():
    params = networks.MLP((6, 1), layer_norm=True).init(jax.random.key(0), jnp.zeros((1, 3)))["params"]
    assert jax.tree.map(np.shape, params["LayerNorm_0"]) == {"scale": (6,), "bias": (6,)}
    np.testing.assert_array_equal(params["LayerNorm_0"]["scale"], 1.0)
