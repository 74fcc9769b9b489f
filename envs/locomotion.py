"""Mazes in which the body itself has to reach the goal."""

from __future__ import annotations

from envs.maze import get_maze
from envs.models import ant_model
from envs.physics import make_engine
from envs.task import TaskEnv, TaskSpec

Cell = tuple[int, int]

# Start and goal cell of task 1 to 5 (OGBench 1.2.2).
TASKS: dict[str, list[tuple[Cell, Cell]]] = {
    "medium": [((1, 1), (6, 6)), ((6, 1), (1, 6)), ((5, 3), (4, 2)), ((6, 5), (6, 1)), ((2, 6), (1, 1))],
    "large": [((1, 1), (7, 10)), ((5, 4), (7, 1)), ((7, 4), (1, 10)), ((3, 8), (5, 4)), ((1, 1), (5, 4))],
    "giant": [((1, 1), (10, 14)), ((1, 14), (10, 1)), ((8, 14), (1, 1)), ((8, 3), (5, 12)), ((5, 9), (3, 8))],
}


class AntMaze(TaskEnv):
    """An ant in a maze: qpos 15, qvel 14, action 8, observation 29, 10 control steps per second.

    Args:
        spec: which task.
        physics: "mjx" or "mujoco".
    """

    def __init__(self, spec: TaskSpec, physics: str) -> None:
        layout = get_maze(spec.maze)
        model = ant_model(layout)
        start, goal = TASKS[spec.maze][spec.task_id - 1]
        super().__init__(spec, layout, make_engine(physics, model, layout), model.qpos0, (0,), (start,), goal)
