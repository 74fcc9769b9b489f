"""Find and place the walls of a maze that a body can touch.

Within a cell that is the neighbour in the half of the cell where it stands along x, the one along y, and the diagonal
one between: ant and humanoid reach 1.2 and 1.4 units, and a cell is 4 wide. All other walls can be left out of the
model without a change of the physics, so that a step costs the same in every maze.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from envs.mazes.maze import UNIT, WALL_HALF_SIZE, Maze
from envs.physics.base import Sensors
from envs.physics.mujoco.rig import Rig

WALLS_AROUND = 3
"""Cells in reach of a point in a free cell, without its own."""

WALLS = 1 + WALLS_AROUND
"""Cells in reach of any point: its own, which is a wall only for a body inside one, and those around."""

# Heights of a box that stands for no wall: below the floor, out of reach.
_SUNK_IN_C = -100.0
_SUNK_IN_MJX = -10.0


def cells_in_reach(layout: Maze, xy: Any) -> tuple[Any, Any]:
    """Return the cells around ``xy[..., 2]``; NumPy in, NumPy out, jax likewise.

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


class MazeRig(Rig):
    """Put the walls in reach in place before each control step of MuJoCo C, and read a body's senses after it.

    The results are bit for bit those of a model with all walls, and cost less.

    Args:
        model: has ``WALLS`` boxes for each body in turn, geoms of the world called "ant_wall_0", .., which this body
            alone can touch, and its pairs of geoms are listed (``envs.physics.mujoco.pairs``), since MuJoCo's search
            would not see that boxes move.
        layout: the maze.
        bodies: where in qpos the x of each free body lies.
        sensors: what to read after each control step, from a forward pass of the new state; None reads nothing.
    """

    def __init__(self, model: mujoco.MjModel, layout: Maze, bodies: Sequence[int], sensors: Sensors | None) -> None:
        self._bodies = list(bodies)
        self._wall_geoms = np.asarray([k for k in range(model.ngeom) if "_wall_" in model.geom(k).name], int)
        corner = np.asarray(layout.ij_to_xy((0, 0))) - 0.5 * UNIT
        quarters = _walls_by_quarter(layout, corner)
        rows, columns = quarters.shape[:2]
        self._quarters = quarters.reshape(-1, WALLS)
        # Of x and y of each body in turn: where in qpos they lie, where their quarters begin, and the last of these.
        self._columns = np.concatenate([np.arange(place, place + 2) for place in bodies])
        self._corner = np.tile(corner, len(self._bodies))
        self._last = np.tile([columns - 1.0, rows - 1.0], len(self._bodies))
        self._strides = np.array([1, columns])  # of a quarter's x and y in the table
        self._placed: weakref.WeakKeyDictionary[Batch, np.ndarray] = weakref.WeakKeyDictionary()
        centres = layout.index_to_xy(np.arange(layout.num_cells + 1))
        height = np.where(np.arange(layout.num_cells + 1) < layout.num_cells, WALL_HALF_SIZE[2], _SUNK_IN_C)
        self._centres = np.concatenate([centres, height[:, None]], axis=1)
        self._model, self._sensors = model, sensors
        if sensors is not None:
            self.sensed_size = sensors.size
            self.fields = ("xpos", "xmat", "sensordata")
            self.stage = mujoco.mjtStage.mjSTAGE_VEL

    def identity(self) -> bytes:
        """Return the class, the walls in reach of each place, the bodies and the sensors."""
        arrays = (self._wall_geoms, self._corner, self._strides, self._quarters, self._centres)
        content = b"".join(repr((array.shape, array.dtype)).encode() + array.tobytes() for array in arrays)
        return super().identity() + content + repr((self._bodies, self._sensors)).encode()

    def before(self, batch: Batch, extra: np.ndarray) -> None:
        """Move each body's boxes to the walls around it; those without a wall stay out of reach."""
        quarters = self._quarters_of(batch.bind("qpos"))
        placed = self._placed.get(batch)
        # A body stays in a quarter for many steps, and small batches pay for every call of NumPy.
        if placed is None or placed.tobytes() != quarters.tobytes():
            index = self._quarters[quarters].reshape(batch.nsim, -1)
            batch.expand("geom_pos")[:, self._wall_geoms] = self._centres[index]
            self._placed[batch] = quarters

    def _quarters_of(self, qpos: np.ndarray) -> np.ndarray:
        """Return int[n, bodies], the quarter of a cell that each body is in, or the nearest; any one for NaN."""
        quarters = (qpos[:, self._columns] - self._corner) * (2 / UNIT)
        held = np.fmax(np.fmin(quarters, self._last), 0.0).astype(int)
        return held.reshape(len(qpos), -1, 2) @ self._strides

    def start(self, batch: Batch, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (no memory, what the body senses)."""
        return np.zeros((batch.nsim, 0)), self._sense(batch)

    def after(
        self, batch: Batch, qpos: np.ndarray, memory: np.ndarray, extra: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (memory and extra as they are, what the body senses)."""
        return memory, extra, self._sense(batch)

    def _sense(self, batch: Batch) -> np.ndarray:
        """Return float32[n, k] of the states that ``batch`` has just made a forward pass of."""
        if self._sensors is None:
            return np.zeros((batch.nsim, 0), np.float32)
        xpos, xmat, sensordata = (batch.bind(name) for name in self.fields)
        xmat = xmat.reshape(*xpos.shape, 3)
        return self._sensors.read(self._model, xpos, xmat, sensordata).astype(np.float32)


class NearWalls:
    """Place the walls in reach for MJX: mocap boxes, three per body, in the order of ``bodies``.

    Positions are taken relative to the first body's cell. The ball has boxes of its own, kept apart by collision bits.

    Args:
        layout: the maze.
        bodies: where in qpos the x of each body lies.
    """

    def __init__(self, layout: Maze, bodies: Sequence[int] = (0,)) -> None:
        self._layout, self._bodies = layout, tuple(bodies)

    def __call__(self, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return (shift[nq] of the positions, centres[3 * bodies, 3] of the boxes after it) for ``qpos[nq]``."""
        origin = self._layout.ij_to_xy(self._layout.xy_to_ij(qpos[:2])).astype(jnp.float32)
        walls = jnp.concatenate([self._around(qpos[b : b + 2], origin) for b in self._bodies])
        shift = jnp.zeros(qpos.shape[-1])
        for b in self._bodies:
            shift = shift.at[b : b + 2].set(origin)
        return shift, walls

    def _around(self, xy: jax.Array, origin: jax.Array) -> jax.Array:
        """Return centres float[3, 3] of the boxes around ``xy[2]``, relative to ``origin[2]``; without wall: sunk."""
        cells, is_wall = cells_in_reach(self._layout, xy)
        height = jnp.where(is_wall, WALL_HALF_SIZE[2], _SUNK_IN_MJX)
        centres = jnp.concatenate([self._layout.ij_to_xy(cells) - origin, height[:, None]], axis=1)
        return centres[1:]  # a body whose middle is inside a wall is left to MuJoCo C


def _walls_by_quarter(layout: Maze, corner: np.ndarray) -> np.ndarray:
    """Return int[2 rows, 2 columns, WALLS]: walls in reach of each quarter of a cell; ``num_cells`` for none.

    They are in the order of the whole maze, in which contacts are solved, and which so decides the last bit.

    Args:
        layout: the maze.
        corner: float[2], its own corner at the lowest x and y.
    """
    rows, columns = layout.grid.shape
    quarters = np.stack(np.meshgrid(np.arange(2 * columns), np.arange(2 * rows)), axis=-1)
    cells, is_wall = cells_in_reach(layout, corner + (quarters + 0.5) * (0.5 * UNIT))
    return np.sort(np.where(is_wall, cells[..., 0] * columns + cells[..., 1], layout.num_cells), axis=-1)
