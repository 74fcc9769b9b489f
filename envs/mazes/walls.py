"""Which walls of a maze a body can touch.

Within a cell that is the neighbour in the half of the cell where it stands along x, the one along y, and the diagonal
one between: ant and humanoid reach 1.2 and 1.4 units, and a cell is 4 wide. All other walls can be left out of the
model without a change of the physics, so that a step costs the same in every maze.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.mazes.maze import Maze

WALLS_AROUND = 3
"""Cells in reach of a point in a free cell, without its own."""

WALLS = 1 + WALLS_AROUND
"""Cells in reach of any point: its own, which is a wall only for who is inside one, and those around."""


def cells_in_reach(layout: Maze, xy: Any) -> tuple[Any, Any]:
    """The cells around ``xy[..., 2]``; NumPy in, NumPy out, jax likewise.

    Returns:
        Their (i, j), int[..., 4, 2], the own cell first, and whether each is a wall, bool[..., 4].
    """
    xp: Any = jnp if isinstance(xy, jax.Array) else np
    own = layout.xy_to_ij(xy)
    side = xp.where(xp.asarray(xy) > layout.ij_to_xy(own), 1, -1)[..., ::-1]  # along i and j
    steps = xp.asarray([[0, 0], [0, 1], [1, 0], [1, 1]])
    cells = own[..., None, :] + steps * side[..., None, :]
    shape = xp.asarray(layout.grid.shape)
    inside = ((cells >= 0) & (cells < shape)).all(-1)
    held = xp.clip(cells, 0, shape - 1)
    return cells, inside & (xp.asarray(layout.grid)[held[..., 0], held[..., 1]] == 1)
