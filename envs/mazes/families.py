"""Describe the maze families as plain data: mazes, start and goal cells, caps. Loads no jax."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from envs.families import Family, TaskSpec, Variant

Cell = tuple[int, int]
Tasks = Mapping[str, Sequence[tuple[Cell, ...]]]

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

_TASKS: dict[str, Tasks] = {
    "antmaze": {**_MAZE_TASKS, "teleport": _TELEPORT_TASKS},
    "antsoccer": _SOCCER_TASKS,
    "humanoidmaze": _MAZE_TASKS,
}


def cells_of(spec: TaskSpec) -> tuple[Cell, ...]:
    """Return the start cell (i, j) of everything that has one, the body first, and last the goal cell."""
    return _TASKS[spec.family][spec.variant][spec.task_id - 1]


def _variants(family: str, observation_size: int, action_size: int, caps: Mapping[str, int]) -> dict[str, Variant]:
    """Return one variant per maze of ``caps``."""
    tasks = _TASKS[family]
    return {maze: Variant(observation_size, action_size, cap, len(tasks[maze])) for maze, cap in caps.items()}


_ENGINES = ("mujoco", "mjx", "mjx-warp")

MAZE_FAMILIES = {
    "antmaze": Family(
        make="envs.mazes.locomotion:AntMaze",
        engines=_ENGINES,
        variants=_variants("antmaze", 29, 8, dict.fromkeys(_TASKS["antmaze"], 1000)),
        default_variant="large",
    ),
    "antsoccer": Family(
        make="envs.mazes.soccer:AntSoccer",
        engines=_ENGINES,
        variants=_variants("antsoccer", 42, 8, dict.fromkeys(_TASKS["antsoccer"], 1000)),
        default_variant="arena",
        default_task=4,
        alias_task=1,  # that of the paper's figures
    ),
    "humanoidmaze": Family(
        make="envs.mazes.locomotion:HumanoidMaze",
        engines=_ENGINES,
        variants=_variants("humanoidmaze", 69, 21, {"medium": 2000, "large": 2000, "giant": 4000}),
        default_variant="medium",
    ),
}
