"""The low-level policy's least standard deviation: what it is for, and that runs of before are as they were."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.nn.networks import DiagonalGaussian, gaussian_log_prob
from tests.point import point_config


@pytest.mark.parametrize(("least", "bound"), [(0.0, np.exp(-5)), (0.2, 0.2), (1e-6, np.exp(-5))])
def test_no_deviation_is_below_the_bounds(least: float, bound: float) -> None:
    network = DiagonalGaussian((8,), 2, least_std=least)
    x = 100 * jax.random.normal(jax.random.key(1), (64, 3))
    log_std = network.apply(network.init(jax.random.key(0), x), x)[1]
    np.testing.assert_allclose(jnp.exp(log_std).min(), bound, rtol=1e-5)


@pytest.mark.parametrize(("least", "ratio"), [(0.0, (0.2 * np.exp(5)) ** 2), (0.2, 1.0)])
def test_actions_without_noise_count_by_the_inverse_square_unless_there_is_a_floor(least: float, ratio: float) -> None:
    """Two actions, both missed by 0.1; one has no noise, the other 0.2: how much more the first mean is moved."""
    network = DiagonalGaussian((4,), 2, least_std=least)
    params = jax.tree.map(jnp.zeros_like, network.init(jax.random.key(0), jnp.zeros((1, 3))))
    params["params"]["MLP_0"]["Dense_1"]["bias"] = jnp.array([0.0, 0.0, -20.0, np.log(0.2)])

    def likelihood(params: Any) -> jax.Array:
        return gaussian_log_prob(jnp.full((1, 2), 0.1), *network.apply(params, jnp.zeros((1, 3)))).sum()

    grad = jax.grad(likelihood)(params)["params"]["MLP_0"]["Dense_1"]["bias"][:2]
    np.testing.assert_allclose(grad[0] / grad[1], ratio, rtol=1e-4)
    np.testing.assert_allclose(grad[1], 0.1 / 0.2**2, rtol=1e-5)


def test_runs_from_before_there_was_a_floor_keep_their_hash() -> None:
    plain = configs.config_hash(point_config())
    assert configs.config_hash(point_config(**{"skills.least_std": 0.0})) == plain
    assert configs.config_hash(point_config(**{"skills.least_std": 0.2})) != plain
