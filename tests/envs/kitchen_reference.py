"""gymnasium-robotics' kitchen, as a reference on this MuJoCo, with the sensors' errors that are given to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest
from gymnasium_robotics.envs.franka_kitchen import franka_env

import envs

ARM = 9


class GivenNoise:
    """Stand for a generator whose draws are known: 59 numbers for each state, in pieces."""

    def __init__(self, noise: np.ndarray) -> None:
        self._left: Iterator[float] = iter(np.asarray(noise, np.float64).ravel())

    def uniform(self, low: float, high: float, size: Sequence[int]) -> np.ndarray:
        assert (low, high) == (-1.0, 1.0)
        return np.array([next(self._left) for _ in range(int(np.prod(size)))])

    def all_used(self) -> bool:
        return next(self._left, None) is None


def reference(patch: pytest.MonkeyPatch, task: Any) -> gymnasium.Env:
    """FrankaKitchen-v1 with the subtasks of ``task``.

    MuJoCo 4's enums are not equal to NumPy's integers where they stand on the left, as in the reference's look-up of
    the robot's joints; these are the first nine.
    """
    patch.setattr(franka_env, "robot_get_obs", lambda model, data, names: (data.qpos[:ARM] + 0, data.qvel[:ARM] + 0))
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make("FrankaKitchen-v1", tasks_to_complete=list(task.subtasks))


def rollout(
    env: gymnasium.Env, actions: np.ndarray, noise: np.ndarray, start: tuple[np.ndarray, np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """What an episode brings, up to its end.

    Args:
        env: the reference.
        actions: [T, 9].
        noise: [T + 1, 59], the first for the start.
        start: (qpos, qvel); None takes the reference's own.

    Returns:
        observation[t + 1, 59], and reward, terminated, truncated, completed (subtasks so far), state[t, 59], each [t].
    """
    robot = env.unwrapped.robot_env
    robot._np_random = GivenNoise(noise)
    if start is not None:
        robot.init_qpos, robot.init_qvel = (np.asarray(part, np.float64) for part in start)
    observations = [env.reset()[0]["observation"]]
    rows: dict[str, list[Any]] = {name: [] for name in ("reward", "terminated", "truncated", "completed", "state")}
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action.astype(np.float64))
        observations.append(observation["observation"])
        found = (reward, terminated, truncated, len(info["episode_task_completions"]))
        for name, value in zip(rows, (*found, np.concatenate([robot.data.qpos, robot.data.qvel])), strict=True):
            rows[name].append(value)
        if terminated or truncated:
            break
    return {"observation": np.array(observations)} | {name: np.array(values) for name, values in rows.items()}


def kitchen(name: str) -> Any:
    return envs.make(name, physics="mujoco")
