"""What experts see: the body, and a ball, in a frame whose x axis is the commanded direction.

Walking along a direction looks the same for every direction once the world is turned so that the direction is +x.
A policy that sees only that turned world knows for all directions what it learns for one. It does not see where it is.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

ANT_NQ, ANT_NV = 15, 14
BALL_VIEW_DIM = 6


def turned(vector: jax.Array, direction: jax.Array) -> jax.Array:
    """``vector[..., 2 or 3]`` of the world, seen with ``direction[..., 2]`` (a unit vector) as x axis."""
    cos, sin = direction[..., 0:1], direction[..., 1:2]
    x, y = vector[..., 0:1], vector[..., 1:2]
    return jnp.concatenate([cos * x + sin * y, cos * y - sin * x, vector[..., 2:]], axis=-1)


def turned_back(vector: jax.Array, direction: jax.Array) -> jax.Array:
    """``vector[..., 2 or 3]`` as it is in the world, where it is given as ``turned`` by ``direction[..., 2]``."""
    return turned(vector, direction * jnp.array([1.0, -1.0]))


def forward_axis(qpos: jax.Array) -> jax.Array:
    """[..., 3], the root's own x axis in the world."""
    w, x, y, z = _unit_quaternion(qpos)
    return jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)


def body_view(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """Proprioception of a body with a free root and k joints.

    Args:
        qpos: [..., 7 + k] x, y, z, quaternion, joints.
        qvel: [..., 6 + k] velocities (linear in the world frame, angular in the body frame, joints).
        direction: [..., 2] unit vector in the world frame.

    Returns:
        [..., 13 + 2 k]: height, two columns of the turned rotation matrix, joints, turned linear velocity, angular
        velocity, joint velocities.
    """
    w, x, y, z = _unit_quaternion(qpos)
    upward = jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    return jnp.concatenate(
        [
            qpos[..., 2:3],
            turned(forward_axis(qpos), direction),
            turned(upward, direction),
            qpos[..., 7:],
            turned(qvel[..., :3], direction),
            qvel[..., 3:6],
            qvel[..., 6:],
        ],
        axis=-1,
    )


def ball_view(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """[..., 6]: the ball of an ant with ball (qpos 22, qvel 20), seen from the ant: turned offset, turned velocity."""
    offset = qpos[..., ANT_NQ : ANT_NQ + 3] - qpos[..., :3]
    return jnp.concatenate([turned(offset, direction), turned(qvel[..., ANT_NV : ANT_NV + 3], direction)], axis=-1)


def uprightness(qpos: jax.Array) -> jax.Array:
    """[...], the cosine between the root's z axis and the vertical."""
    quat = qpos[..., 3:7]
    x, y = quat[..., 1], quat[..., 2]
    return 1 - 2 * (x * x + y * y) / (jnp.sum(quat**2, axis=-1) + 1e-8)


def random_direction(key: jax.Array) -> jax.Array:
    """A unit vector[2], uniform over the circle."""
    angle = jax.random.uniform(key, (), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _unit_quaternion(qpos: jax.Array) -> jax.Array:
    """The root's w, x, y, z, [4, ...]."""
    quat = qpos[..., 3:7]
    return jnp.moveaxis(quat / (jnp.linalg.norm(quat, axis=-1, keepdims=True) + 1e-8), -1, 0)
