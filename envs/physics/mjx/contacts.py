"""Find contacts as MuJoCo C does, where MJX (3.17) finds others.

- *Plane and capsule.* C takes the capsule's axis, projected into the plane, as the contact's first tangent, however
  steep the capsule stands. MJX falls back to a fixed tangent once the *projected* axis is shorter than 0.5, that is,
  within 30 degrees of the normal (C tests the length before it projects). The friction pyramid is then turned about
  the normal, and the step is wrong: for a walking ant in more than a third of all states.
- *Sphere or capsule and box.* MJX has no contact before the geoms overlap; C has one as soon as they are within the
  margin. Here both are reckoned from the nearest points, as in C.
- *Sphere or capsule and capsule.* MJX adds 1e-6 to a squared length before it divides by it, which moves the nearest
  points of limbs 0.2 m long by a part in 100,000, in float64 too. Light feet and hands make accelerations of that: the
  humanoid's step was wrong by up to 1e-4.

``COLLIDERS`` has these, and MJX's own functions for all other pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import collision_driver

# (distance, position[3], frame[3, 3]) of one contact; frame rows: normal from the first geom to the second, tangents
Contact = tuple[jax.Array, jax.Array, jax.Array]

Vector = Sequence[Any]
"""The arrays x, y and z: apart from each other, so that all of this becomes one loop over many pairs at a time."""

_NONE = 1.0  # distance of a contact that is none


def plane_capsule_frame(normal: jax.Array, axis: jax.Array) -> jax.Array:
    """Return the contact frame float[3, 3] of a capsule on a plane.

    Args:
        normal: float[3], the plane's unit normal.
        axis: float[3], the capsule's unit axis.
    """
    tangent = axis - normal * jnp.dot(normal, axis)
    length = jnp.linalg.norm(tangent)
    tangent = jnp.where(length > 0, tangent / jnp.where(length > 0, length, 1.0), jnp.array([1.0, 0.0, 0.0]))
    return jnp.stack([normal, tangent, jnp.cross(normal, tangent)])


def sphere_box(centre: Vector, radius: jax.Array, half_size: Vector) -> tuple[jax.Array, Vector, Vector]:
    """Return distance, position and normal of the contact of a sphere with a box, in the box's frame.

    Args:
        centre: of the sphere.
        radius: float[].
        half_size: of the box.
    """
    away = [jnp.clip(c, -h, h) - c for c, h in zip(centre, half_size, strict=True)]
    gap = jnp.sqrt(_dot(away, away))
    outside = gap > 0
    # centre inside the box: out through the nearest face
    depths = [h - jnp.abs(c) for c, h in zip(centre, half_size, strict=True)]
    depth = reduce(jnp.minimum, depths)
    is_face = (depths[0] == depth, depths[1] == depth, depths[2] == depth)
    first = (is_face[0], is_face[1] & ~is_face[0], is_face[2] & ~is_face[1] & ~is_face[0])
    inwards = (jnp.where(f, jnp.where(c < 0, 1.0, -1.0), 0.0) for f, c in zip(first, centre, strict=True))
    length = jnp.where(outside, gap, 1.0)
    normal = [jnp.where(outside, a / length, i) for a, i in zip(away, inwards, strict=True)]
    distance = jnp.where(outside, gap, -depth) - radius
    return distance, _go(centre, radius + distance / 2, normal), normal


def capsule_box(
    centre: Vector, half_axis: Vector, radius: jax.Array, half_size: Vector
) -> list[tuple[jax.Array, Vector, Vector]]:
    """Return distance, position and normal of both contacts of a capsule with a box, in the box's frame.

    One at the point of the capsule's segment nearest to the box, and a second one further along, so that a capsule
    along a wall is held at two points. MuJoCo C's choice of the second, for boxes that are large against the capsule:

    - nearest to a face: where the segment ceases to lie over that face, or its other end;
    - nearest to an edge: the end towards which the segment draws in along the longer of its two components across the
      edge, and only if it draws away along the other.

    Args:
        centre: of the capsule.
        half_axis: from the centre to one end of the segment.
        radius: float[].
        half_size: of the box.
    """
    start = _go(centre, -1.0, half_axis)
    end_inside = reduce(jnp.logical_and, (jnp.abs(s) <= h for s, h in zip(start, half_size, strict=True)))
    # an axis that begins in the box: one end will do
    first = jnp.where(end_inside, -1.0, _nearest_on_segment(centre, half_axis, half_size))
    point = _go(centre, first, half_axis)
    outside = [jnp.abs(p) > h for p, h in zip(point, half_size, strict=True)]
    at_face = sum(o.astype(jnp.int32) for o in outside) == 1

    spans = [_span(*axis) for axis in zip(centre, half_axis, half_size, strict=True)]
    low = reduce(jnp.maximum, (jnp.where(o, -1.0, span[0]) for o, span in zip(outside, spans, strict=True)))
    high = reduce(jnp.minimum, (jnp.where(o, 1.0, span[1]) for o, span in zip(outside, spans, strict=True)))
    low, high = jnp.clip(low, -1.0, 1.0), jnp.clip(high, -1.0, 1.0)
    beyond_face = jnp.where(first - low > high - first, low, high)

    draws_in = [(a * p < 0) & o for a, p, o in zip(half_axis, point, outside, strict=True)]  # going towards t = 1
    across = [jnp.where(o, jnp.abs(a), -1.0) for a, o in zip(half_axis, outside, strict=True)]
    longest_draws_in, longest = draws_in[0], across[0]
    for draws, length in zip(draws_in[1:], across[1:], strict=True):
        longest_draws_in = jnp.where(length > longest, draws, longest_draws_in)
        longest = jnp.maximum(longest, length)
    beyond_edge = jnp.where(longest_draws_in, high, low)

    second = jnp.where(at_face, beyond_face, beyond_edge)
    has_second = at_face | (sum(d.astype(jnp.int32) for d in draws_in) == 1)
    near = sphere_box(point, radius, half_size)
    far = sphere_box(_go(centre, second, half_axis), radius, half_size)
    return [near, (jnp.where(has_second, far[0], _NONE), *far[1:])]


def nearest_of_capsules(apart: Vector, half_axis_1: Vector, half_axis_2: Vector) -> tuple[jax.Array, jax.Array]:
    """Return where two segments are nearest: (t_1, t_2) in [-1, 1], of ``centre + t * half_axis`` on each, as C has it.

    First on the one, with the other a line, then on the other; axes that are not parallel.

    Args:
        apart: from the second centre to the first.
        half_axis_1: from the first's centre to one end of its segment.
        half_axis_2: the second's.
    """
    square_1, product, square_2 = (
        _dot(half_axis_1, half_axis_1),
        _dot(half_axis_1, half_axis_2),
        _dot(half_axis_2, half_axis_2),
    )
    along_1, along_2 = -_dot(half_axis_1, apart), _dot(half_axis_2, apart)
    normal = _cross(half_axis_1, half_axis_2)
    determinant = _dot(normal, normal)  # not square_1 * square_2 - product**2, for rounding
    crossing = square_2 * along_1 + product * along_2
    first = jnp.clip(crossing / jnp.where(determinant > 0, determinant, 1.0), -1.0, 1.0)
    free = (along_2 + product * first) / square_2
    second = jnp.clip(free, -1.0, 1.0)
    first_again = jnp.clip((along_1 + product * second) / square_1, -1.0, 1.0)
    return jnp.where(second == free, first, first_again), second


def _nearest_on_segment(centre: Vector, half_axis: Vector, half_size: Vector) -> jax.Array:
    """Return the t in [-1, 1] for which ``centre + t * half_axis`` is nearest to the box.

    The derivative of half the squared distance rises with t and is linear between the values of t at which a
    coordinate enters or leaves the box's range: its root lies between two neighbouring ones.
    """
    one = jnp.ones_like(centre[0])
    breaks = [-one, one]
    for axis in zip(centre, half_axis, half_size, strict=True):
        breaks += [jnp.clip(t, -1.0, 1.0) for t in _span(*axis)]
    low, high, rise_low, rise_high = -one, one, -jnp.inf * one, jnp.inf * one
    for t in breaks:
        rise = sum(
            (p - jnp.clip(p, -h, h)) * a
            for p, a, h in zip(_go(centre, t, half_axis), half_axis, half_size, strict=True)
        )
        before = rise <= 0
        low, high = jnp.where(before, jnp.maximum(low, t), low), jnp.where(before, high, jnp.minimum(high, t))
        rise_low = jnp.where(before, jnp.maximum(rise_low, rise), rise_low)
        rise_high = jnp.where(before, rise_high, jnp.minimum(rise_high, rise))
    some, all_ = jnp.isfinite(rise_low), ~jnp.isfinite(rise_high)
    between = low - rise_low * (high - low) / jnp.where(rise_high > rise_low, rise_high - rise_low, 1.0)
    return jnp.where(all_, 1.0, jnp.where(some, between, -1.0))


def _span(centre: jax.Array, half_axis: jax.Array, half_size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return between which t one coordinate of ``centre + t * half_axis`` is within the box."""
    slope = jnp.where(jnp.abs(half_axis) > 1e-9, half_axis, 1e-9)
    ends = (-half_size - centre) / slope, (half_size - centre) / slope
    return jnp.minimum(*ends), jnp.maximum(*ends)


