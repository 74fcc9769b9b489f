"""DiveOff on a task with two equally good solutions among bad ones: it finds both, and only them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.offline.diveoff import DiveOff
from qdos_brax.skills.values import ValueBatch


def constant(width_in, biases):
    """Parameters of an MLP without hidden layers whose output is ``biases`` whatever its input."""
    return {"params": {"MLP_0": {"Dense_0": {"kernel": jnp.zeros((width_in, len(biases))), "bias": jnp.array(biases)}}}}


def test_the_losses_by_hand():
    learner = DiveOff(1, 1, latent_dim=1, hidden=(), batch_size=2)
    batch = ValueBatch(
        observation=jnp.array([[1.0], [0.0]]),
        action=jnp.array([[0.5], [0.0]]),
        reward=jnp.zeros(2),
        discount=jnp.zeros(2),
        next_observation=jnp.zeros((2, 1)),
    )
    mean, log_std = 0.5, -1.0
    encoder = constant(2, [mean, log_std])
    autoencoder = {"encoder": encoder, "decoder": constant(1, [0.2, -0.1])["params"]["MLP_0"]}
    autoencoder["decoder"] = {"params": autoencoder["decoder"]}
    key, weight = jax.random.key(0), jnp.array([2.0, 1.0])

    # Reconstruction: mean of (0.8^2, 0.6^2) = 0.5 and of (0.2^2, 0.1^2) = 0.025, weighted: (2 x 0.5 + 0.025) / 2.
    # KL of N(0.5, e^-2) from N(0, 1): (e^-2 + 0.25 - 1) / 2 + 1.
    kl = (np.exp(-2) + 0.25 - 1) / 2 + 1
    loss = learner.autoencoder_loss(autoencoder, batch, weight, jnp.zeros(2), key, 10.0)
    assert float(loss) == pytest.approx(0.5125 + 10 * 1.5 * kl, rel=1e-5)
    # log q of its own sample: -eps^2 / 2 - log sigma - log(2 pi) / 2.
    eps = np.asarray(jax.random.normal(key, (2, 1)))[:, 0]
    sharp = -(eps**2) / 2 - log_std - np.log(2 * np.pi) / 2
    with_sharpness = learner.autoencoder_loss(autoencoder, batch, weight, jnp.array([1.0, 3.0]), key, 10.0)
    assert float(with_sharpness - loss) == pytest.approx(-(sharp[0] + 3 * sharp[1]) / 2, rel=1e-4)
    # An encoder that always says 0.5 is off by 1.5 and 0.5.
    information = learner.information_loss(encoder, constant(2, [0.0]), batch.observation, jnp.array([[2.0], [0.0]]))
    assert float(information) == pytest.approx((1.5**2 + 0.5**2) / 2)
