"""Compute with mazes: cells and coordinates, shortest paths.

Geometry is OGBench's: a cell is 4 x 4 units, cell (i, j) is centred at x = 4j - 4, y = 4i - 4, a wall is a box that
fills its cell to a height of 2.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.mazes.layouts import LAYOUTS, TELEPORTERS, Teleporters

UNIT = 4.0  # side of a cell
OFFSET = 4.0  # cell (1, 1) is centred at the origin
WALL_HALF_SIZE = (2.0, 2.0, 1.0)
TELEPORT_RADIUS = 1.0  # of the discs that mark entrances and exits
TELEPORT_REACH = 1.5

_EDGE = 1e-6  # a path may run along a wall; only its interior, shrunk by this much, blocks
_CHUNK = 1 << 22  # segments times walls looked at in one go, bounds memory


@dataclass(frozen=True, eq=False)
class Maze:
    """Hold a layout and its geometry. Paths and distances are those of the walls: none leads through a teleporter.

    Attributes:
        name: "arena", "medium", "large", "giant" or "teleport".
        grid: int[I, J], 1 where there is a wall. The outermost ring is always wall.
        teleporters: in "teleport" only.
    """

    name: str
    grid: np.ndarray
    teleporters: Teleporters | None = None

    @property
    def num_cells(self) -> int:
        """Return I * J, walls included: the range of ``cell_index``."""
        return int(self.grid.size)

    @cached_property
    def free_cells(self) -> np.ndarray:
        """Return int[F, 2], the (i, j) of every free cell, row by row."""
        return np.argwhere(self.grid == 0)

    def ij_to_xy(self, ij: Any) -> Any:
        """Return centres float[..., 2] of the cells ``ij[..., 2]``; NumPy in, NumPy out, jax likewise."""
        return _namespace(ij).asarray(ij)[..., ::-1] * UNIT - OFFSET

    def xy_to_ij(self, xy: Any) -> Any:
        """Return cells int[..., 2] that hold the points ``xy[..., 2]``, clipped to the grid."""
        xp = _namespace(xy)
        ij = xp.floor((xp.asarray(xy)[..., ::-1] + OFFSET + 0.5 * UNIT) / UNIT).astype(xp.int32)
        return xp.clip(ij, 0, xp.asarray(self.grid.shape, dtype=xp.int32) - 1)

    def cell_index(self, xy: Any) -> Any:
        """Return the row-major index int[...] of the cell that holds ``xy[..., 2]``; indexes ``next_step_table``."""
        ij = self.xy_to_ij(xy)
        return ij[..., 0] * self.grid.shape[1] + ij[..., 1]

    def index_to_xy(self, index: Any) -> Any:
        """Return the centre float[..., 2] of the cell with row-major ``index[...]``; the inverse of ``cell_index``."""
        xp = _namespace(index)
        columns = self.grid.shape[1]
        index = xp.asarray(index)
        return self.ij_to_xy(xp.stack([index // columns, index % columns], axis=-1))

    def check_free(self, ij: np.ndarray) -> None:
        """Raise ValueError unless ``ij`` is a free cell's (i, j)."""
        if ij.shape != (2,) or not np.issubdtype(ij.dtype, np.integer):
            raise ValueError(f"a cell is two whole numbers (i, j), not {ij.tolist()!r}")
        i, j = ij.tolist()
        rows, columns = self.grid.shape
        if not (0 <= i < rows and 0 <= j < columns):
            raise ValueError(f"cell ({i}, {j}) is outside the maze {self.name!r}, which has {rows} x {columns} cells")
        if self.grid[i, j]:
            raise ValueError(f"cell ({i}, {j}) of the maze {self.name!r} is a wall; choose one of maze.free_cells")

    def teleport(self, xy: jax.Array, key: jax.Array) -> jax.Array:
        """Return ``xy[2]``, or where an entrance is in reach, an exit drawn from ``key``."""
        if self.teleporters is None:
            return xy
        entrances = jnp.asarray(self.ij_to_xy(np.array(self.teleporters.entrances)), jnp.float32)
        exits = jnp.asarray(self.ij_to_xy(np.array(self.teleporters.exits)), jnp.float32)
        in_reach = (jnp.linalg.norm(xy - entrances, axis=-1) <= TELEPORT_REACH).any()
        return jnp.where(in_reach, jax.random.choice(key, exits), xy)

    @cached_property
    def next_step_table(self) -> np.ndarray:
        """Return int32[I*J, I*J]: ``table[start, goal]``, the next free cell on a shortest 4-connected path.

        Equal to OGBench's ``get_oracle_subgoal``, ties included; ``start`` itself where it is the goal, a wall or cut
        off from the goal.
        """
        size = self.num_cells
        table = np.tile(np.arange(size, dtype=np.int32)[:, None], (1, size))
        for goal in self.free_cells:
            goal_index = goal[0] * self.grid.shape[1] + goal[1]
            steps = self.steps_table[:, goal_index].reshape(self.grid.shape)
            for i, j in self.free_cells:
                best = (i, j)
                for cell in _neighbours(i, j):
                    if 0 <= steps[cell] < steps[best]:
                        best = cell
                table[i * self.grid.shape[1] + j, goal_index] = best[0] * self.grid.shape[1] + best[1]
        return table

    @cached_property
    def steps_table(self) -> np.ndarray:
        """Return int32[I*J, I*J]: ``table[start, goal]``, cells to go on a shortest 4-connected path, -1 without."""
        table = np.full((self.num_cells, self.num_cells), -1, np.int32)
        for goal in self.free_cells:
            table[:, goal[0] * self.grid.shape[1] + goal[1]] = self._steps_to(tuple(goal)).reshape(-1)
        return table

    def distance(self, a: Any, b: Any) -> np.ndarray:
        """Return the length of a point's shortest path around the walls, exact (a path bends at wall corners only).

        Args:
            a: float[..., 2], points; broadcast against ``b``. A point inside a wall is first moved to the nearest
                free cell.
            b: float[..., 2], points.

        Returns:
            float64[...], units of length; inf where there is no path.
        """
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        lead = np.broadcast_shapes(a.shape[:-1], b.shape[:-1])
        a, b = self._to_free(a.reshape(-1, 2)), self._to_free(b.reshape(-1, 2))
        around = self._around_corners(a, b)
        a, b = np.broadcast_arrays(a, b)
        straight = np.where(self._sees(a, b), np.linalg.norm(a - b, axis=-1), np.inf)
        return np.minimum(straight, around).reshape(lead)

    def _steps_to(self, goal: tuple[int, int]) -> np.ndarray:
        """Return int[I, J], the number of cell steps to ``goal``, -1 for walls and cut-off cells (breadth first)."""
        steps = np.full(self.grid.shape, -1)
        steps[goal] = 0
        queue = deque([goal])
        while queue:
            cell = queue.popleft()
            for near in _neighbours(*cell):
                if self.grid[near] == 0 and steps[near] < 0:
                    steps[near] = steps[cell] + 1
                    queue.append(near)
        return steps

    def _to_free(self, xy: np.ndarray) -> np.ndarray:
        """Return ``xy[N, 2]`` with the points that lie in a wall moved to the nearest point of a free cell."""
        ij = self.xy_to_ij(xy)
        inside = self.grid[ij[:, 0], ij[:, 1]] == 1
        if not inside.any():
            return xy
        xy = xy.copy()
        centres = self.ij_to_xy(self.free_cells)
        nearest = np.clip(xy[inside, None], centres - UNIT / 2, centres + UNIT / 2)  # [n, F, 2]
        best = np.linalg.norm(nearest - xy[inside, None], axis=-1).argmin(axis=1)
        xy[inside] = nearest[np.arange(len(best)), best]
        return xy

    @cached_property
    def _inner_walls(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper corners float[R, 2] of the rectangles that walls merge into along rows and columns.

        Both directions, so that no path can slip along the seam of two touching walls; a plug closes the corner at
        which two walls touch diagonally. The outer ring is left out: no segment between two inner points crosses it.
        """
        inner = self.grid[1:-1, 1:-1]
        boxes = [(i, lo, i, hi) for i, row in enumerate(inner) for lo, hi in _runs(row)]
        boxes += [(lo, j, hi, j) for j, column in enumerate(inner.T) for lo, hi in _runs(column)]
        cells = np.asarray(sorted(set(boxes)), int).reshape(-1, 4) + 1
        low = self.ij_to_xy(cells[:, :2]) - UNIT / 2 + _EDGE
        high = self.ij_to_xy(cells[:, 2:]) + UNIT / 2 - _EDGE
        plugs = self._corner_points(lambda block: block.sum() == 2 and block[0, 0] == block[1, 1])
        return np.concatenate([low, plugs - 2 * _EDGE]), np.concatenate([high, plugs + 2 * _EDGE])

    def _corner_points(self, chosen: Callable[[np.ndarray], bool]) -> np.ndarray:
        """Return float[C, 2], where four cells meet whose walls (int[2, 2]) are ``chosen``."""
        rows, columns = self.grid.shape
        points = [
            self.ij_to_xy(np.array([i, j])) - UNIT / 2
            for i in range(1, rows)
            for j in range(1, columns)
            if chosen(self.grid[i - 1 : i + 1, j - 1 : j + 1])
        ]
        return np.asarray(points, np.float64).reshape(-1, 2)

    @cached_property
    def _corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the points float[C, 2] at which shortest paths bend, and float[C, C], path lengths between them."""
        corners = self._corner_points(lambda block: block.sum() == 1)
        lengths = self._visible_lengths(corners, corners)
        for k in range(len(corners)):  # Floyd and Warshall
            lengths = np.minimum(lengths, lengths[:, k, None] + lengths[None, k, :])
        return corners, lengths

    def _around_corners(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the shortest path length with at least one bend, ``a[N or 1, 2]`` to ``b[N or 1, 2]``."""
        corners, between = self._corners
        if len(corners) == 0:
            return np.full(max(len(a), len(b)), np.inf)
        to_b = self._visible_lengths(b, corners)
        from_corner = np.stack([(to_b + row).min(axis=1) for row in between], axis=1)
        return (self._visible_lengths(a, corners) + from_corner).min(axis=1)

    def _visible_lengths(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return float[N, M], straight distances ``a[N, 2]`` to ``b[M, 2]``, inf where a wall is between."""
        gaps = np.linalg.norm(a[:, None] - b[None], axis=-1)
        starts = np.repeat(a, len(b), axis=0)
        ends = np.tile(b, (len(a), 1))
        return np.where(self._sees(starts, ends).reshape(gaps.shape), gaps, np.inf)

    def _sees(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return bool[N]: no wall's interior cuts the segment ``a[N, 2]`` to ``b[N, 2]`` (slab test)."""
        low, high = self._inner_walls
        free = np.ones(len(a), bool)
        if len(low) == 0:
            return free
        rows = max(1, _CHUNK // len(low))
        for start in range(0, len(a), rows):
            p, q = a[start : start + rows, None], b[start : start + rows, None]
            way = np.where(np.abs(q - p) < 1e-12, 1e-12, q - p)
            one, two = (low - p) / way, (high - p) / way
            enter = np.minimum(one, two).max(axis=-1).clip(min=0.0)
            leave = np.maximum(one, two).min(axis=-1).clip(max=1.0)
            free[start : start + rows] = (enter >= leave).all(axis=-1)
        return free


def get_maze(name: str) -> Maze:
    """Return the layout called ``name``.

    Raises:
        ValueError: there is no such layout.
    """
    if name not in LAYOUTS:
        raise ValueError(f"there is no maze {name!r}; mazes: {', '.join(LAYOUTS)}")
    grid = np.array([[int(c) for c in row.strip()] for row in LAYOUTS[name].split()])
    return Maze(name, grid, TELEPORTERS.get(name))


def _neighbours(i: int, j: int) -> list[tuple[int, int]]:
    """Return the four neighbours in OGBench's order, which decides ties; free cells never lie on the outer ring."""
    return [(i - 1, j), (i, j - 1), (i + 1, j), (i, j + 1)]


def _runs(row: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last index of every run of ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], row, [0]])))
    return [(int(lo), int(hi) - 1) for lo, hi in zip(edges[::2], edges[1::2], strict=True)]


def _namespace(x: Any) -> Any:
    return jnp if isinstance(x, jax.Array) else np
