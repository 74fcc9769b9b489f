"""Between the high level's action u in (-1, 1) and the decoder's latent z."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

MARGIN = 1e-5  # labels stay this far inside the box, where arctanh and the actor's density are finite (SUPE)


class Prior(NamedTuple):
    """Hold p(z | s) where the skill starts: mean[..., d] and log standard deviation[..., d]."""

    mean: jax.Array
    log_std: jax.Array


class LatentMap(Protocol):
    """Define a bijection of (-1, 1)^d onto the latents that the high level can play in a state."""

    def to_latent(self, action: jax.Array, prior: Prior) -> jax.Array:
        """Return z[..., d] of u[..., d]."""
        ...

    def to_action(self, latent: jax.Array, prior: Prior) -> jax.Array:
        """Return u[..., d] of z[..., d], clipped into the box."""
        ...

    def log_jacobian(self, action: jax.Array, prior: Prior) -> jax.Array:
        """Return log |dz / du| [...], summed over the d dimensions."""
        ...


class ArctanhMap:
    """Map by z = arctanh(u): every latent can be played (SUPE)."""

    def to_latent(self, action: jax.Array, prior: Prior) -> jax.Array:
        """Return z = arctanh(u)."""
        return jnp.arctanh(_inside(action))

    def to_action(self, latent: jax.Array, prior: Prior) -> jax.Array:
        """Return u = tanh(z)."""
        return _inside(jnp.tanh(latent))

    def log_jacobian(self, action: jax.Array, prior: Prior) -> jax.Array:
        """Return -sum log(1 - u^2)."""
        return -jnp.sum(jnp.log1p(-(_inside(action) ** 2)), axis=-1)


class BoxMap:
    """Map by z = c u: the box that random skills are drawn from in pretraining.

    Args:
        half_side: c, a number or an array that broadcasts to the latents.
    """

    def __init__(self, half_side: jax.Array | float) -> None:
        self._half_side = half_side

    def to_latent(self, action: jax.Array, prior: Prior) -> jax.Array:
        """Return z = c u."""
        return self._half_side * action

    def to_action(self, latent: jax.Array, prior: Prior) -> jax.Array:
        """Return u = z / c."""
        return _inside(latent / self._half_side)

    def log_jacobian(self, action: jax.Array, prior: Prior) -> jax.Array:
        """Return d log c."""
        return jnp.sum(jnp.broadcast_to(jnp.log(self._half_side), action.shape), axis=-1)


class PriorMap:
    """Map by z = mean(s) + c std(s) u: the skills that the prior holds for likely in this state.

    The learned prior leaves the scale of z free, so that a fixed map may reach far outside the skills that exist; what
    the decoder does there is arbitrary, and an actor that saturates gets stuck. This map cannot leave them. (SPiRL,
    Pertsch et al. 2020, holds the high level near the prior by a penalty instead.)

    Args:
        half_side: c, in standard deviations of the prior.
    """

    def __init__(self, half_side: jax.Array | float) -> None:
        self._half_side = half_side

    def to_latent(self, action: jax.Array, prior: Prior) -> jax.Array:
        """Return z = mean + c std u."""
        return prior.mean + self._half_side * jnp.exp(prior.log_std) * action

    def to_action(self, latent: jax.Array, prior: Prior) -> jax.Array:
        """Return u = (z - mean) / (c std)."""
        return _inside((latent - prior.mean) * jnp.exp(-prior.log_std) / self._half_side)

    def log_jacobian(self, action: jax.Array, prior: Prior) -> jax.Array:
        """Return d log c + sum log std."""
        return jnp.sum(jnp.log(self._half_side) + prior.log_std, axis=-1)


def latent_map(name: str, half_side: jax.Array | float) -> LatentMap:
    """Return the map called "arctanh", "box" or "prior"."""
    if name == "arctanh":
        return ArctanhMap()
    return BoxMap(half_side) if name == "box" else PriorMap(half_side)


def _inside(action: jax.Array) -> jax.Array:
    return jnp.clip(action, -1 + MARGIN, 1 - MARGIN)
