"""Between the high level's action u in (-1, 1) and the decoder's latent z."""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp

MARGIN = 1e-5  # labels stay this far inside the box, where arctanh and the actor's density are finite (SUPE)


class LatentMap(Protocol):
    """A bijection of (-1, 1)^d onto the latents that the high level can play."""

    def to_latent(self, action: jax.Array) -> jax.Array:
        """z[..., d] of u[..., d]."""
        ...

    def to_action(self, latent: jax.Array) -> jax.Array:
        """u[..., d] of z[..., d], clipped into the box."""
        ...


class ArctanhMap:
    """z = arctanh(u): every latent can be played (SUPE)."""

    def to_latent(self, action: jax.Array) -> jax.Array:
        """z = arctanh(u)."""
        return jnp.arctanh(jnp.clip(action, -1 + MARGIN, 1 - MARGIN))

    def to_action(self, latent: jax.Array) -> jax.Array:
        """u = tanh(z)."""
        return jnp.clip(jnp.tanh(latent), -1 + MARGIN, 1 - MARGIN)


class BoxMap:
    """z = c u: the box that random skills are drawn from in pretraining.

    Args:
        half_side: c, a number or an array that broadcasts to the latents.
    """

    def __init__(self, half_side: jax.Array | float) -> None:
        self._half_side = half_side

    def to_latent(self, action: jax.Array) -> jax.Array:
        """z = c u."""
        return self._half_side * action

    def to_action(self, latent: jax.Array) -> jax.Array:
        """u = z / c."""
        return jnp.clip(latent / self._half_side, -1 + MARGIN, 1 - MARGIN)


def latent_map(name: str, half_side: jax.Array | float) -> LatentMap:
    """The map called "arctanh" or "box"."""
    return ArctanhMap() if name == "arctanh" else BoxMap(half_side)
