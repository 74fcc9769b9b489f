"""Mends MJX's plane-capsule contact frames.

MuJoCo C takes the capsule's axis, projected into the plane, as the contact's first tangent, however steep the capsule
stands. MJX (up to 3.17) falls back to a fixed tangent when the *projected* axis is shorter than 0.5, that is, when the
capsule is within 30 degrees of the normal. C tests the length before it projects. The friction pyramid is then turned
about the normal, and the step is wrong: for an ant, in 38 % of all states. ``exact_frames`` puts C's frame in place
while a function of ours is traced, and leaves MJX as it was.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import collision_driver

_PLANE_CAPSULE = (mjx.GeomType.PLANE, mjx.GeomType.CAPSULE)


@contextmanager
def exact_frames() -> Iterator[None]:
    """While active, functions traced by jax collide planes and capsules as MuJoCo C does."""
    table = collision_driver._COLLISION_FUNC
    upstream = table[_PLANE_CAPSULE]
    table[_PLANE_CAPSULE] = _with_exact_frame(upstream)
    try:
        yield
    finally:
        table[_PLANE_CAPSULE] = upstream


def capsule_tangent_frame(normal: jax.Array, axis: jax.Array) -> jax.Array:
    """MuJoCo C's contact frame float[3, 3] (rows: normal, two tangents) of a capsule on a plane.

    Args:
        normal: float[3], the plane's unit normal.
        axis: float[3], the capsule's unit axis.
    """
    tangent = axis - normal * jnp.dot(normal, axis)
    length = jnp.linalg.norm(tangent)
    tangent = jnp.where(length > 0, tangent / jnp.where(length > 0, length, 1.0), jnp.array([1.0, 0.0, 0.0]))
    return jnp.stack([normal, tangent, jnp.cross(normal, tangent)])


def _with_exact_frame(upstream: Any) -> Any:
    def collide(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        dist, pos, _ = upstream(model, data, key, geom)
        plane, capsule = geom.T
        frame = jax.vmap(capsule_tangent_frame)(data.geom_xmat[plane][:, :, 2], data.geom_xmat[capsule][:, :, 2])
        return dist, pos, jnp.repeat(frame, upstream.ncon, axis=0)  # both ends of a capsule share its frame

    collide.ncon = upstream.ncon  # type: ignore[attr-defined]
    return collide
