"""Label rows with rewards and masks: the task's own where the simulator's states are known, else the file's."""

from __future__ import annotations

import numpy as np

from envs.task import Task
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.readers.rows import Rows


def label(rows: Rows, env: Task, source: str) -> Dataset:
    """Return the data set of ``rows``, whose arrays it takes over.

    Args:
        rows: as ``checks.prepare`` left them without finding a fault.
        env: the task; its ``labels`` of the states before the action decide, as online.
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
        extra=rows.extra,
        quality=rows.quality,
        source=source,
        notes=tuple(rows.notes),
        mismatch=rows.mismatch,
    )


def drop_unknown(rows: Rows, env: Task) -> None:
    """Drop rows without a next observation in which the task goes on, in place: values would use an invented one."""
    if rows.unknown_next is None or not rows.unknown_next.any():
        return
    unknown, (_, masks) = rows.unknown_next, task_labels(rows, env)
    dropped = unknown & (masks > 0)
    rows.drop(dropped)
    rows.unknown_next = None
    gone = int(dropped.sum())
    rows.notes.append(
        f"no next_observations: of {unknown.sum()} terminal rows that end an episode, {unknown.sum() - gone} are kept "
        f"and {gone} dropped, where {env.spec.full_name} goes on"
    )


def task_labels(rows: Rows, env: Task) -> tuple[np.ndarray, np.ndarray]:
    """Return the task's (rewards float32[N], masks float32[N]), or the file's where it has no simulator states."""
    if rows.qpos is not None:
        return env.labels(rows)
    assert rows.rewards is not None  # checks.errors saw to it
    masks = np.ones(rows.size, np.float32) if rows.terminals is None else 1.0 - rows.terminals
    return env.file_rewards(rows.rewards), masks
