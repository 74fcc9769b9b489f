"""Define OGBench's cubes: one or two, each of which has to be carried to its place."""

from __future__ import annotations

from typing import Any

import numpy as np

from envs.families import TaskSpec
from envs.manipulation.manipspace import CUBE, ManipSpaceTask, TableState, near
from envs.manipulation.manipspace_rig import ROBOT_JOINTS, ManipSpaceRig


class Cube(ManipSpaceTask):
    """Simulate ``cube-single`` (qpos 21, qvel 20, observation 28) or ``cube-double`` (28, 26, 37).

    A goal is float[3 c], the place of each cube.

    Args:
        spec: which task.
        physics: "mujoco".
    """

    def __init__(self, spec: TaskSpec, physics: str) -> None:
        super().__init__(spec, ManipSpaceRig)

    def goal_of(self, description: dict[str, Any]) -> np.ndarray:
        """Return float64[3 c], the places of the cubes."""
        return np.asarray(description["goal_xyzs"], np.float64).ravel()

    def start_of(self, description: dict[str, Any]) -> TableState:
        """Return the cubes about where they start."""
        return _cubes_alone(description["init_xyzs"])

    def goal_state(self, description: dict[str, Any]) -> TableState:
        """Return the cubes in their places."""
        return _cubes_alone(description["goal_xyzs"])

    def in_place(self, qpos: Any, goal: Any, extra: Any = None) -> Any:
        """Return bool[..., c], which cubes are within 4 cm of their place."""
        placed = qpos[..., ROBOT_JOINTS:].reshape(*qpos.shape[:-1], self.cubes, CUBE)[..., :3]
        return near(placed, goal.reshape(*goal.shape[:-1], self.cubes, 3))


def _cubes_alone(places: Any) -> TableState:
    return TableState(np.array(places, np.float64), np.zeros(0), np.zeros(0, np.int32))
