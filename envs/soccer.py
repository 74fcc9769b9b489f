"""Ant soccer: the ant has to bring the ball to the goal."""

from __future__ import annotations

from typing import Any

import jax

from envs.brax_base import State
from envs.families import TaskSpec
from envs.maze import get_maze
from envs.models import ant_model
from envs.physics import make_engine
from envs.task import TaskEnv

BALL_QPOS = 15  # the ball's x; the ant's 15 come first


class AntSoccer(TaskEnv):
    """An ant and a ball: qpos 22, qvel 20, action 8, observation 42, 10 control steps per second.

    Args:
        spec: which task.
        physics: "mjx" or "mujoco".
    """

    def __init__(self, spec: TaskSpec, physics: str) -> None:
        layout = get_maze(spec.maze)
        model = ant_model(layout, ball=True)
        ant, ball, goal = spec.cells
        engine = make_engine(physics, model, layout)
        super().__init__(spec, layout, engine, model.qpos0, (0, BALL_QPOS), (ant, ball), goal)

    def reset(self, rng: jax.Array, start_ij: Any = None, goal_ij: Any = None, ball_ij: Any = None) -> State:
        """As ``TaskEnv.reset``; ``ball_ij`` is the cell where the ball starts, None the task's."""
        return self._reset(rng, (start_ij, ball_ij), goal_ij)
