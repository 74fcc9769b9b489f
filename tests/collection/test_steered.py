"""The steered expert in the maze: what the benchmark counts, by hand; and, slow, that it reaches the task's goal."""

from __future__ import annotations

import numpy as np
import pytest

import envs
from benchmarks import steered
from envs.mazes.maze import get_maze
from qdos_brax.collection.experts.rising import LIES, WALKS


def test_falls_are_counted_per_step_of_walking_and_told_by_their_place() -> None:
    qpos = np.zeros((2, 400, 28))  # in the middle of a cell, two metres from its walls
    qpos[:, :, 2], qpos[:, :, 3] = 1.2, 1.0
    stage = np.full((2, 400), WALKS)
    stage[:, 100:110] = LIES  # within the first 8 s, which do not count
    stage[0, 350:360], stage[1, 395:] = LIES, LIES
    qpos[0, 350:360, 2] = 0.2
    qpos[0, 340:350, 0] = -1.5  # half a metre from a wall
    found = steered.on_foot(get_maze("medium"), steered.Played(qpos, stage, np.zeros(2)), np.array([400, 380]))
    assert found["falls"] == 1 and found["falls_at_walls"] == 1.0  # the other body is at its goal by then
    assert found["falls_per_1000"] == pytest.approx(1000 / (79 - 10 + 60))
    assert found["down"] == pytest.approx(10 / (79 + 60))
    assert found["walking_at_walls"] == pytest.approx(10 / (79 - 10 + 60))
    assert found["up_5s"] == found["up_8s"] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_the_steered_humanoid_reaches_the_tasks_goal(noise: float) -> None:
    row = steered.measure(envs.make("humanoidmaze-medium-task1", physics="mujoco"), noise, "task", 64, seed=2)
    print(row)
    assert row["reached"] >= 0.95
    assert row["falls_per_1000"] < 0.2


@pytest.mark.slow
def test_the_steered_humanoid_seldom_falls_in_data() -> None:
    row = steered.measure(envs.make("humanoidmaze-medium-task1", physics="mujoco"), 0.2, "random", 64, seed=2)
    print(row)
    assert row["arrivals"] >= 2.5
    assert row["falls_per_1000"] < 0.45
