"""Vectors, wherever they are needed."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def unit_vector(vector: jax.Array) -> jax.Array:
    """Return ``vector[..., d]`` over its length, which is taken as at least 1e-6: zero stays zero."""
    return vector / jnp.maximum(jnp.linalg.norm(vector, axis=-1, keepdims=True), 1e-6)
