"""Ant soccer: the ant has to bring the ball to the goal."""

from __future__ import annotations

from envs.maze import get_maze
from envs.models import ant_model
from envs.physics import make_engine
from envs.task import TaskEnv, TaskSpec

Cell = tuple[int, int]

BALL_QPOS = 15  # the ball's x; the ant's 15 come first

# Start cell of the ant, start cell of the ball, goal cell of task 1 to 5 (OGBench 1.2.2).
TASKS: dict[str, list[tuple[Cell, Cell, Cell]]] = {
    "arena": [
        ((1, 6), (2, 3), (5, 2)),
        ((2, 2), (5, 5), (2, 2)),
        ((6, 1), (2, 3), (6, 6)),
        ((6, 6), (1, 1), (6, 1)),
        ((4, 6), (6, 2), (1, 6)),
    ],
    "medium": [
        ((1, 1), (3, 4), (6, 6)),
        ((6, 1), (6, 5), (1, 1)),
        ((5, 3), (4, 2), (6, 5)),
        ((6, 5), (1, 1), (5, 3)),
        ((1, 6), (6, 1), (1, 6)),
    ],
}


class AntSoccer(TaskEnv):
    """An ant and a ball: qpos 22, qvel 20, action 8, observation 42, 10 control steps per second.

    Args:
        spec: which task.
        physics: "mjx" or "mujoco".
    """

    def __init__(self, spec: TaskSpec, physics: str) -> None:
        layout = get_maze(spec.maze)
        model = ant_model(layout, ball=True)
        ant, ball, goal = TASKS[spec.maze][spec.task_id - 1]
        engine = make_engine(physics, model, layout)
        super().__init__(spec, layout, engine, model.qpos0, (0, BALL_QPOS), (ant, ball), goal)
