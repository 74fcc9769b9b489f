"""Observations of experts: the body, and a ball, in a frame whose x axis is the commanded direction.

In this frame, walking along any direction looks the same. A policy that sees nothing else knows for all directions what
it learns for one. It does not see its position.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

ANT_NQ, ANT_NV = 15, 14


def to_direction_frame(vector: jax.Array, direction: jax.Array) -> jax.Array:
    """Rotate ``vector[..., 2 or 3]`` from the world to the frame with ``direction[..., 2]`` (a unit vector) as x."""
    cos, sin = direction[..., 0:1], direction[..., 1:2]
    x, y = vector[..., 0:1], vector[..., 1:2]
    return jnp.concatenate([cos * x + sin * y, cos * y - sin * x, vector[..., 2:]], axis=-1)


def to_world_frame(vector: jax.Array, direction: jax.Array) -> jax.Array:
    """Rotate ``vector[..., 2 or 3]`` back: the inverse of ``to_direction_frame``."""
    return to_direction_frame(vector, direction * jnp.array([1.0, -1.0]))


def direction_of(angle: jax.Array) -> jax.Array:
    """Return the unit vector[..., 2] at ``angle[...]`` (rad) from +x."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def random_direction(key: jax.Array) -> jax.Array:
    """Draw a unit vector[2], uniformly over the circle."""
    return direction_of(jax.random.uniform(key, (), minval=-jnp.pi, maxval=jnp.pi))


def forward_axis(qpos: jax.Array) -> jax.Array:
    """Return the root's own x axis in the world, [..., 3]."""
    w, x, y, z = _unit_quaternion(qpos)
    return jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)


def body_view(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """Compute the proprioception of a body with a free root and k joints.

    Args:
        qpos: [..., 7 + k] x, y, z, quaternion, joints.
        qvel: [..., 6 + k] velocities (linear in the world frame, angular in the body frame, joints).
        direction: [..., 2] unit vector in the world frame.

    Returns:
        [..., 13 + 2 k]: height, the body's x and z axes in the direction's frame, joints, linear velocity in the
        direction's frame, angular velocity, joint velocities.
    """
    w, x, y, z = _unit_quaternion(qpos)
    upward = jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    return jnp.concatenate(
        [
            qpos[..., 2:3],
            to_direction_frame(forward_axis(qpos), direction),
            to_direction_frame(upward, direction),
            qpos[..., 7:],
            to_direction_frame(qvel[..., :3], direction),
            qvel[..., 3:6],
            qvel[..., 6:],
        ],
        axis=-1,
    )


def ball_view(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """Return [..., 6], the ball's offset from the ant and its velocity, in the direction's frame.

    Args:
        qpos: [..., 22] of an ant with a ball.
        qvel: [..., 20].
        direction: [..., 2] unit vector in the world frame.
    """
    offset = qpos[..., ANT_NQ : ANT_NQ + 3] - qpos[..., :3]
    velocity = qvel[..., ANT_NV : ANT_NV + 3]
    return jnp.concatenate([to_direction_frame(offset, direction), to_direction_frame(velocity, direction)], axis=-1)


def uprightness(qpos: jax.Array) -> jax.Array:
    """Return the cosine between the root's z axis and the vertical, [...]."""
    quat = qpos[..., 3:7]
    x, y = quat[..., 1], quat[..., 2]
    return 1 - 2 * (x * x + y * y) / (jnp.sum(quat**2, axis=-1) + 1e-8)


def _unit_quaternion(qpos: jax.Array) -> jax.Array:
    """Return the root's w, x, y, z along the first axis, [4, ...]."""
    quat = qpos[..., 3:7]
    return jnp.moveaxis(quat / (jnp.linalg.norm(quat, axis=-1, keepdims=True) + 1e-8), -1, 0)
