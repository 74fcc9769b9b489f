"""What all maze tasks share: reset noise, success, reward, termination, cap, as OGBench's single-task mode has them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.brax_base import Env, State
from envs.families import Cell, TaskSpec
from envs.mazes.maze import Maze
from envs.physics.base import Engine, PipelineState

__all__ = ["GOAL_TOLERANCE", "RESET_NOISE", "START_NOISE", "TaskEnv", "TaskSpec", "labels"]

GOAL_TOLERANCE = 0.5
START_NOISE = 1.0  # half width of the uniform noise on start positions
RESET_NOISE = 0.1  # half width of the uniform noise on qpos, standard deviation of the normal noise on qvel


def labels(success: Any) -> tuple[Any, Any]:
    """(reward, mask) of a state before the action, from ``success[...]`` (0.0 or 1.0): online and for data alike."""
    return success - 1.0, 1.0 - success


class TaskEnv(Env):
    """A body in a maze, with movable things to bring to a goal.

    ``tracked`` names the x-coordinates in qpos of everything that has a start cell, the body first. The last one has
    to reach the goal; the way left goes through all of them in turn.

    Success is read on the state before the action (OGBench's ``success_timing="pre"``), reward is success - 1, success
    ends the episode, and ``step`` never resets: see ``envs.wrappers.AutoReset``.

    In a maze with teleporters a control step that ends in reach of an entrance moves the body to a random exit. As in
    OGBench the observation is still that of the entrance; the next one shows where it came out.

    Args:
        spec: which task.
        layout: the maze.
        engine: the physics.
        init_qpos: float[nq], qpos at load, to which reset adds noise.
        tracked: indices into qpos, see above.
        start_cells: the (i, j) where each tracked thing starts.
        goal_cell: the (i, j) of the goal.
    """

    def __init__(
        self,
        spec: TaskSpec,
        layout: Maze,
        engine: Engine,
        init_qpos: np.ndarray,
        tracked: Sequence[int],
        start_cells: Sequence[Cell],
        goal_cell: Cell,
    ) -> None:
        self.spec = spec
        self.layout = layout
        self.engine = engine
        self.goal_xy = np.asarray(layout.ij_to_xy(goal_cell), np.float32)
        self._init_qpos = np.asarray(init_qpos, np.float32)
        self._tracked = tuple(tracked)
        self._start_xy = np.stack([layout.ij_to_xy(cell) for cell in start_cells]).astype(np.float32)

    @property
    def observation_size(self) -> int:
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[-1]

    @property
    def action_size(self) -> int:
        return self.engine.nu

    @property
    def backend(self) -> str:
        return self.engine.name

    @property
    def episode_length(self) -> int:
        return self.spec.episode_length

    def reset(self, rng: jax.Array, start_ij: Any = None, goal_ij: Any = None) -> State:
        """A start of the task, or of one's own choice of cells.

        Args:
            rng: a typed key.
            start_ij: int[2], the cell (i, j) where the body starts, with the usual noise; None takes the task's.
            goal_ij: int[2], the cell at whose centre the goal is; None takes the task's.

        Raises:
            ValueError: a cell is a wall or outside the maze (not seen inside jit, where cells are abstract).
        """
        return self._reset(rng, (start_ij,), goal_ij)

    def _reset(self, rng: jax.Array, start_cells: Sequence[Any], goal_cell: Any) -> State:
        """A start with everything tracked in ``start_cells``, one each; None takes the task's."""
        pose_key, qvel_key, place_key, next_key = jax.random.split(rng, 4)
        qpos, qvel = self._start_pose(pose_key, qvel_key)
        shifts = jax.random.uniform(place_key, self._start_xy.shape, minval=-START_NOISE, maxval=START_NOISE)
        for index, cell, own_xy, shift in zip(self._tracked, start_cells, self._start_xy, shifts, strict=True):
            qpos = qpos.at[index : index + 2].set(self._cell_xy(cell, own_xy) + shift)
        return self.reset_to(qpos, qvel, self._cell_xy(goal_cell, self.goal_xy), next_key)

    def _start_pose(self, qpos_key: jax.Array, qvel_key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(qpos[nq], qvel[nv]) of a reset, before things are put in their cells."""
        noise = jax.random.uniform(qpos_key, self._init_qpos.shape, minval=-RESET_NOISE, maxval=RESET_NOISE)
        return jnp.asarray(self._init_qpos) + noise, RESET_NOISE * jax.random.normal(qvel_key, (self.engine.nv,))

    def _cell_xy(self, cell: Any, default_xy: np.ndarray) -> Any:
        """The centre float32[2] of ``cell``, checked where it is concrete; ``default_xy`` for None."""
        if cell is None:
            return default_xy
        if not isinstance(cell, jax.core.Tracer):
            self.layout.check_free(np.asarray(cell))
        return jnp.asarray(self.layout.ij_to_xy(cell), jnp.float32)

    def reset_to(self, qpos: jax.Array, qvel: jax.Array, goal_xy: Any = None, key: jax.Array | None = None) -> State:
        """Any simulator state, as the first of an episode.

        Args:
            qpos: float[nq].
            qvel: float[nv].
            goal_xy: float[2]; None takes the task's goal.
            key: what teleporters, and ``AutoReset`` for the next episode, draw from; None takes a fixed one.
        """
        pipeline_state = self.engine.init(qpos, qvel)
        obs = self.observe(pipeline_state)
        key = jax.random.key(0) if key is None else key
        info = {
            "goal_xy": jnp.asarray(self.goal_xy if goal_xy is None else goal_xy, jnp.float32),
            "steps": jnp.zeros((), jnp.int32),
            "truncation": jnp.zeros(()),
            "final_obs": obs,
            "reset_key": key,
        }
        if self.layout.teleporters is not None:
            info["reset_key"], info["teleport_key"] = jax.random.split(key)
        return State(pipeline_state, obs, jnp.zeros(()), jnp.zeros(()), {"success": jnp.zeros(())}, info)

    def step(self, state: State, action: jax.Array) -> State:
        """One control step under ``action[nu]`` in [-1, 1]."""
        success = self.success(state.pipeline_state.qpos, state.info["goal_xy"]).astype(jnp.float32)
        pipeline_state = self.engine.step(state.pipeline_state, action)
        obs = self.observe(pipeline_state)
        steps = state.info["steps"] + 1
        capped = (steps >= self.episode_length).astype(jnp.float32)
        info = state.info | {"steps": steps, "truncation": capped * (1.0 - success), "final_obs": obs}
        if self.layout.teleporters is not None:
            teleport_key, info["teleport_key"] = jax.random.split(state.info["teleport_key"])
            pipeline_state = self.teleport(pipeline_state, teleport_key)
        return state.replace(
            pipeline_state=pipeline_state,
            obs=obs,
            reward=labels(success)[0],
            done=jnp.maximum(success, capped),
            metrics=state.metrics | {"success": success},
            info=info,
        )

    def observe(self, pipeline_state: PipelineState) -> jax.Array:
        """float32[obs], what is seen of a state; qpos and qvel unless a body says otherwise."""
        return jnp.concatenate([pipeline_state.qpos, pipeline_state.qvel])

    def teleport(self, pipeline_state: PipelineState, key: jax.Array) -> PipelineState:
        """What the maze does to the body after a control step; changes nothing where there are no teleporters."""
        xy = self.layout.teleport(pipeline_state.qpos[:2], key)
        return pipeline_state.replace(qpos=pipeline_state.qpos.at[:2].set(xy))

    def success(self, qpos: Any, goal_xy: Any) -> Any:
        """bool[...]: the last tracked thing of ``qpos[..., nq]`` is within 0.5 of ``goal_xy[..., 2]``."""
        xp = jnp if isinstance(qpos, jax.Array) or isinstance(goal_xy, jax.Array) else np
        last = self._tracked[-1]
        gap = qpos[..., last : last + 2] - goal_xy
        return xp.linalg.norm(gap, axis=-1) <= GOAL_TOLERANCE

    def true_distance(self, qpos: np.ndarray) -> np.ndarray:
        """float64[...], shortest-path length left to the task's goal from ``qpos[..., nq]``; for measuring only.

        Paths are those of the walls: teleporters are no short cut, and a place without a way out is at distance inf.
        """
        qpos = np.asarray(qpos)
        points = [qpos[..., index : index + 2] for index in self._tracked] + [self.goal_xy]
        legs = [self.layout.distance(a, b) for a, b in itertools.pairwise(points)]
        return np.sum(legs, axis=0)