def _go(start: Vector, t: jax.Array | float, way: Vector) -> Vector:
    """Return start + t way."""
    return [s + t * w for s, w in zip(start, way, strict=True)]


def _dot(a: Vector, b: Vector) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _frame(x: jax.Array, y: jax.Array, z: jax.Array) -> jax.Array:
    """Return MuJoCo's contact frame [..., 3, 3] about the normal (x, y, z)[...], with its choice of tangents."""
    by_y = jnp.abs(y) < 0.5
    along = jnp.where(by_y, y, z)
    tangent = -x * along, jnp.where(by_y, 1.0, 0.0) - y * along, jnp.where(by_y, 0.0, 1.0) - z * along
    length = jnp.sqrt(_dot(tangent, tangent))
    a, b, c = (t / length for t in tangent)
    rows = (x, y, z), (a, b, c), _cross((x, y, z), (a, b, c))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _collide_plane_capsule(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> Contact:
    distance, position, _ = _UPSTREAM_PLANE_CAPSULE(model, data, key, geom)
    plane, capsule = geom.T
    frame = jax.vmap(plane_capsule_frame)(data.geom_xmat[plane][:, :, 2], data.geom_xmat[capsule][:, :, 2])
    return distance, position, jnp.repeat(frame, 2, axis=0)  # both ends of a capsule share its frame


def _collide_sphere_box(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> Contact:
    sphere, box = geom.T
    turn, centre = _in_box(data, data.geom_xpos[sphere], box)
    half_size = _components(model.geom_size[box])
    return _to_world(data, box, turn, [sphere_box(centre, model.geom_size[sphere, 0], half_size)])


def _collide_capsule_box(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> Contact:
    capsule, box = geom.T
    turn, centre = _in_box(data, data.geom_xpos[capsule], box)
    axis = _half_axis(model, data, capsule)
    half_axis = [_dot(column, axis) for column in zip(*turn, strict=True)]
    radius, half_size = model.geom_size[capsule, 0], _components(model.geom_size[box])
    return _to_world(data, box, turn, capsule_box(centre, half_axis, radius, half_size))


def _collide_sphere_capsule(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> Contact:
    sphere, capsule = geom.T
    half_axis = _half_axis(model, data, capsule)
    centre, own = _components(data.geom_xpos[sphere]), _components(data.geom_xpos[capsule])
    apart = _go(centre, -1.0, own)
    nearest = _go(own, jnp.clip(_dot(apart, half_axis) / _dot(half_axis, half_axis), -1.0, 1.0), half_axis)
    return _touching_spheres(model, geom, centre, nearest)


def _collide_capsules(model: mjx.Model, data: mjx.Data, key: Any, geom: jax.Array) -> Contact:
    axes = [_half_axis(model, data, capsule) for capsule in geom.T]
    centres = [_components(data.geom_xpos[capsule]) for capsule in geom.T]
    nearest = nearest_of_capsules(_go(centres[0], -1.0, centres[1]), *axes)
    return _touching_spheres(model, geom, *map(_go, centres, nearest, axes))


def _half_axis(model: mjx.Model, data: mjx.Data, capsule: jax.Array) -> Vector:
    """Return the way from the centres of capsules to one end of their segments."""
    return [model.geom_size[capsule, 1] * part for part in _components(data.geom_xmat[capsule][:, :, 2])]


def _touching_spheres(model: mjx.Model, geom: jax.Array, centre_1: Vector, centre_2: Vector) -> Contact:
    """Return one contact per pair, between spheres with the radii of ``geom[P, 2]``."""
    between = _go(centre_2, -1.0, centre_1)
    gap = jnp.sqrt(_dot(between, between))
    normal = [
        jnp.where(gap > 0, part / jnp.where(gap > 0, gap, 1.0), axis)
        for part, axis in zip(between, (1, 0, 0), strict=True)
    ]
    radius_1, radius_2 = model.geom_size[geom, 0].T
    distance = gap - radius_1 - radius_2
    position = jnp.stack(_go(centre_1, radius_1 + distance / 2, normal), axis=-1)
    return distance, position, _frame(*normal)


def _in_box(data: mjx.Data, points: jax.Array, box: jax.Array) -> tuple[list[Vector], Vector]:
    """Return the rows of each box's rotation matrix, and each of ``points[P, 3]`` in its frame."""
    turn = [_components(data.geom_xmat[box][:, row]) for row in range(3)]
    offset = _components(points - data.geom_xpos[box])
    return turn, [_dot(column, offset) for column in zip(*turn, strict=True)]


def _components(vectors: jax.Array) -> Vector:
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def _to_world(
    data: mjx.Data, box: jax.Array, turn: list[Vector], found: list[tuple[jax.Array, Vector, Vector]]
) -> Contact:
    """Return contacts in the boxes' frames, a component [P] per array, as MJX has them: one pair after the other."""
    distance = jnp.stack([contact[0] for contact in found], axis=-1)
    position = jnp.stack([jnp.stack([_dot(row, c[1]) for row in turn], axis=-1) for c in found], axis=-2)
    position = position + data.geom_xpos[box][:, None]
    frame = jnp.stack([_frame(*(_dot(row, contact[2]) for row in turn)) for contact in found], axis=-3)
    return distance.reshape(-1), position.reshape(-1, 3), frame.reshape(-1, 3, 3)


def _collider(function: Callable[..., Contact], contacts: int) -> Callable[..., Contact]:
    function.ncon = contacts  # type: ignore[attr-defined]  # what MJX asks a collision function for
    return function


_UPSTREAM_PLANE_CAPSULE = collision_driver._COLLISION_FUNC[mjx.GeomType.PLANE, mjx.GeomType.CAPSULE]

COLLIDERS = {
    **collision_driver._COLLISION_FUNC,
    (mjx.GeomType.PLANE, mjx.GeomType.CAPSULE): _collider(_collide_plane_capsule, 2),
    (mjx.GeomType.SPHERE, mjx.GeomType.CAPSULE): _collider(_collide_sphere_capsule, 1),
    (mjx.GeomType.CAPSULE, mjx.GeomType.CAPSULE): _collider(_collide_capsules, 1),
    (mjx.GeomType.SPHERE, mjx.GeomType.BOX): _collider(_collide_sphere_box, 1),
    (mjx.GeomType.CAPSULE, mjx.GeomType.BOX): _collider(_collide_capsule_box, 2),
}
"""By the kinds of two geoms: (model, data, key, pairs int[P, 2]) -> contacts, ``ncon`` of them per pair."""
