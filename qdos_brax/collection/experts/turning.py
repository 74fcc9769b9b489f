"""Steering for a body that turns in a curve: wide of walls, smooth at corners, and as gently as there is room.

Led from cell to cell, a humanoid turns sharply at each, and may go round a goal for ever, since it turns in a circle
wider than the goal. The sharper it turns, the oftener it falls. Here it follows paths that keep away from walls,
looking some way ahead, and turns sharply only before a wall, and where it would go round its goal otherwise.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from envs.mazes.maze import UNIT, Maze
from qdos_brax.collection.experts.steering import Navigator
from qdos_brax.collection.experts.views import direction_of, forward_axis, to_direction_frame, to_world_frame
from qdos_brax.nn.vectors import unit_vector

GENTLE = 0.9
"""Largest angle between where a humanoid faces and its command where there is room, rad."""
RADIUS = 1.2
"""Radius of the circle in which it then walks, m."""

_PER_CELL = 8  # points of a path's grid along a cell
_SPACING = UNIT / _PER_CELL
_BERTH = 1.5  # m from a wall within which a path costs more
_DREAD = 4.0  # additional cost per m at the wall itself
_AHEAD = 2.5  # m along the path to where the body heads
_REACH, _ROOM = 0.8, 0.5  # a wall is before the body if so far ahead there is less than that to the next wall, m
_HASTE = 2.0  # times the angle to a goal that is commanded where the body would go round it,
_SHARPEST = 2.5  # to the same side, rad
_MOVES = [(i, j) for i, j in itertools.product(range(-2, 3), repeat=2) if np.gcd(i, j) == 1]  # 16 of a grid point


class CurvedSteering:
    """Walk a humanoid to places in a maze.

    Args:
        navigator: the maze.
    """

    def __init__(self, navigator: Navigator) -> None:
        self._navigator, maze = navigator, navigator.maze
        cells, points = points_ahead(maze)
        row = np.zeros(maze.num_cells, np.int32)
        row[cells] = np.arange(len(cells))
        self._row, self._points = jnp.asarray(row), jnp.asarray(points)
        self._corner = jnp.asarray(maze.ij_to_xy((0, 0)) - UNIT / 2, jnp.float32)
        self._gap = jnp.asarray(gaps(maze, grid_points(maze)), jnp.float32)

    def __call__(self, qpos: jax.Array, goal_xy: jax.Array) -> jax.Array:
        """Return the unit vector[2] in which a body at ``qpos[nq]`` is to walk on its way to ``goal_xy[2]``."""
        xy, facing = qpos[:2], unit_vector(forward_axis(qpos)[:2])
        here, there = self._navigator.cell(xy), self._navigator.cell(goal_xy)
        ahead = self._points[self._row[there], *self._grid_point(xy)]
        target = to_direction_frame(jnp.where(here == there, goal_xy, ahead) - xy, facing)
        angle = jnp.arctan2(target[1], target[0])
        hasty = jnp.clip(_HASTE * angle, -_SHARPEST, _SHARPEST)
        blocked = self._gap[self._grid_point(xy + _REACH * facing)] < _ROOM
        angle = jnp.where(blocked, angle, jnp.clip(angle, -GENTLE, GENTLE))
        is_goal = (here == there) | jnp.all(ahead == self._navigator.centre(there))
        angle = jnp.where(is_goal & is_circled(target), hasty, angle)
        return to_world_frame(direction_of(angle), facing)

    def _grid_point(self, xy: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return (row, column) of the grid's point nearest to ``xy[2]``."""
        column, row = jnp.floor((xy - self._corner) / _SPACING).astype(jnp.int32)
        rows, columns = self._gap.shape
        return jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1)


def is_circled(target: jax.Array) -> jax.Array:
    """Return bool: ``target[2]``, as seen by the body, which faces +x, lies inside a circle of RADIUS that it walks.

    Whichever side it turns to, it then goes round the target.
    """
    return target @ target < 2 * RADIUS * jnp.abs(target[1])


