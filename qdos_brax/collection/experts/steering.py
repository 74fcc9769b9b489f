"""Steering: from (position, goal) to a direction, cell by cell through a maze, or along a straight line of sight.

Pure functions of a single state, for use inside jit and under vmap. A ``Navigator`` holds the maze's paths as device
tables, so that following a shortest path costs one look-up per step.
"""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.mazes.maze import UNIT, Maze
from qdos_brax.nn.vectors import unit_vector

_CORRIDOR = 1.2  # m that must be free on either side of a straight line: the reach of the ant's legs
_BERTH = 3.0  # m from a wall within which a ball is steered away from it
_LEAD = 1.5  # weight of that at the wall itself, where the direction to the goal has weight 1
_SIDES = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])  # x, y


class Navigator:
    """Hold a maze's shortest paths as device tables over cell indices (C = number of cells).

    Args:
        maze: the layout.
    """

    def __init__(self, maze: Maze) -> None:
        self.maze = maze
        self.next_cell = jnp.asarray(maze.next_step_table)  # int32[C, C], the neighbour to enter, from row to column
        self.sight_cell = jnp.asarray(_farthest_in_sight(maze))  # int32[C, C], the last cell a straight walk reaches
        self._wall_beside = jnp.asarray(_walls_beside(maze))  # bool[C, 4], on each of _SIDES
        self._cell_steps = jnp.asarray(maze.steps_table)  # int32[C, C], cells to go, -1 without a path
        indices = maze.cell_index(maze.ij_to_xy(maze.free_cells))
        leads_on = (maze.next_step_table[indices] != indices[:, None]).any(axis=1)  # not walled in on all sides
        self.free_xy = jnp.asarray(maze.ij_to_xy(maze.free_cells[leads_on]), jnp.float32)  # float32[F, 2]

    def cell(self, xy: jax.Array) -> jax.Array:
        """Return int32[...], the index of the cell that contains ``xy[..., 2]``."""
        return self.maze.cell_index(xy)

    def centre(self, cell: jax.Array) -> jax.Array:
        """Return float32[..., 2], the centre of ``cell[...]``."""
        return self.maze.index_to_xy(cell)

    def random_free_xy(self, key: jax.Array) -> jax.Array:
        """Draw a free cell uniformly and return its centre[2]."""
        return jax.random.choice(key, self.free_xy)

    def random_xy_at(self, key: jax.Array, cell: jax.Array, steps: int) -> jax.Array:
        """Draw a cell at ``steps`` cells along a shortest path and return its centre[2]; that of ``cell`` if none."""
        fits = self._cell_steps[cell] == steps
        drawn = jax.random.categorical(key, jnp.where(fits, 0.0, -jnp.inf))
        return self.centre(jnp.where(fits.any(), drawn, cell))

    def off_walls(self, xy: jax.Array) -> jax.Array:
        """Return the vector[2] away from walls beside the cell of ``xy[2]``: length 1 at a wall, 0 at 3 m from it."""
        cell = self.cell(xy)
        gap = UNIT / 2 - jnp.asarray(_SIDES) @ (xy - self.centre(cell))
        nearness = jnp.where(self._wall_beside[cell], jnp.clip(1 - gap / _BERTH, 0.0, 1.0), 0.0)
        return -nearness @ jnp.asarray(_SIDES, jnp.float32)


class Steering(Protocol):
    """Define what leads a walking body to places in a maze."""

    def __call__(self, qpos: jax.Array, goal_xy: jax.Array) -> jax.Array:
        """Return the unit vector[2] in which a body at ``qpos[nq]`` is to walk on its way to ``goal_xy[2]``."""
        ...


class CellSteering:
    """Walk a body that can turn anywhere from cell to cell.

    Args:
        navigator: the maze.
    """

    def __init__(self, navigator: Navigator) -> None:
        self._navigator = navigator

    def __call__(self, qpos: jax.Array, goal_xy: jax.Array) -> jax.Array:
        """Return the unit vector[2] of ``maze_direction``."""
        return maze_direction(self._navigator, qpos[:2], goal_xy)


def maze_direction(maze: Navigator, xy: jax.Array, goal_xy: jax.Array) -> jax.Array:
    """Return the unit vector[2] from ``xy`` to the next cell on a shortest path, or to a goal in the same cell."""
    here, there = maze.cell(xy), maze.cell(goal_xy)
    return unit_vector(jnp.where(here == there, goal_xy, maze.centre(maze.next_cell[here, there])) - xy)


def dribble_direction(maze: Navigator, ball_xy: jax.Array, goal_xy: jax.Array) -> jax.Array:
    """Return the unit vector[2] from ``ball_xy`` to the farthest visible point of its path.

    The ball goes straight in the open and in an arc along a wall: at the wall the ant has no room to get behind it.
    """
    ball, goal = maze.cell(ball_xy), maze.cell(goal_xy)
    waypoint = maze.sight_cell[ball, goal]
    target = jnp.where((ball == goal) | (waypoint == goal), goal_xy, maze.centre(waypoint))
    return unit_vector(unit_vector(target - ball_xy) + _LEAD * maze.off_walls(ball_xy))


def approach(maze: Navigator, xy: jax.Array, target_xy: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (unit vector[2] towards ``target_xy`` or the farthest visible cell before it, bool: it is visible)."""
    here, there = maze.cell(xy), maze.cell(target_xy)
    meeting = maze.sight_cell[here, there]
    in_sight = (here == there) | (meeting == there)
    return unit_vector(jnp.where(in_sight, target_xy, maze.centre(meeting)) - xy), in_sight


def _farthest_in_sight(maze: Maze) -> np.ndarray:
    """Compute int32[C, C], the last cell of each shortest path that, like all before it, can be walked to straight."""
    table = maze.next_step_table.copy()
    free = maze.cell_index(maze.ij_to_xy(maze.free_cells))
    for start in free:
        reachable = {goal: _is_free_corridor(maze, start, goal) for goal in free}
        for goal in free:
            cell = farthest = maze.next_step_table[start, goal]
            if cell == start:  # it is the goal, or cut off from it
                continue
            while cell != goal and reachable[cell := maze.next_step_table[cell, goal]]:
                farthest = cell
            table[start, goal] = farthest
    return table


def _walls_beside(maze: Maze) -> np.ndarray:
    """Return bool[C, 4]: whether the neighbour of a free cell on each of _SIDES is a wall."""
    beside = np.zeros((maze.num_cells, len(_SIDES)), bool)
    for i, j in maze.free_cells:
        beside[maze.cell_index(maze.ij_to_xy(np.array([i, j])))] = [maze.grid[i + dy, j + dx] for dx, dy in _SIDES]
    return beside


def _is_free_corridor(maze: Maze, start: int, goal: int) -> bool:
    """Return whether the corridor between two cells' centres is free, by samples an eighth of a cell apart."""
    a, b = maze.index_to_xy(start), maze.index_to_xy(goal)
    length = float(np.linalg.norm(b - a))
    if length == 0:
        return True
    along = np.linspace(0.0, 1.0, int(np.ceil(8 * length / UNIT)) + 1)[:, None, None]
    across = np.array([-_CORRIDOR, 0.0, _CORRIDOR])[None, :, None]
    normal = np.array([-(b - a)[1], (b - a)[0]]) / length
    ij = maze.xy_to_ij(a + along * (b - a) + across * normal)
    return not maze.grid[ij[..., 0], ij[..., 1]].any()
