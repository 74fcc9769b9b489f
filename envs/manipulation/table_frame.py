"""Show OGBench's table from where the gripper is: how far off cubes are, to the millimetre where they are near."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.manipulation.manipspace_rig import CUBE_COLUMNS, HAND_COLUMN, PLACE_SCALE, ROBOT_COLUMNS

CLOSE = 0.01 * PLACE_SCALE  # 1 cm: gaps much wider are all the same to the fine part of a view


class TableFrame:
    """Show the cubes as seen from between the fingers, along the world's axes.

    Over all of the table a gap of a few millimetres, which decides whether a grasp holds, is a fiftieth of a standard
    deviation and lost among the rest; so that each gap stands there twice, as it is and bent to within [-1, 1].
    A pose is the place between the fingers, in the observation's units of 0.1 m.

    Args:
        cubes: how many.
    """

    pose_size = 3

    def __init__(self, cubes: int) -> None:
        self._cubes = [ROBOT_COLUMNS + CUBE_COLUMNS * index for index in range(cubes)]

    def size(self, observation_size: int) -> int:
        """Return the numbers of ``see``."""
        return observation_size + self.pose_size + 6 * len(self._cubes)

    def pose(self, observation: jax.Array) -> jax.Array:
        """Return the place between the fingers, [..., 3], at ``observation[..., obs]``, in its own units."""
        return _place(observation, HAND_COLUMN)

    def see(self, observation: jax.Array, pose: jax.Array) -> jax.Array:
        """Return float[..., obs + 3 + 6 cubes] in a skill that began with the fingers at ``pose[..., 3]``.

        Behind the observation stand the way of the fingers since then, and what ``beside`` returns.
        """
        way = self.pose(observation) - pose
        return jnp.concatenate([observation, way, self.beside(observation)], axis=-1)

    def beside(self, observation: jax.Array) -> jax.Array:
        """Return float[..., 6 cubes]: of each cube the gap that is left to it, then of each tanh of that gap in cm."""
        hand = self.pose(observation)
        gaps = [_place(observation, cube) - hand for cube in self._cubes]
        return jnp.concatenate([*gaps, *(jnp.tanh(gap / CLOSE) for gap in gaps)], axis=-1)


def _place(observation: jax.Array, column: int) -> jax.Array:
    return observation[..., column : column + 3]
