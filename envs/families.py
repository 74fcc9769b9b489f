"""The families of tasks as plain data: cells, sizes, caps, engines. Loads no jax, so that listing is quick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

Cell = tuple[int, int]


@dataclass(frozen=True)
class Family:
    """What the tasks of one body have in common.

    Attributes:
        env_class: "module:class" of the environment.
        observation_size: numbers per observation.
        action_size: numbers per action, each in [-1, 1].
        engines: the engines it runs on: "mujoco" (MuJoCo C), "mjx", "mjx-warp" (MuJoCo Warp, on CUDA).
        default_task: the task of a name without "-taskN" (as OGBench's single-task mode).
        episode_lengths: cap in control steps, by maze.
        tasks: by maze, for task 1 to 5: the start cell of everything that has one, the body first, then the goal cell.
    """

    env_class: str
    observation_size: int
    action_size: int
    engines: tuple[str, ...]
    default_task: int
    episode_lengths: Mapping[str, int]
    tasks: Mapping[str, Sequence[tuple[Cell, ...]]]


@dataclass(frozen=True)
class TaskSpec:
    """Which task.

    Attributes:
        name: family and maze, as "antmaze-large".
        family: a key of ``FAMILIES``.
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

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Start cells, the body's first, and last the goal cell."""
        return FAMILIES[self.family].tasks[self.maze][self.task_id - 1]


# Cells and caps are OGBench 1.2.2's.
_MAZE_TASKS: dict[str, list[tuple[Cell, ...]]] = {
    "medium": [((1, 1), (6, 6)), ((6, 1), (1, 6)), ((5, 3), (4, 2)), ((6, 5), (6, 1)), ((2, 6), (1, 1))],
    "large": [((1, 1), (7, 10)), ((5, 4), (7, 1)), ((7, 4), (1, 10)), ((3, 8), (5, 4)), ((1, 1), (5, 4))],
    "giant": [((1, 1), (10, 14)), ((1, 14), (10, 1)), ((8, 14), (1, 1)), ((8, 3), (5, 12)), ((5, 9), (3, 8))],
}
_TELEPORT_TASKS: list[tuple[Cell, ...]] = [
    ((1, 10), (7, 1)),
    ((1, 1), (7, 10)),
    ((5, 6), (7, 10)),
    ((7, 1), (7, 10)),
    ((5, 6), (7, 1)),
]
_SOCCER_TASKS: dict[str, list[tuple[Cell, ...]]] = {
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

FAMILIES: dict[str, Family] = {
    "antmaze": Family(
        env_class="envs.mazes.locomotion:AntMaze",
        observation_size=29,
        action_size=8,
        engines=("mujoco", "mjx", "mjx-warp"),
        default_task=1,
        episode_lengths=dict.fromkeys((*_MAZE_TASKS, "teleport"), 1000),
        tasks={**_MAZE_TASKS, "teleport": _TELEPORT_TASKS},
    ),
    "antsoccer": Family(
        env_class="envs.mazes.soccer:AntSoccer",
        observation_size=42,
        action_size=8,
        engines=("mujoco", "mjx", "mjx-warp"),
        default_task=4,
        episode_lengths=dict.fromkeys(_SOCCER_TASKS, 1000),
        tasks=_SOCCER_TASKS,
    ),
    "humanoidmaze": Family(
        env_class="envs.mazes.locomotion:HumanoidMaze",
        observation_size=69,
        action_size=21,
        engines=("mujoco", "mjx", "mjx-warp"),
        default_task=1,
        episode_lengths={"medium": 2000, "large": 2000, "giant": 4000},
        tasks=_MAZE_TASKS,
    ),
}
