"""The networks of the method: no losses here, no random numbers beyond initialisation.

Every module takes arrays with any leading axes and acts on the last one, unless it says otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from qdos_brax.nn.gru import BidirectionalGRU
from qdos_brax.nn.layer_norm import LayerNormReLU

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0


class MLP(nn.Module):
    """Apply dense layers with ReLU between them.

    Attributes:
        features: widths, the last one is the output's.
        layer_norm: LayerNorm before each activation (RLPD, Ball et al. 2023, section 4.2).
    """

    features: Sequence[int]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps [..., in] to [..., features[-1]]."""
        for layer, width in enumerate(self.features[:-1]):
            x = nn.Dense(width)(x)
            x = LayerNormReLU(name=f"LayerNorm_{layer}")(x) if self.layer_norm else nn.relu(x)
        return nn.Dense(self.features[-1])(x)


class Ensemble(nn.Module):
    """Apply ``size`` independent MLPs with one scalar output each, as one batched matmul per layer.

    Attributes:
        hidden: hidden widths.
        size: number of members; parameters carry it as their first axis.
        layer_norm: LayerNorm before each activation.
    """

    hidden: Sequence[int]
    size: int
    layer_norm: bool = True

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps [..., in] to [size, ...]."""
        members = nn.vmap(
            MLP, variable_axes={"params": 0}, split_rngs={"params": True}, in_axes=None, axis_size=self.size
        )
        return members((*self.hidden, 1), self.layer_norm)(x)[..., 0]


class DiagonalGaussian(nn.Module):
    """Apply an MLP whose output is a diagonal Gaussian.

    Attributes:
        hidden: hidden widths.
        dim: dimension of the Gaussian.
        layer_norm: LayerNorm before each activation.
        least_std: least standard deviation, where it is above that of all Gaussians here.
    """

    hidden: Sequence[int]
    dim: int
    layer_norm: bool = False
    least_std: float = 0.0

    @nn.compact
    def __call__(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Maps [..., in] to (mean[..., dim], log standard deviation[..., dim])."""
        mean, log_std = jnp.split(MLP((*self.hidden, 2 * self.dim), self.layer_norm)(x), 2, axis=-1)
        least = max(LOG_STD_MIN, math.log(self.least_std)) if self.least_std else LOG_STD_MIN
        return mean, jnp.clip(log_std, least, LOG_STD_MAX)


class SegmentEncoder(nn.Module):
    """Encode q(z | tau): stacked bidirectional GRUs over (s_t, a_t), a diagonal Gaussian on the last states.

    Attributes:
        hidden: GRU width.
        layers: number of stacked bidirectional layers.
        latent_dim: dimension of z.
    """

    hidden: int
    layers: int
    latent_dim: int

    @nn.compact
    def __call__(self, observations: jax.Array, actions: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Maps observations[B, H, obs] and actions[B, H, act] to (mean[B, z], log standard deviation[B, z])."""
        x = jnp.swapaxes(jnp.concatenate([observations, actions], axis=-1), 0, 1)
        for _ in range(self.layers):
            x, summary = BidirectionalGRU(self.hidden)(x)
        mean, log_std = jnp.split(nn.Dense(2 * self.latent_dim)(summary), 2, axis=-1)
        return mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


def gaussian_log_prob(x: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Return log N(x; mean, exp(log_std)^2), summed over the last axis."""
    scaled = (x - mean) * jnp.exp(-log_std)
    return -jnp.sum(0.5 * scaled**2 + log_std + 0.5 * jnp.log(2 * jnp.pi), axis=-1)


def gaussian_kl(mean_q: jax.Array, log_std_q: jax.Array, mean_p: jax.Array, log_std_p: jax.Array) -> jax.Array:
    """Return KL(q || p) of two diagonal Gaussians, summed over the last axis."""
    variance_ratio = jnp.exp(2 * (log_std_q - log_std_p))
    distance = ((mean_q - mean_p) * jnp.exp(-log_std_p)) ** 2
    return jnp.sum(0.5 * (variance_ratio + distance - 1) + log_std_p - log_std_q, axis=-1)


def gaussian_sample(key: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Return a reparameterised sample, the shape of ``mean``."""
    return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)


def tanh_gaussian_sample(key: jax.Array, mean: jax.Array, log_std: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return a sample of the squashed Gaussian and its log density (SAC, Haarnoja et al. 2018, appendix C).

    Returns:
        (u[..., dim] in (-1, 1), log pi(u)[...]); the log of the Jacobian is written so that it stays finite.
    """
    pre = gaussian_sample(key, mean, log_std)
    log_prob = gaussian_log_prob(pre, mean, log_std)
    log_jacobian = jnp.sum(2 * (jnp.log(2.0) - pre - nn.softplus(-2 * pre)), axis=-1)
    return jnp.tanh(pre), log_prob - log_jacobian


def tanh_gaussian_log_prob(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Return the log density[...] of the squashed Gaussian at action[..., dim], which must lie inside (-1, 1)."""
    log_jacobian = jnp.sum(jnp.log1p(-(action**2)), axis=-1)
    return gaussian_log_prob(jnp.arctanh(action), mean, log_std) - log_jacobian
