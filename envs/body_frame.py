"""Observations as the body sees them: from where it is, turned the way it faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import jax
import jax.numpy as jnp


class Frame(Protocol):
    """Define how a task's body sees its observations from a pose: leading axes are free."""

    @property
    def pose_size(self) -> int:
        """Return the numbers of a pose."""
        ...

    def size(self, observation_size: int) -> int:
        """Return the numbers of ``see``."""
        ...

    def pose(self, observation: jax.Array) -> jax.Array:
        """Return the pose[..., pose_size] of the body in ``observation[..., obs]``, in its own units."""
        ...

    def see(self, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return what is seen of ``observation[..., obs]`` from ``pose[..., pose_size]``."""
        ...

    def beside(self, observation: jax.Array) -> jax.Array:
        """Return float[..., k], what the body sees from its present pose and the observation does not say as it is."""
        ...


@dataclass(frozen=True)
class BodyFrame:
    """Describe which numbers of an observation move and turn with the body, by the index of the first of each.

    A pose is (x, y, cos yaw, sin yaw). Where the observation has no heading, the direction in which the body moves may
    stand for it; without either the yaw is 0 and nothing is turned.

    Attributes:
        place: x and y of the body.
        heading: the body's quaternion (w, x, y, z), or None where the observation has none.
        course: x and y parts of the velocity whose direction is taken for the heading, or None.
        points: x and y of other things in the plane.
        quaternions: of other things.
        vectors: x and y parts of velocities in the world's frame.
        levels: single numbers that no turn changes and of which it matters how they come out, such as a head's height.
    """

    place: int = 0
    heading: int | None = None
    course: int | None = None
    points: tuple[int, ...] = ()
    quaternions: tuple[int, ...] = ()
    vectors: tuple[int, ...] = ()
    levels: tuple[int, ...] = ()

    pose_size: ClassVar[int] = 4

    def size(self, observation_size: int) -> int:
        """Return the numbers of ``see``."""
        return observation_size + 2 * len(self.points)

    def pose(self, observation: jax.Array) -> jax.Array:
        """Return (x, y, cos yaw, sin yaw)[..., 4] of ``observation[..., obs]``, in its own units."""
        place = _pair(observation, self.place)
        return jnp.concatenate([place, self._facing(observation)], axis=-1)

    def see(self, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return float[..., obs + 2 points], the observation in the frame of ``pose[..., 4]``.

        Places count from the pose, and everything that has a direction is turned by minus its yaw. Behind them stands
        each other point's place as seen from the body's present one.
        """
        place, facing = pose[..., :2], pose[..., 2:]
        seen = observation
        for index in (self.place, *self.points):
            seen = _replace(seen, index, _turned(_pair(observation, index) - place, facing))
        for index in self.vectors:
            seen = _replace(seen, index, _turned(_pair(observation, index), facing))
        if self.heading is not None:
            for index in (self.heading, *self.quaternions):
                seen = _replace(seen, index, _turned_quaternion(_quaternion(observation, index), facing))
        gaps = [_pair(seen, index) - _pair(seen, self.place) for index in self.points]
        return jnp.concatenate([seen, *gaps], axis=-1)

    def beside(self, observation: jax.Array) -> jax.Array:
        """Return float[..., obs + 2 points], the observation in the body's present frame."""
        return self.see(observation, self.pose(observation))

    def gaps(self, observation: jax.Array) -> jax.Array:
        """Return float[..., points, 2], each other point's place as seen from the body's present pose, in own units."""
        place, facing = _pair(observation, self.place), self._facing(observation)
        gaps = [_turned(_pair(observation, index) - place, facing) for index in self.points]
        return jnp.stack(gaps, axis=-2) if gaps else jnp.zeros((*observation.shape[:-1], 0, 2))

    @property
    def ways_size(self) -> int:
        """Return the numbers of ``ways``."""
        return self._plane + len(self.levels)

    def ways(self, before: jax.Array, after: jax.Array) -> jax.Array:
        """Return float[..., 2 (1 + points) + levels], how far body and other points got, x and y of each in the world's
        axes, and how high the levels are then.

        Args:
            before: [..., obs], in its own units.
            after: [..., obs], likewise.
        """
        ways = [_pair(after, index) - _pair(before, index) for index in (self.place, *self.points)]
        return jnp.concatenate([*ways, self.levels_of(after)], axis=-1)

    def turned_ways(self, ways: jax.Array, pose: jax.Array) -> jax.Array:
        """Return ``ways[..., ways_size]`` as seen by a body in ``pose[..., 4]``: ahead of it, and to its left."""
        pairs = [_turned(_pair(ways, index), pose[..., 2:]) for index in range(0, self._plane, 2)]
        return jnp.concatenate([*pairs, ways[..., self._plane :]], axis=-1)

    def levels_of(self, observation: jax.Array) -> jax.Array:
        """Return float[..., levels] of ``observation[..., obs]``."""
        return observation[..., list(self.levels)] if self.levels else observation[..., :0]

    @property
    def _plane(self) -> int:
        """Return the numbers of the ways in the plane."""
        return 2 * (1 + len(self.points))

    def _facing(self, observation: jax.Array) -> jax.Array:
        """Return (cos yaw, sin yaw)[..., 2]."""
        if self.heading is not None:
            yaw = _yaw(_quaternion(observation, self.heading))
        elif self.course is not None:
            x, y = jnp.moveaxis(_pair(observation, self.course), -1, 0)
            yaw = jnp.arctan2(y, x)
        else:
            yaw = jnp.zeros(observation.shape[:-1])
        return jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)


def _pair(observation: jax.Array, index: int) -> jax.Array:
    return observation[..., index : index + 2]


def _quaternion(observation: jax.Array, index: int) -> jax.Array:
    return observation[..., index : index + 4]


def _replace(observation: jax.Array, index: int, value: jax.Array) -> jax.Array:
    return observation.at[..., index : index + value.shape[-1]].set(value)


def _yaw(quaternion: jax.Array) -> jax.Array:
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _turned(vector: jax.Array, facing: jax.Array) -> jax.Array:
    """Return ``vector[..., 2]`` as seen by what faces (cos, sin)."""
    (x, y), (c, s) = jnp.moveaxis(vector, -1, 0), jnp.moveaxis(facing, -1, 0)
    return jnp.stack([c * x + s * y, c * y - s * x], axis=-1)


def _turned_quaternion(quaternion: jax.Array, facing: jax.Array) -> jax.Array:
    """Return the quaternion after a turn by minus the yaw; of q and -q, the same orientation, that with w >= 0."""
    half = 0.5 * jnp.arctan2(facing[..., 1], facing[..., 0])
    c, s = jnp.cos(half), jnp.sin(half)
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    turned = jnp.stack([c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w], axis=-1)
    return jnp.where(turned[..., :1] < 0, -turned, turned)
