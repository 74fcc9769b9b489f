"""MuJoCo C, stepped in threads from inside jit: the exact engine, and the fast one where there is no accelerator.

One callback makes one control step of the whole batch (all ``vmap`` axes flattened). The full integration state of
MuJoCo, warm start included, travels through jax as the bits of its float64 numbers, so that a rollout equals a plain
loop of ``mujoco.mj_step`` bit for bit, and the callback stays a pure function of its arguments.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco.batch import Batch

from envs.mazes.maze import UNIT, WALL_HALF_SIZE, Maze
from envs.mazes.walls import cells_in_reach
from envs.physics.base import PipelineState, Sensors
from envs.physics.mujoco import timers

_SUNK = -100.0  # height of a box that stands for no wall
_SENSED_FIELDS = ("xpos", "xmat", "sensordata")


class MujocoCarry(struct.PyTreeNode):
    """The exact state.

    Attributes:
        bits: uint32[2 * nstate], the float64 row of ``mjSTATE_INTEGRATION``, seen as pairs of words.
        fresh: bool, True after ``init``: no row was made yet, the next step starts from qpos and qvel.
    """

    bits: jax.Array
    fresh: jax.Array


class MujocoEngine:
    """Steps ``model`` on all cores.

    Args:
        model: the compiled model; no activation states and no plugins (the ant and humanoid tasks have none). With a
            layout, it has ``WALLS`` boxes for each body in turn, geoms of the world called "ant_wall_0", .., which this
            body alone can touch, and its pairs of geoms are listed (``envs.physics.mujoco.pairs``), since MuJoCo's search would
            not see that boxes move.
        layout: the maze; its walls in reach are put in place before each control step, which is bit for bit the same
            as with all of them, and costs less. None leaves the model as it is.
        bodies: where in qpos the x of each free body lies.
        frame_skip: sub-steps per control step.
        threads: threads of the pool; None takes the cores this process may use.
        sensors: what to read after each control step, from a forward pass of the new state; None reads nothing.
    """

    name = "mujoco"

    def __init__(
        self,
        model: mujoco.MjModel,
        layout: Maze | None = None,
        bodies: Sequence[int] = (0,),
        frame_skip: int = 5,
        threads: int | None = None,
        sensors: Sensors | None = None,
    ) -> None:
        timers.stop()
        self.model = model
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self.frame_skip = frame_skip
        self._layout = layout
        self._bodies = list(bodies)
        self._wall_geoms = np.asarray([k for k in range(model.ngeom) if "_wall_" in model.geom(k).name], int)
        if layout is not None:
            self._corner = np.asarray(layout.ij_to_xy((0, 0))) - 0.5 * UNIT
            self._quarters = _walls_by_quarter(layout, self._corner)
            centres = layout.index_to_xy(np.arange(layout.num_cells + 1))
            height = np.where(np.arange(layout.num_cells + 1) < layout.num_cells, WALL_HALF_SIZE[2], _SUNK)
            self._centres = np.concatenate([centres, height[:, None]], axis=1)
        self._threads = threads or len(os.sched_getaffinity(0))
        self._sensors = sensors
        self._nsensed = sensors.size if sensors else 0
        self._nstate = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
        self._rest = _integration_state(model)
        self._idle: dict[int, list[Batch]] = defaultdict(list)

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PipelineState:
        """The state at (qpos[nq], qvel[nv]) without warm start, as after ``mj_resetData`` and ``set_state``."""
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        carry = MujocoCarry(bits=jnp.zeros(2 * self._nstate, jnp.uint32), fresh=jnp.ones((), bool))
        if self._sensors is None:
            return PipelineState(qpos, qvel, jnp.zeros(0), carry)
        shape = jax.ShapeDtypeStruct((self._nsensed,), jnp.float32)
        sensed = jax.pure_callback(self._sense_batch, shape, qpos, qvel, vmap_method="broadcast_all")
        return PipelineState(qpos, qvel, sensed, carry)

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        """One control step under ``action[nu]`` (clamped by the model's control range).

        A number of qpos or qvel that is no longer the rounding of the exact one was changed by hand, and counts.
        """
        shapes = (
            jax.ShapeDtypeStruct((self.nq,), jnp.float32),
            jax.ShapeDtypeStruct((self.nv,), jnp.float32),
            jax.ShapeDtypeStruct((self._nsensed,), jnp.float32),
            jax.ShapeDtypeStruct((2 * self._nstate,), jnp.uint32),
        )
        qpos, qvel, sensed, bits = jax.pure_callback(
            self._step_batch,
            shapes,
            state.qpos,
            state.qvel,
            state.carry.bits,
            state.carry.fresh,
            jnp.asarray(action, jnp.float32),
            vmap_method="broadcast_all",
        )
        return PipelineState(qpos, qvel, sensed, MujocoCarry(bits=bits, fresh=jnp.zeros_like(state.carry.fresh)))

    def exact_state(self, state: PipelineState) -> tuple[np.ndarray, np.ndarray]:
        """The float64 (qpos[..., nq], qvel[..., nv]) behind a stepped state; for parity tests, outside jit."""
        rows = np.ascontiguousarray(np.asarray(state.carry.bits)).view(np.float64)
        qpos, qvel = rows[..., 1 : 1 + self.nq], rows[..., 1 + self.nq : 1 + self.nq + self.nv]
        return _with_changes(qpos, np.asarray(state.qpos)), _with_changes(qvel, np.asarray(state.qvel))

    def _step_batch(
        self, qpos: jax.Array, qvel: jax.Array, bits: jax.Array, fresh: jax.Array, action: jax.Array
    ) -> tuple[np.ndarray, ...]:
        """The callback: NumPy only, since jax inside a callback can deadlock (jax issue 24255)."""
        lead = np.shape(fresh)
        n = int(np.prod(lead, dtype=int))
        starts = np.asarray(fresh).reshape(n)
        rows = np.ascontiguousarray(np.asarray(bits).reshape(n, -1)).view(np.float64)
        stage = mujoco.mjtStage.mjSTAGE_NONE if self._sensors is None else mujoco.mjtStage.mjSTAGE_VEL
        with self._batch(n) as batch:
            np.copyto(batch.state, rows)
            batch.state[starts] = self._rest
            for name, given in (("qpos", qpos), ("qvel", qvel)):
                held, values = batch.bind(name), np.asarray(given).reshape(n, -1)
                held[:] = np.where(starts[:, None], values, _with_changes(held, values))
            sound = np.isfinite(batch.state).all(axis=1)
            self._place_walls(batch)
            batch.bind("ctrl")[:] = np.asarray(action).reshape(n, -1)
            # A state that is not finite stays as it is, for the task to see; MuJoCo would spend long on it.
            batch.step(ids=None if sound.all() else np.flatnonzero(sound), nstep=self.frame_skip, stage=int(stage))
            new_rows = batch.state.copy()
            sensed = self._read_sensors(batch)
        new_qpos = new_rows[:, 1 : 1 + self.nq].astype(np.float32)
        new_qvel = new_rows[:, 1 + self.nq : 1 + self.nq + self.nv].astype(np.float32)
        outputs = (new_qpos, new_qvel, sensed, new_rows.view(np.uint32))
        return tuple(output.reshape(*lead, output.shape[1]) for output in outputs)

    def _sense_batch(self, qpos: jax.Array, qvel: jax.Array) -> np.ndarray:
        """The callback of ``init``: what is sensed at rest rows with (qpos, qvel)."""
        lead = np.shape(qpos)[:-1]
        n = int(np.prod(lead, dtype=int))
        with self._batch(n) as batch:
            batch.state[:] = self._rest
            batch.bind("qpos")[:] = np.asarray(qpos).reshape(n, -1)
            batch.bind("qvel")[:] = np.asarray(qvel).reshape(n, -1)
            batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
            return self._read_sensors(batch).reshape(*lead, self._nsensed)

    def _place_walls(self, batch: Batch) -> None:
        """Moves each body's boxes to the walls around it; those without a wall stay out of reach."""
        if self._layout is None:
            return
        qpos = batch.bind("qpos")
        points = np.nan_to_num(np.stack([qpos[:, place : place + 2] for place in self._bodies], axis=1))
        quarters = np.floor((points - self._corner)[..., ::-1] * (2 / UNIT))
        last = np.asarray(self._quarters.shape[:2]) - 1
        row, column = np.moveaxis(np.clip(quarters, 0, last).astype(int), -1, 0)
        index = self._quarters[row, column].reshape(batch.nsim, -1)
        batch.expand("geom_pos")[:, self._wall_geoms] = self._centres[index]

    def _read_sensors(self, batch: Batch) -> np.ndarray:
        """float32[n, k] of the states that ``batch`` has just made a forward pass of."""
        if self._sensors is None:
            return np.zeros((batch.nsim, 0), np.float32)
        xpos, xmat, sensordata = (batch.bind(name) for name in _SENSED_FIELDS)
        xmat = xmat.reshape(*xpos.shape, 3)
        return self._sensors.read(self.model, xpos, xmat, sensordata).astype(np.float32)

    @contextmanager
    def _batch(self, n: int) -> Iterator[Batch]:
        """A batch of n that no other thread uses: programs on several devices call the engine at once."""
        try:
            batch = self._idle[n].pop()
        except IndexError:
            batch = Batch(self.model, nsim=n, nthread=min(self._threads, n))
            if self._sensors is not None:
                for name in _SENSED_FIELDS:  # a field is filled from the first call after it was bound
                    batch.bind(name)
        yield batch
        self._idle[n].append(batch)


def _walls_by_quarter(layout: Maze, corner: np.ndarray) -> np.ndarray:
    """int[2 rows, 2 columns, WALLS], cells that are walls in reach of each quarter of a cell; ``num_cells`` for none.

    They are in the order of the whole maze, in which contacts are solved, and which so decides the last bit.

    Args:
        layout: the maze.
        corner: float[2], its own corner at the lowest x and y.
    """
    rows, columns = layout.grid.shape
    quarters = np.stack(np.meshgrid(np.arange(2 * columns), np.arange(2 * rows)), axis=-1)
    cells, is_wall = cells_in_reach(layout, corner + (quarters + 0.5) * (0.5 * UNIT))
    return np.sort(np.where(is_wall, cells[..., 0] * columns + cells[..., 1], layout.num_cells), axis=-1)


def _with_changes(exact: np.ndarray, values: np.ndarray) -> np.ndarray:
    """``exact`` (float64), but ``values`` (float32) where they are not its rounding."""
    return np.where(exact.astype(np.float32) == values, exact, values)


def _integration_state(model: mujoco.MjModel) -> np.ndarray:
    """float64[nstate], the integration state of a freshly made MjData."""
    data = mujoco.MjData(model)
    row = np.empty(mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION)))
    mujoco.mj_getState(model, data, row, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    return row
