"""What all maze tasks share: reset noise, success, reward, termination, cap, as OGBench's single-task mode has them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from envs.maze import Maze
from envs.physics.base import Engine

GOAL_TOLERANCE = 0.5
START_NOISE = 1.0  # half width of the uniform noise on start positions
RESET_NOISE = 0.1  # half width of the uniform noise on qpos, standard deviation of the normal noise on qvel


@dataclass(frozen=True)
class TaskSpec:
    """Which task.

    Attributes:
        name: family and maze, as "antmaze-large".
        family: "antmaze" or "antsoccer".
        maze: layout name.
        task_id: 1 to 5.
        episode_length: cap in control steps.
    """

    name: str
    family: str
    maze: str
    task_id: int
    episode_length: int

    @property
    def full_name(self) -> str:
        """The name with its task, as "antmaze-large-task1"."""
        return f"{self.name}-task{self.task_id}"


class TaskEnv(Env):
    """A body in a maze, with movable things to bring to a goal.

    ``tracked`` names the x-coordinates in qpos of everything that has a start cell, the body first. The last one has
    to reach the goal; the way left goes through all of them in turn.

    Success is read on the state before the action (OGBench's ``success_timing="pre"``), reward is success - 1, success
    ends the episode, and ``step`` never resets: see ``envs.wrappers.AutoReset``.

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
        start_cells: Sequence[tuple[int, int]],
        goal_cell: tuple[int, int],
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
        return self.engine.nq + self.engine.nv

    @property
    def action_size(self) -> int:
        return self.engine.nu

    @property
    def backend(self) -> str:
        return self.engine.name

    @property
    def episode_length(self) -> int:
        return self.spec.episode_length

    def reset(self, rng: jax.Array) -> State:
        """A start of the task; ``rng`` is a typed key."""
        qpos_key, qvel_key, place_key, next_key = jax.random.split(rng, 4)
        noise = jax.random.uniform(qpos_key, self._init_qpos.shape, minval=-RESET_NOISE, maxval=RESET_NOISE)
        qpos = jnp.asarray(self._init_qpos) + noise
        qvel = RESET_NOISE * jax.random.normal(qvel_key, (self.engine.nv,))
        shifts = jax.random.uniform(place_key, self._start_xy.shape, minval=-START_NOISE, maxval=START_NOISE)
        for index, xy in zip(self._tracked, self._start_xy + shifts, strict=True):
            qpos = qpos.at[index : index + 2].set(xy)
        return self.reset_to(qpos, qvel, self.goal_xy, next_key)

    def reset_to(self, qpos: jax.Array, qvel: jax.Array, goal_xy: Any = None, key: jax.Array | None = None) -> State:
        """Any simulator state, as the first of an episode.

        Args:
            qpos: float[nq].
            qvel: float[nv].
            goal_xy: float[2]; None takes the task's goal.
            key: what ``AutoReset`` draws the next episode from; None takes a fixed one.
        """
        pipeline_state = self.engine.init(qpos, qvel)
        obs = _observe(pipeline_state.qpos, pipeline_state.qvel)
        info = {
            "goal_xy": jnp.asarray(self.goal_xy if goal_xy is None else goal_xy, jnp.float32),
            "steps": jnp.zeros((), jnp.int32),
            "truncation": jnp.zeros(()),
            "final_obs": obs,
            "reset_key": jax.random.key(0) if key is None else key,
        }
        return State(pipeline_state, obs, jnp.zeros(()), jnp.zeros(()), {"success": jnp.zeros(())}, info)

    def step(self, state: State, action: jax.Array) -> State:
        """One control step under ``action[nu]`` in [-1, 1]."""
        success = self.success(state.pipeline_state.qpos, state.info["goal_xy"]).astype(jnp.float32)
        pipeline_state = self.engine.step(state.pipeline_state, action)
        obs = _observe(pipeline_state.qpos, pipeline_state.qvel)
        steps = state.info["steps"] + 1
        capped = (steps >= self.episode_length).astype(jnp.float32)
        info = state.info | {"steps": steps, "truncation": capped * (1.0 - success), "final_obs": obs}
        return state.replace(
            pipeline_state=pipeline_state,
            obs=obs,
            reward=success - 1.0,
            done=jnp.maximum(success, capped),
            metrics=state.metrics | {"success": success},
            info=info,
        )

    def success(self, qpos: Any, goal_xy: Any) -> Any:
        """bool[...]: the last tracked thing of ``qpos[..., nq]`` is within 0.5 of ``goal_xy[..., 2]``."""
        xp = jnp if isinstance(qpos, jax.Array) or isinstance(goal_xy, jax.Array) else np
        last = self._tracked[-1]
        gap = qpos[..., last : last + 2] - goal_xy
        return xp.linalg.norm(gap, axis=-1) <= GOAL_TOLERANCE

    def true_distance(self, qpos: np.ndarray) -> np.ndarray:
        """float64[...], shortest-path length left to the task's goal from ``qpos[..., nq]``; for measuring only."""
        qpos = np.asarray(qpos)
        points = [qpos[..., index : index + 2] for index in self._tracked] + [self.goal_xy]
        legs = [self.layout.distance(a, b) for a, b in itertools.pairwise(points)]
        return np.sum(legs, axis=0)


def _observe(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    return jnp.concatenate([qpos, qvel], axis=-1)
