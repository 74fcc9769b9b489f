"""Densities against independent formulas, and the ensemble."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from qdos_brax import networks


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
