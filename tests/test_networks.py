"""Densities and recurrent layers against independent formulas."""

import flax.linen as nn
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


def test_gru_layer_equals_a_loop_of_flax_cells():
    # flax's GRUCell has no bias on the recurrent reset and update gates and one on the candidate's; ours starts at 0.
    x = jax.random.normal(jax.random.key(0), (2, 6, 3))
    layer = networks.GRULayer(4)
    params = layer.init(jax.random.key(1), x)["params"]
    kernels = jnp.split(params["input"]["kernel"], 3, axis=1)
    recurrent = jnp.split(params["recurrent"], 3, axis=1)
    cell_params = {}
    for index, gate in enumerate("rzn"):
        cell_params[f"i{gate}"] = {"kernel": kernels[index], "bias": jnp.zeros(4)}
        cell_params[f"h{gate}"] = {"kernel": recurrent[index]}
    cell_params["hn"]["bias"] = jnp.zeros(4)
    cell = nn.GRUCell(4)
    state, outputs = jnp.zeros((2, 4)), []
    for t in range(6):
        state, _ = cell.apply({"params": cell_params}, state, x[:, t])
        outputs.append(state)
    ours, last = layer.apply({"params": params}, x)
    np.testing.assert_allclose(ours, jnp.stack(outputs, axis=1), atol=1e-5)
    np.testing.assert_allclose(last, state, atol=1e-5)


def test_gru_layer_in_reverse_is_the_layer_on_the_reversed_sequence():
    x = jax.random.normal(jax.random.key(0), (2, 5, 3))
    params = networks.GRULayer(4).init(jax.random.key(1), x)
    forward, _ = networks.GRULayer(4).apply(params, x[:, ::-1])
    backward, last = networks.GRULayer(4, reverse=True).apply(params, x)
    np.testing.assert_allclose(backward, forward[:, ::-1], atol=1e-6)
    np.testing.assert_allclose(last, backward[:, 0], atol=1e-6)


def test_ensemble_members_differ_and_do_not_mix():
    ensemble = networks.Ensemble((8,), size=3)
    x = jax.random.normal(jax.random.key(0), (5, 4))
    params = ensemble.init(jax.random.key(1), x)
    outputs = ensemble.apply(params, x)
    assert outputs.shape == (3, 5)
    assert not np.allclose(outputs[0], outputs[1])
    changed = jax.tree.map(lambda p: p.at[0].set(0.0), params)
    np.testing.assert_array_equal(ensemble.apply(changed, x)[1:], outputs[1:])
