"""The advantage-weighted trajectory VAE (paper, eq. 3 and Algorithm 1) and its mutual-information term (eq. 5)."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from qdos_brax.config import SkillsConfig
from qdos_brax.nn.networks import DiagonalGaussian, SegmentEncoder, gaussian_kl, gaussian_log_prob, gaussian_sample

Params = Any


class Segments(NamedTuple):
    """Hold windows of the data: observations[B, H, obs] (normalised), actions[B, H, act]."""

    observations: jax.Array
    actions: jax.Array


class Posterior(NamedTuple):
    """Hold the diagonal Gaussian q(z | tau): mean[B, z], log standard deviation[B, z]."""

    mean: jax.Array
    log_std: jax.Array


class SkillModel:
    """Combine posterior, state prior and decoder of the trajectory VAE.

    Args:
        observation_dim: width of observations.
        action_dim: width of actions.
        config: dimension of z and widths.
    """

    def __init__(self, observation_dim: int, action_dim: int, config: SkillsConfig) -> None:
        self.observation_dim, self.action_dim, self.latent_dim = observation_dim, action_dim, config.latent_dim
        self._encoder = SegmentEncoder(config.encoder_hidden, config.encoder_layers, config.latent_dim)
        self._prior = DiagonalGaussian(config.prior_hidden, config.latent_dim)
        self._decoder = DiagonalGaussian(config.decoder_hidden, action_dim)

    def init(self, key: jax.Array) -> dict[str, Params]:
        """Return fresh parameters: {"encoder", "prior", "decoder"}."""
        encoder_key, prior_key, decoder_key = jax.random.split(key, 3)
        observation, action = jnp.zeros((1, 2, self.observation_dim)), jnp.zeros((1, 2, self.action_dim))
        return {
            "encoder": self._encoder.init(encoder_key, observation, action),
            "prior": self._prior.init(prior_key, observation[:, 0]),
            "decoder": self._decoder.init(decoder_key, jnp.zeros((1, self.observation_dim + self.latent_dim))),
        }

    def encode(self, params: dict[str, Params], segments: Segments) -> Posterior:
        """Return q(z | tau)."""
        return Posterior(*self._encoder.apply(params["encoder"], segments.observations, segments.actions))

    def prior(self, params: dict[str, Params], observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return p(z | s_0): (mean[..., z], log standard deviation[..., z])."""
        return self._prior.apply(params["prior"], observation)

    def decode(
        self, params: dict[str, Params], observation: jax.Array, latent: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return pi(a | s, z): (mean[..., act], log standard deviation[..., act])."""
        return self._decoder.apply(params["decoder"], jnp.concatenate([observation, latent], axis=-1))

    def act(self, params: dict[str, Params], observation: jax.Array, latent: jax.Array) -> jax.Array:
        """Return the low-level policy's mean action[..., act], clipped to [-1, 1]."""
        return jnp.clip(self.decode(params, observation, latent)[0], -1.0, 1.0)

    def reconstruction(self, params: dict[str, Params], segments: Segments, latent: jax.Array) -> jax.Array:
        """Return sum_t log pi(a_t | s_t, z), [B]."""
        horizon = segments.actions.shape[1]
        repeated = jnp.broadcast_to(latent[:, None], (latent.shape[0], horizon, latent.shape[1]))
        mean, log_std = self.decode(params, segments.observations, repeated)
        return jnp.sum(gaussian_log_prob(segments.actions, mean, log_std), axis=1)

    def vae_loss(
        self,
        params: dict[str, Params],
        segments: Segments,
        weight: jax.Array,
        kl_weight: jax.Array | float,
        key: jax.Array,
        kl_weighted: bool,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Return mean_i [ w_i or 1 ] beta KL(q || p) - w_i log-likelihood.

        Args:
            params: the model's parameters.
            segments: windows, leading axis B.
            weight: [B], mean about 1.
            kl_weight: beta.
            key: for the posterior sample.
            kl_weighted: weight the KL as Algorithm 1 does (True) or not, as equation 4 does (False).
        """
        posterior = self.encode(params, segments)
        latent = gaussian_sample(key, *posterior)
        log_likelihood = self.reconstruction(params, segments, latent)
        kl = gaussian_kl(*posterior, *self.prior(params, segments.observations[:, 0]))
        kl_share = weight * kl if kl_weighted else kl
        loss = jnp.mean(kl_weight * kl_share - weight * log_likelihood)
        return loss, {"vae_loss": loss, "kl": jnp.mean(kl), "log_likelihood": jnp.mean(log_likelihood)}

    def information_loss(
        self, params: dict[str, Params], observations: jax.Array, latent: jax.Array, weight: jax.Array
    ) -> jax.Array:
        """Return mean_i w_i ||z_hat_i - z_i||^2, with z_hat the posterior mean of what skill z does (paper, eq. 5).

        The actions are decoded anew along ``observations[B, H, obs]``, so that the gradient reaches the decoder
        through them although the states carry none (they come from a rollout, or from the log).
        """
        observations = jax.lax.stop_gradient(observations)
        repeated = jnp.broadcast_to(latent[:, None], (*observations.shape[:2], latent.shape[-1]))
        actions = self.decode(params, observations, repeated)[0]
        recovered = self.encode(params, Segments(observations, actions)).mean
        return jnp.mean(weight * jnp.sum((recovered - latent) ** 2, axis=-1))
