"""The advantage-weighted trajectory VAE (paper, eq. 3 and Algorithm 1) and its mutual-information term (eq. 5)."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from qdos_brax.config import SkillsConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import rows_ahead, window
from qdos_brax.nn.networks import MLP, DiagonalGaussian, SegmentEncoder, gaussian_kl, gaussian_log_prob, gaussian_sample
from qdos_brax.skills.views import View, WorldView

Params = Any


class Segments(NamedTuple):
    """Hold windows of the data.

    Attributes:
        observations: [B, H, obs], normalised.
        actions: [B, H, act].
        later: [B, obs], the observation ``SkillModel.reach`` steps after the first, or the episode's last; None for
            models that do not ask for it.
    """

    observations: jax.Array
    actions: jax.Array
    later: jax.Array | None = None


def segments_at(data: DeviceData, starts: jax.Array, horizon: int, reach: int | None) -> Segments:
    """Return the segments of ``horizon`` rows at ``starts[B]``, with what follows ``reach`` steps after their first."""
    later = None if reach is None else data.next_observations[rows_ahead(starts, data.last, reach)]
    return Segments(*window((data.observations, data.actions), starts, horizon), later)


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
        view: what the three networks are shown of an observation.

    Attributes:
        latent_dim: width of z.
        action_dim: width of actions.
        seen_dim: width of what the view shows of an observation.
        view: as given.
        skill_size: width of a skill that has begun: z and a pose.
        context_size: width of what the decoder is shown.
        reach: steps from a segment's first observation to ``Segments.later``, or None if that is not asked for.
    """

    reach: int | None = None

    def __init__(self, observation_dim: int, action_dim: int, config: SkillsConfig, view: View | None = None) -> None:
        self.latent_dim, self.view = config.latent_dim, view or WorldView()
        self.seen_dim, self.action_dim = self.view.size(observation_dim), action_dim
        self.skill_size = config.latent_dim + self.view.pose_size
        self.context_size = self.seen_dim + config.latent_dim
        self._encoder = SegmentEncoder(config.encoder_hidden, config.encoder_layers, config.latent_dim)
        self._prior = DiagonalGaussian(config.prior_hidden, config.latent_dim)
        self._decoder = DiagonalGaussian(config.decoder_hidden, action_dim, least_std=config.least_std)
        self._correction = MLP((*config.decoder_hidden, action_dim))

    def init(self, key: jax.Array, view: Mapping[str, Params] = MappingProxyType({})) -> dict[str, Params]:
        """Return fresh parameters: {"encoder", "prior", "decoder"}, and "view", what the view knows of the data."""
        encoder_key, prior_key, decoder_key = jax.random.split(key, 3)
        seen, action = jnp.zeros((1, 2, self.seen_dim)), jnp.zeros((1, 2, self.action_dim))
        return {
            "encoder": self._encoder.init(encoder_key, seen, action),
            "prior": self._prior.init(prior_key, seen[:, 0]),
            "decoder": self._decoder.init(decoder_key, jnp.zeros((1, self.context_size))),
            "view": dict(view),
        }

    def encode(self, params: dict[str, Params], segments: Segments) -> Posterior:
        """Return q(z | tau)."""
        seen = self.see_along(params, segments.observations)
        return Posterior(*self._encoder.apply(params["encoder"], seen, segments.actions))

    def prior(self, params: dict[str, Params], observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return p(z | s_0): (mean[..., z], log standard deviation[..., z])."""
        return self._prior.apply(params["prior"], self._see(params, observation, self._pose(params, observation)))

    def begin(self, params: dict[str, Params], latent: jax.Array, observation: jax.Array) -> jax.Array:
        """Return the skill[..., z + pose] of a latent that is played from an observation on."""
        return jnp.concatenate([latent, self._pose(params, observation)], axis=-1)

    def decode(
        self, params: dict[str, Params], observation: jax.Array, skill: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return pi(a | s, z): (mean[..., act], log standard deviation[..., act]) of a skill that has begun."""
        return self._decoder.apply(params["decoder"], self.context(params, observation, skill))

    def context(self, params: dict[str, Params], observation: jax.Array, skill: jax.Array) -> jax.Array:
        """Return what the decoder is shown, [..., seen + z]: the view of an observation, and the latent."""
        latent, pose = skill[..., : self.latent_dim], skill[..., self.latent_dim :]
        return self.shown(self._see(params, observation, pose), latent)

    def shown(self, seen: jax.Array, latent: jax.Array) -> jax.Array:
        """Return what the decoder is shown, [..., seen + z], of what the view shows and z."""
        return jnp.concatenate([seen, latent], axis=-1)

    def decode_seen(self, params: dict[str, Params], seen: jax.Array, latent: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return pi(a | s, z) of what the view shows of s, ``seen[..., seen]``, and z[..., latent]."""
        return self._decoder.apply(params["decoder"], self.shown(seen, latent))

    def see_along(self, params: dict[str, Params], observations: jax.Array) -> jax.Array:
        """Return what the view shows of observations[B, H, obs] in a skill begun at the first of them, [B, H, seen]."""
        return self._see(params, observations, self._pose(params, observations[:, 0])[:, None])

    def act(self, params: dict[str, Params], observation: jax.Array, skill: jax.Array) -> jax.Array:
        """Return the low-level policy's mean action[..., act], clipped to [-1, 1].

        Parameters that were fine-tuned online hold a "correction", which is added and the sum clipped again.
        """
        action = jnp.clip(self.decode(params, observation, skill)[0], -1.0, 1.0)
        if "correction" not in params:
            return action
        return jnp.clip(action + self.correction(params, observation, skill), -1.0, 1.0)

    def init_correction(self, key: jax.Array, bound: jax.Array | float) -> dict[str, Params]:
        """Return a correction of the decoder's actions that is zero everywhere: {"network", "bound"}."""
        network = self._correction.init(key, jnp.zeros((1, self.context_size)))
        last = f"Dense_{len(self._correction.features) - 1}"
        blank = jax.tree.map(jnp.zeros_like, network["params"][last])
        return {"network": {"params": {**network["params"], last: blank}}, "bound": jnp.asarray(bound, jnp.float32)}

    def correction(self, params: dict[str, Params], observation: jax.Array, skill: jax.Array) -> jax.Array:
        """Return what is added to the decoder's action, [..., act], each component at most the bound."""
        correction, context = params["correction"], self.context(params, observation, skill)
        return correction["bound"] * jnp.tanh(self._correction.apply(correction["network"], context))

    def decode_along(
        self, params: dict[str, Params], observations: jax.Array, latent: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return pi(a_t | s_t, z) along observations[B, H, obs] for z[B, latent] begun at the first of them."""
        skill = self.begin(params, latent, observations[:, 0])
        repeated = jnp.broadcast_to(skill[:, None], (*observations.shape[:2], skill.shape[-1]))
        return self.decode(params, observations, repeated)

    def reconstruction(self, params: dict[str, Params], segments: Segments, latent: jax.Array) -> jax.Array:
        """Return sum_t log pi(a_t | s_t, z), [B]."""
        mean, log_std = self.decode_along(params, segments.observations, latent)
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
        kl, log_likelihood = self.divergence_and_likelihood(params, segments, key)
        kl_share = weight * kl if kl_weighted else kl
        loss = jnp.mean(kl_weight * kl_share - weight * log_likelihood)
        return loss, {"vae_loss": loss, "kl": jnp.mean(kl), "log_likelihood": jnp.mean(log_likelihood)}

    def divergence_and_likelihood(
        self, params: dict[str, Params], segments: Segments, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return KL(q || p) and the log-likelihood of the actions under a sample of q, [B] each."""
        posterior = self.encode(params, segments)
        latent = gaussian_sample(key, *posterior)
        log_likelihood = self.reconstruction(params, segments, latent)
        return gaussian_kl(*posterior, *self.prior(params, segments.observations[:, 0])), log_likelihood

    def information_loss(
        self, params: dict[str, Params], observations: jax.Array, latent: jax.Array, weight: jax.Array
    ) -> jax.Array:
        """Return mean_i w_i ||z_hat_i - z_i||^2, with z_hat the posterior mean of what skill z does (paper, eq. 5).

        The actions are decoded anew along ``observations[B, H, obs]``, so that the gradient reaches the decoder
        through them although the states carry none (they come from a rollout, or from the log).
        """
        observations = jax.lax.stop_gradient(observations)
        actions = self.decode_along(params, observations, latent)[0]
        recovered = self.encode(params, Segments(observations, actions)).mean
        return jnp.mean(weight * jnp.sum((recovered - latent) ** 2, axis=-1))

    def _pose(self, params: dict[str, Params], observation: jax.Array) -> jax.Array:
        return self.view.pose(params.get("view", {}), observation)

    def _see(self, params: dict[str, Params], observation: jax.Array, pose: jax.Array) -> jax.Array:
        return self.view.see(params.get("view", {}), observation, pose)
