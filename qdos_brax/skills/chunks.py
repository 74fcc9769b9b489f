"""Low-level policies that play a whole chunk of actions without looking: the actions themselves, or noise of a flow."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from qdos_brax.nn.networks import gaussian_log_prob
from qdos_brax.skills.flow_policy import FlowPolicy
from qdos_brax.skills.latent_map import MARGIN
from qdos_brax.skills.low_level import AnywhereSkills, Box
from qdos_brax.skills.vae import Posterior, Segments


class ActionChunks(AnywhereSkills):
    """Play no skills: u is a chunk of H actions itself; of one action where H is 1 (RLPD, ExPLORe).

    Args:
        action_dim: width of actions.
        horizon: H, actions per chunk.
    """

    def __init__(self, action_dim: int, horizon: int = 1) -> None:
        self.width, self._action_dim, self._horizon = horizon * action_dim, action_dim, horizon

    def posterior(self, params: Any, segments: Segments, after: jax.Array) -> Posterior:
        """Return the segment's own actions."""
        chunk = segments.actions[:, : self._horizon].reshape(-1, self.width)
        return Posterior(chunk, jnp.full_like(chunk, -jnp.inf))

    def to_latent(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return z = u."""
        return action

    def to_action(self, params: Any, latent: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return u = z, where the actor's density is finite."""
        return jnp.clip(latent, -1 + MARGIN, 1 - MARGIN)

    def first(self, params: Any, key: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return actions, uniform over the box."""
        return jax.random.uniform(key, (*observation.shape[:-1], self.width), minval=-1.0)

    def log_prior(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return the log density of the uniform distribution."""
        return jnp.full(action.shape[:-1], -self.width * jnp.log(2.0))

    def act(self, params: Any, observation: jax.Array, skill: jax.Array, step: jax.Array | int) -> jax.Array:
        """Return the action of the chunk whose turn it is."""
        return action_of(skill, self._action_dim, step)


class NoiseChunks:
    """Play chunks of actions by the noise from which a frozen flow policy makes them (DSRL, Wagenmaker et al. 2025).

    z is the noise, u = z / c within a box of half side c, and a chunk is made once, where it begins.

    Args:
        flow: over chunks of H actions.
        action_dim: width of actions.
    """

    reach: int | None = None

    def __init__(self, flow: FlowPolicy, action_dim: int) -> None:
        self.width, self._flow, self._action_dim = flow.action_dim, flow, action_dim

    def posterior(self, params: Any, segments: Segments, after: jax.Array) -> Posterior:
        """Return the noise that the flow makes the segment's actions of."""
        chunk = segments.actions.reshape(-1, self.width)
        noise = self._flow.recover(params["flow"], segments.observations[:, 0], chunk)
        return Posterior(noise, jnp.full_like(noise, -jnp.inf))

    def to_latent(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return z = c u."""
        return box * action

    def to_action(self, params: Any, latent: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return u = z / c, clipped into the box."""
        return jnp.clip(latent / box, -1 + MARGIN, 1 - MARGIN)

    def first(self, params: Any, key: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return u of Gaussian noise: the flow policy as it was learned, but for what the box cuts off."""
        noise = jax.random.normal(key, (*observation.shape[:-1], self.width))
        return self.to_action(params, noise, observation, box)

    def log_prior(self, params: Any, action: jax.Array, observation: jax.Array, box: Box) -> jax.Array:
        """Return the log density at u of Gaussian noise, log N(c u; 0, 1) + d log c."""
        noise = box * action
        zero = jnp.zeros_like(noise)
        return gaussian_log_prob(noise, zero, zero) + self.width * jnp.log(box)

    def begin(self, params: Any, latent: jax.Array, observation: jax.Array) -> jax.Array:
        """Return the noise, and behind it the chunk that it becomes."""
        return jnp.concatenate([latent, self._flow.play(params["flow"], observation, latent)], axis=-1)

    def act(self, params: Any, observation: jax.Array, skill: jax.Array, step: jax.Array | int) -> jax.Array:
        """Return the action of the chunk whose turn it is."""
        return action_of(skill[..., self.width :], self._action_dim, step)


def action_of(chunk: jax.Array, action_dim: int, step: jax.Array | int) -> jax.Array:
    """Return action ``step`` of chunk[..., H * action_dim], [..., action_dim]."""
    return jax.lax.dynamic_slice_in_dim(chunk, step * action_dim, action_dim, axis=-1)
