"""Define the tasks of mazes: a body, and what it may have to move, start in cells and have to reach a cell."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.brax_base import State
from envs.families import TaskSpec
from envs.mazes.families import Cell
from envs.mazes.maze import UNIT, Maze
from envs.physics.base import Engine, PipelineState
from envs.task import FloorMap, StateRows, Task, count_rows

GOAL_TOLERANCE = 0.5
START_NOISE = 1.0  # half width of the uniform noise on start positions
RESET_NOISE = 0.1  # half width of the uniform noise on qpos, standard deviation of the normal noise on qvel
LARGEST_MOVE = 1.5  # no ant or humanoid gets that far in one control step
SAME = 1e-4  # what two copies of a position may differ by; they went through float32 and back

_IN_WALLS = 0.01  # share of positions; no body's centre gets into a wall at all, but files in half precision round


class MazeTask(Task):
    """Simulate a body in a maze, with movable things to bring to a goal.

    ``tracked`` names everything that has a start cell, the body first. The last one has to reach the goal; the way left
    goes through all of them in turn.

    In a maze with teleporters a control step that ends in reach of an entrance moves the body to a random exit. As in
    OGBench the observation is still that of the entrance; the next one shows where it came out.

    Args:
        spec: which task.
        layout: the maze.
        engine: the physics.
        init_qpos: float[nq], qpos at load, to which reset adds noise.
        tracked: by name, where in qpos the x of each tracked thing lies.
        start_cells: the (i, j) where each tracked thing starts.
        goal_cell: the (i, j) of the goal.

    Attributes:
        layout: the maze.
        goal_xy: float32[2], the task's goal.
    """

    distance_margin = 1.5  # a cell has 4
    jump = LARGEST_MOVE

    def __init__(
        self,
        spec: TaskSpec,
        layout: Maze,
        engine: Engine,
        init_qpos: np.ndarray,
        tracked: Mapping[str, int],
        start_cells: Sequence[Cell],
        goal_cell: Cell,
    ) -> None:
        self.layout = layout
        self.goal_xy = np.asarray(layout.ij_to_xy(goal_cell), np.float32)
        super().__init__(spec, engine, self.goal_xy)
        self._init_qpos = np.asarray(init_qpos, np.float32)
        self._tracked = dict(tracked)
        self._start_xy = np.stack([layout.ij_to_xy(cell) for cell in start_cells]).astype(np.float32)

    def reset(self, rng: jax.Array, start_ij: Any = None, goal_ij: Any = None) -> State:
        """Return a start of the task, or of one's own choice of cells.

        Args:
            rng: a typed key.
            start_ij: int[2], the cell (i, j) where the body starts, with the usual noise; None takes the task's.
            goal_ij: int[2], the cell at whose centre the goal is; None takes the task's.

        Raises:
            ValueError: a cell is a wall or outside the maze (not seen inside jit, where cells are abstract).
        """
        return self._reset(rng, (start_ij,), goal_ij)

    def _reset(self, rng: jax.Array, start_cells: Sequence[Any], goal_cell: Any) -> State:
        """Return a start with everything in ``start_cells``, one each; None takes the task's."""
        pose_key, qvel_key, place_key, next_key = jax.random.split(rng, 4)
        qpos, qvel = self._start_pose(pose_key, qvel_key)
        shifts = jax.random.uniform(place_key, self._start_xy.shape, minval=-START_NOISE, maxval=START_NOISE)
        for index, cell, own_xy, shift in zip(self._tracked.values(), start_cells, self._start_xy, shifts, strict=True):
            qpos = qpos.at[index : index + 2].set(self._cell_xy(cell, own_xy) + shift)
        return self.reset_to(qpos, qvel, self._cell_xy(goal_cell, self.goal_xy), next_key)

    def _start_pose(self, qpos_key: jax.Array, qvel_key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return (qpos[nq], qvel[nv]) of a reset, before things are put in their cells."""
        noise = jax.random.uniform(qpos_key, self._init_qpos.shape, minval=-RESET_NOISE, maxval=RESET_NOISE)
        return jnp.asarray(self._init_qpos) + noise, RESET_NOISE * jax.random.normal(qvel_key, (self.engine.nv,))

    def _cell_xy(self, cell: Any, default_xy: np.ndarray) -> Any:
        """Return the centre float32[2] of ``cell``, checked where it is concrete; ``default_xy`` for None."""
        if cell is None:
            return default_xy
        if not isinstance(cell, jax.core.Tracer):
            self.layout.check_free(np.asarray(cell))
        return jnp.asarray(self.layout.ij_to_xy(cell), jnp.float32)

    def reset_to(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        goal: Any = None,
        key: jax.Array | None = None,
        extra: jax.Array | None = None,
    ) -> State:
        """Return any simulator state as the first of an episode; ``goal`` is float[2], teleporters draw from ``key``.

        Args and results are those of ``Task.reset_to``.
        """
        state = super().reset_to(qpos, qvel, goal, key, extra)
        if self.layout.teleporters is not None:
            reset_key, teleport_key = jax.random.split(state.info["reset_key"])
            state.info.update(reset_key=reset_key, teleport_key=teleport_key)
        return state

    def step(self, state: State, action: jax.Array) -> State:
        """Return the state after one control step under ``action[act]`` in [-1, 1], and after a teleporter's."""
        after = super().step(state, action)
        if self.layout.teleporters is None:
            return after
        use_key, next_key = jax.random.split(state.info["teleport_key"])
        return after.replace(
            pipeline_state=self.teleport(after.pipeline_state, use_key), info=after.info | {"teleport_key": next_key}
        )

    def teleport(self, pipeline_state: PipelineState, key: jax.Array) -> PipelineState:
        """Return the state after what the maze does to a body at an entrance; the same without teleporters."""
        xy = self.layout.teleport(pipeline_state.qpos[:2], key)
        return pipeline_state.replace(qpos=pipeline_state.qpos.at[:2].set(xy))

    def success(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        """Return bool[...], whether the last thing of ``qpos[..., nq]`` is within 0.5 of ``goal[..., 2]``."""
        xp = jnp if isinstance(qpos, jax.Array) or isinstance(goal, jax.Array) else np
        *_, last = self._tracked.values()
        gap = qpos[..., last : last + 2] - goal
        return xp.linalg.norm(gap, axis=-1) <= GOAL_TOLERANCE

    def file_rewards(self, rewards: np.ndarray) -> np.ndarray:
        """Return a file's rewards as success - 1; D4RL's sparse ones, 0 and 1, are one more."""
        return rewards - np.float32(1.0) if len(rewards) and rewards.min() >= 0 else rewards

    def check_rows(self, rows: StateRows) -> list[str]:
        """Return a line for each thing inside walls: rows of another maze, or with another origin (as Minari's)."""
        states = rows.observations if rows.qpos is None else rows.qpos  # both have things at the same places
        lines = []
        for name, index in self._tracked.items():
            with np.errstate(invalid="ignore"):  # of numbers too large for a cell, which is a wall then
                cells = self.layout.xy_to_ij(states[:, index : index + 2])
            inside = self.layout.grid[cells[:, 0], cells[:, 1]] == 1
            if inside.mean() > _IN_WALLS:
                lines.append(
                    f"the {name} is inside the walls of {self.spec.name} in {inside.mean():.0%} of the rows: "
                    "made for another maze, or with another origin?"
                )
        return lines

    def check_steps(self, rows: StateRows) -> list[str]:
        """Return a line where states and observations disagree, and where the body moves too far in one step."""
        if rows.qpos is None:
            return []
        lines = []
        differ = _apart(rows.observations[:, :2], rows.qpos[:, :2])
        if rows.qvel is not None and self.observation_size == self.engine.nq + self.engine.nv:  # it is the whole state
            differ |= _apart(rows.observations, np.concatenate([rows.qpos, rows.qvel], axis=1))
        if differ.any():
            lines.append(f"qpos, qvel and observations disagree on the state in {count_rows(differ)}")
        if self.layout.teleporters is None:
            moves = rows.next_observations[:, :2] - rows.observations[:, :2]
            jumps = np.linalg.norm(moves, axis=1) > LARGEST_MOVE
            if jumps.any():
                lines.append(
                    f"the body moves more than {LARGEST_MOVE} in one step in {count_rows(jumps)}: ends out of step?"
                )
        return lines

    def position(self, qpos: Any) -> dict[str, Any]:
        """Return the places [..., 2] of everything tracked, by name, the body first."""
        return {name: qpos[..., index : index + 2] for name, index in self._tracked.items()}

    def floor_map(self) -> FloorMap:
        """Return the maze and the goal."""
        corner = np.asarray(self.layout.ij_to_xy((0, 0))) - UNIT / 2
        return FloorMap(self.layout.grid, corner, UNIT, self.goal_xy)

    def distance_left(self, qpos: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
        """Return float64[...], shortest-path length to the task's goal from ``qpos[..., nq]``; for measuring only.

        Paths are those of the walls: teleporters are no short cut, and a place without a way out is at distance inf.
        """
        points = [*self.position(np.asarray(qpos)).values(), self.goal_xy]
        legs = [self.layout.distance(a, b) for a, b in itertools.pairwise(points)]
        return np.sum(legs, axis=0)


def _apart(some: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return bool[N], rows that are not the same."""
    with np.errstate(over="ignore"):
        return np.abs(some - other).max(axis=1) > SAME
