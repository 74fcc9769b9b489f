"""Hold one transition per row, whatever the file it came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Dataset:
    """Hold N transitions in episode order, as float32 C-contiguous arrays.

    Attributes:
        observations: float32[N, obs].
        actions: float32[N, act], in [-1, 1].
        rewards: float32[N], the task's reward of the state before the action (in mazes success - 1).
        masks: float32[N], 0 where the value of the next state must not be bootstrapped. Not the same as ``ends``: an
            episode that was cut off ends with mask 1, and collected data may go on after a success.
        ends: bool[N], the last row of each episode.
        next_observations: float32[N, obs], the true next observation, at episode ends too.
        qpos: float32[N, nq] before the action, or None when the file has none.
        qvel: float32[N, nv] before the action, or None.
        extra: int32[N, e], discrete state before the action, or None.
        quality: int8[N], what produced the step (``quality.QUALITY``), or None. For measuring, never for training.
        source: where the rows came from, for messages.
        notes: what the reader had to correct or leave out, one line each.
        mismatch: how next observations miss the rows that follow; "" where they do not. See ``Rows``.
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    masks: np.ndarray
    ends: np.ndarray
    next_observations: np.ndarray
    qpos: np.ndarray | None = None
    qvel: np.ndarray | None = None
    extra: np.ndarray | None = None
    quality: np.ndarray | None = None
    source: str = ""
    notes: tuple[str, ...] = ()
    mismatch: str = ""

    @property
    def size(self) -> int:
        """Return the number of transitions."""
        return len(self.observations)

    @property
    def num_episodes(self) -> int:
        """Return the number of episodes, a last one without an end mark included."""
        return len(self.episode_bounds)

    @property
    def episode_bounds(self) -> np.ndarray:
        """Return int64[E, 2], first row and one past the last row of every episode."""
        return episode_bounds(self.ends)


def episode_bounds(ends: np.ndarray) -> np.ndarray:
    """Return int64[E, 2], [first, one past last) of every episode in ``ends`` (bool[N]); the last row ends one."""
    n = len(ends)
    stops = np.flatnonzero(ends) + 1
    if n and (len(stops) == 0 or stops[-1] != n):
        stops = np.append(stops, n)
    starts = np.concatenate([np.zeros(min(1, len(stops)), np.int64), stops[:-1]])
    return np.stack([starts, stops], axis=1).astype(np.int64)


def longest_episode(ends: np.ndarray) -> int:
    """Return the rows of the longest episode in ``ends`` (bool[N])."""
    return int(np.diff(episode_bounds(ends), axis=1).max(initial=0))
