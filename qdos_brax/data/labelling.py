"""Rewards and masks of rows: the task's own where the simulator's states are known, else the file's."""

from __future__ import annotations

from typing import Any

import numpy as np

from envs.task import labels
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.readers.rows import Rows


def label(rows: Rows, env: Any, source: str) -> Dataset:
    """The data set of checked ``rows``, whose arrays it takes over.

    Args:
        rows: with ``qpos`` or ``rewards``.
        env: the task; its ``success`` on ``qpos`` before the action decides, as online.
        source: where the rows came from, for messages.
    """
    rewards, masks = task_labels(rows, env)
    return Dataset(
        observations=rows.observations,
        actions=np.clip(rows.actions, -1.0, 1.0, out=rows.actions),
        rewards=rewards,
        masks=masks,
        ends=rows.ends,
        next_observations=rows.next_observations,
        qpos=rows.qpos,
        qvel=rows.qvel,
        quality=rows.quality,
        source=source,
    )


def task_labels(rows: Rows, env: Any) -> tuple[np.ndarray, np.ndarray]:
    """(rewards float32[N], masks float32[N]) of the task, or the file's where it has no simulator states."""
    if rows.qpos is not None:
        rewards, masks = labels(np.asarray(env.success(rows.qpos, env.goal_xy)).astype(np.float32))
        return rewards, masks
    assert rows.rewards is not None  # checks.errors saw to it
    masks = np.ones(rows.size, np.float32) if rows.terminals is None else 1.0 - rows.terminals
    return as_costs(rows.rewards), masks


def as_costs(rewards: np.ndarray) -> np.ndarray:
    """D4RL's sparse rewards are 0 and 1; ours, as OGBench's, are one less."""
    return rewards - np.float32(1.0) if len(rewards) and rewards.min() >= 0 else rewards