def points_ahead(maze: Maze) -> tuple[np.ndarray, np.ndarray]:
    """Compute where to head from the points of a grid, _PER_CELL to a cell's side, on the way to each free cell.

    Paths are the cheapest ones, where a metre costs more the nearer a wall is.

    Returns:
        int[F], the free cells' indices, and float32[F, rows, columns, 2], a point _AHEAD m along the path, or the
        cell's centre if that is nearer; the point itself where no path leads there.
    """
    grid = grid_points(maze)
    shape, xy = grid.shape[:2], grid.reshape(-1, 2)
    cells = maze.cell_index(maze.ij_to_xy(maze.free_cells))
    centres = maze.index_to_xy(cells)
    goals = np.linalg.norm(xy - (centres + 0.5 * _SPACING)[:, None], axis=-1).argmin(axis=1)
    _, onwards = dijkstra(_costs(maze, grid), indices=goals, return_predecessors=True)
    points = np.stack([_ahead(xy, *way) for way in zip(onwards, goals, centres, strict=True)])
    return cells, points.reshape(len(cells), *shape, 2).astype(np.float32)


def grid_points(maze: Maze) -> np.ndarray:
    """Return float[rows, columns, 2], points _PER_CELL to a cell's side, none of them on an edge of a cell."""
    rows, columns = (np.arange(_PER_CELL * side) for side in maze.grid.shape)
    corner = np.asarray(maze.ij_to_xy((0, 0))) - UNIT / 2
    return corner + (np.stack(np.meshgrid(columns, rows), axis=-1) + 0.5) * _SPACING


def gaps(maze: Maze, xy: np.ndarray) -> np.ndarray:
    """Return float[...], the distance of ``xy[..., 2]`` to the nearest wall, m; 0 inside one."""
    walls = maze.ij_to_xy(np.argwhere(maze.grid == 1))
    beyond = np.maximum(np.abs(xy[..., None, :] - walls) - UNIT / 2, 0.0)
    return np.asarray(np.linalg.norm(beyond, axis=-1).min(axis=-1))


def _costs(maze: Maze, grid: np.ndarray) -> csr_matrix:
    """Return the costs of moves between the points of ``grid[rows, columns, 2]``."""
    xy, gap = grid.reshape(-1, 2), gaps(maze, grid).ravel()
    price = 1.0 + _DREAD * np.maximum(1.0 - gap / _BERTH, 0.0) ** 2
    rows, columns = grid.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    edges: list[np.ndarray] = []
    for i, j in _MOVES:
        inside = np.s_[max(0, -i) : rows - max(0, i), max(0, -j) : columns - max(0, j)]
        start, end = index[inside].ravel(), np.roll(index, (-i, -j), axis=(0, 1))[inside].ravel()
        between = (xy[start] + xy[end]) / 2  # two walls may touch at a corner
        free = (gap[start] > 0) & (gap[end] > 0) & (gaps(maze, between) > 0)
        edges.append(np.stack([start[free], end[free]]))
    start, end = np.concatenate(edges, axis=1)
    cost = np.linalg.norm(xy[start] - xy[end], axis=1) * (price[start] + price[end]) / 2
    return csr_matrix((cost, (start, end)), shape=(index.size, index.size))


def _ahead(xy: np.ndarray, onwards: np.ndarray, goal: int, centre: np.ndarray) -> np.ndarray:
    """Return float[P, 2], the points _AHEAD m along the paths; ``onwards[P]`` is each point's next, -9999 if none."""
    at = np.arange(len(xy))
    length = np.zeros(len(xy))
    for _ in range(int(np.ceil(_AHEAD / _SPACING))):
        goes = (length < _AHEAD) & (onwards[at] >= 0)
        then = np.where(goes, onwards[at], at)
        length += np.linalg.norm(xy[then] - xy[at], axis=1)
        at = then
    return np.where((at == goal)[:, None], centre, xy[at])
