"""Contacts as MuJoCo C finds them, where MJX (3.17) finds others.

- *Plane and capsule.* C takes the capsule's axis, projected into the plane, as the contact's first tangent, however
  steep the capsule stands. MJX falls back to a fixed tangent once the *projected* axis is shorter than 0.5, that is,
  within 30 degrees of the normal (C tests the length before it projects). The friction pyramid is then turned about
  the normal, and the step is wrong: for a walking ant in more than a third of all states.
- *Sphere or capsule and box.* MJX has no contact before the geoms overlap; C has one as soon as they are within the
  margin. Here both are reckoned from the nearest points, as in C.

``exact_contacts`` puts these in place while a function of ours is traced, and leaves MJX as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import collision_driver

# (distance, position[3], frame[3, 3]) of one contact; frame rows: normal from the first geom to the second, tangents
Contact = tuple[jax.Array, jax.Array, jax.Array]

_NONE = 1.0  # distance of a contact that is none


@contextmanager
def exact_contacts() -> Iterator[None]:
    """While active, functions traced by jax find the contacts above as MuJoCo C does."""
    table = collision_driver._COLLISION_FUNC
    upstream = {pair: table[pair] for pair in _EXACT}
    table.update(_EXACT)
    try:
        yield
    finally:
        table.update(upstream)


def plane_capsule_frame(normal: jax.Array, axis: jax.Array) -> jax.Array:
    """Contact frame float[3, 3] of a capsule on a plane.

    Args:
        normal: float[3], the plane's unit normal.
        axis: float[3], the capsule's unit axis.
    """
    tangent = axis - normal * jnp.dot(normal, axis)
    length = jnp.linalg.norm(tangent)
    tangent = jnp.where(length > 0, tangent / jnp.where(length > 0, length, 1.0), jnp.array([1.0, 0.0, 0.0]))
    return jnp.stack([normal, tangent, jnp.cross(normal, tangent)])


def sphere_box(centre: jax.Array, radius: jax.Array, half_size: jax.Array) -> Contact:
    """The contact of a sphere with a box, in the box's frame.

    Args:
        centre: float[3], of the sphere.
        radius: float[].
        half_size: float[3], of the box.
    """
    nearest = jnp.clip(centre, -half_size, half_size)
    away = nearest - centre
    gap = jnp.linalg.norm(away)
    outside = gap > 0
    # centre inside the box: out through the nearest face
    depths = half_size - jnp.abs(centre)
    face = jnp.argmin(depths)
    inwards = -jax.nn.one_hot(face, 3) * jnp.where(centre[face] < 0, -1.0, 1.0)
    normal = jnp.where(outside, away / jnp.where(outside, gap, 1.0), inwards)
    distance = jnp.where(outside, gap, -depths[face]) - radius
    return distance, centre + normal * (radius + distance / 2), _frame(normal)


def capsule_box(centre: jax.Array, half_axis: jax.Array, radius: jax.Array, half_size: jax.Array) -> Contact:
    """Two contacts of a capsule with a box, in the box's frame; leading axis 2 on everything.

    One at the point of the capsule's segment nearest to the box, and a second one further along, so that a capsule
    along a wall is held at two points. MuJoCo C's choice of the second, for boxes that are large against the capsule:

    - nearest to a face: where the segment ceases to lie over that face, or its other end;
    - nearest to an edge: the end towards which the segment draws in along the longer of its two components across the
      edge, and only if it draws away along the other.

    Args:
        centre: float[3], of the capsule.
        half_axis: float[3], from the centre to one end of the segment.
        radius: float[].
        half_size: float[3], of the box.
    """
    end_inside = (jnp.abs(centre - half_axis) <= half_size).all()  # the axis itself is in the box: one end will do
    first = jnp.where(end_inside, -1.0, _nearest_on_segment(centre, half_axis, half_size))
    point = centre + first * half_axis
    outside = jnp.abs(point) > half_size
    at_face = outside.sum() == 1

    slope = jnp.where(jnp.abs(half_axis) > 1e-9, half_axis, 1e-9)
    spans = jnp.stack([(-half_size - centre) / slope, (half_size - centre) / slope])
    over_box = jnp.where(outside, jnp.array([[-1.0], [1.0]]), jnp.stack([spans.min(axis=0), spans.max(axis=0)]))
    low, high = jnp.clip(over_box[0].max(), -1.0, 1.0), jnp.clip(over_box[1].min(), -1.0, 1.0)
    beyond_face = jnp.where(first - low > high - first, low, high)

    draws_in = (half_axis * point < 0) & outside  # going towards t = 1
    longer = jnp.argmax(jnp.where(outside, jnp.abs(half_axis), -1.0))
    beyond_edge = jnp.where(draws_in[longer], high, low)

    second = jnp.where(at_face, beyond_face, beyond_edge)
    has_second = at_face | (draws_in.sum() == 1)
    at = jnp.stack([first, second])
    distance, position, frame = jax.vmap(lambda t: sphere_box(centre + t * half_axis, radius, half_size))(at)
    return distance.at[1].set(jnp.where(has_second, distance[1], _NONE)), position, frame


def _nearest_on_segment(centre: jax.Array, half_axis: jax.Array, half_size: jax.Array) -> jax.Array:
    """The t in [-1, 1] for which ``centre + t * half_axis`` is nearest to the box.

    The derivative of half the squared distance rises with t and is linear between the values of t at which a
    coordinate enters or leaves the box's range: its root lies between two neighbouring ones.
    """
    slope = jnp.where(jnp.abs(half_axis) > 1e-9, half_axis, 1e-9)
    breaks = jnp.concatenate([(-half_size - centre) / slope, (half_size - centre) / slope, jnp.array([-1.0, 1.0])])
    breaks = jnp.clip(breaks, -1.0, 1.0)
    points = centre + breaks[:, None] * half_axis
    rise = (points - jnp.clip(points, -half_size, half_size)) @ half_axis
    before = rise <= 0
    low = jnp.max(jnp.where(before, breaks, -1.0))
    high = jnp.min(jnp.where(before, 1.0, breaks))
    rise_low = jnp.max(jnp.where(before, rise, -jnp.inf))
    rise_high = jnp.min(jnp.where(before, jnp.inf, rise))
    between = low - rise_low * (high - low) / jnp.where(rise_high > rise_low, rise_high - rise_low, 1.0)
    return jnp.where(before.all(), 1.0, jnp.where(before.any(), between, -1.0))


def _frame(normal: jax.Array) -> jax.Array:
    """MuJoCo's contact frame float[3, 3] about ``normal[3]``, with its choice of tangents."""
    hint = jnp.where(jnp.abs(normal[1]) < 0.5, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    tangent = hint - normal * jnp.dot(normal, hint)
    tangent = tangent / jnp.linalg.norm(tangent)
    return jnp.stack([normal, tangent, jnp.cross(normal, tangent)])


def _collide_plane_capsule(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> Contact:
    distance, position, _ = _UPSTREAM_PLANE_CAPSULE(model, data, key, geom)
    plane, capsule = geom.T
    frame = jax.vmap(plane_capsule_frame)(data.geom_xmat[plane][:, :, 2], data.geom_xmat[capsule][:, :, 2])
    return distance, position, jnp.repeat(frame, 2, axis=0)  # both ends of a capsule share its frame


def _collide_sphere_box(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> Contact:
    sphere, box = geom.T
    return jax.vmap(
        lambda centre, radius, pos, mat, size: _to_world(sphere_box(mat.T @ (centre - pos), radius, size), pos, mat)
    )(
        data.geom_xpos[sphere],
        model.geom_size[sphere, 0],
        data.geom_xpos[box],
        data.geom_xmat[box],
        model.geom_size[box],
    )


def _collide_capsule_box(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> Contact:
    capsule, box = geom.T

    def one(
        centre: jax.Array, axis: jax.Array, size: jax.Array, pos: jax.Array, mat: jax.Array, half: jax.Array
    ) -> Any:
        local = capsule_box(mat.T @ (centre - pos), mat.T @ axis * size[1], size[0], half)
        return jax.vmap(lambda contact: _to_world(contact, pos, mat))(local)

    contacts = jax.vmap(one)(
        data.geom_xpos[capsule],
        data.geom_xmat[capsule][:, :, 2],
        model.geom_size[capsule],
        data.geom_xpos[box],
        data.geom_xmat[box],
        model.geom_size[box],
    )
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), contacts)


def _to_world(contact: Contact, pos: jax.Array, mat: jax.Array) -> Contact:
    distance, position, frame = contact
    normal = mat @ frame[0]
    return distance, pos + mat @ position, _frame(normal)


def _collider(function: Callable[..., Contact], contacts: int) -> Callable[..., Contact]:
    function.ncon = contacts  # type: ignore[attr-defined]  # what MJX asks a collision function for
    return function


_UPSTREAM_PLANE_CAPSULE = collision_driver._COLLISION_FUNC[mjx.GeomType.PLANE, mjx.GeomType.CAPSULE]

_EXACT = {
    (mjx.GeomType.PLANE, mjx.GeomType.CAPSULE): _collider(_collide_plane_capsule, 2),
    (mjx.GeomType.SPHERE, mjx.GeomType.BOX): _collider(_collide_sphere_box, 1),
    (mjx.GeomType.CAPSULE, mjx.GeomType.BOX): _collider(_collide_capsule_box, 2),
}
