"""Poses of the humanoid: standing, and whether it is still up."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from qdos_brax.collection.experts.views import uprightness

STANDING = 1.29
"""Height of a standing humanoid's torso, m."""


def standing_humanoid(key: jax.Array, yaw: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draw (qpos[28], qvel[27]) of a humanoid on its feet at the origin, facing ``yaw`` (rad), joints slightly bent."""
    root = jnp.stack([0.0, 0.0, STANDING, jnp.cos(yaw / 2), 0.0, 0.0, jnp.sin(yaw / 2)])
    return jnp.concatenate([root, jax.random.uniform(key, (21,), minval=-0.05, maxval=0.05)]), jnp.zeros(27)


def humanoid_is_up(qpos: jax.Array) -> jax.Array:
    """Return bool[...]: the torso is at least 0.9 m high and within 60 degrees of the vertical."""
    return (qpos[..., 2] > 0.9) & (uprightness(qpos) > 0.5)
