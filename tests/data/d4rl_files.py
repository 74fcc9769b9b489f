"""Files as D4RL's generators write them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np


def write_d4rl(path: Path, columns: Mapping[str, np.ndarray]) -> Path:
    """As D4RL's generators do: flat keys, gzip, no next observations."""
    with h5py.File(path, "w") as file:
        for key, value in columns.items():
            file.create_dataset(key, data=value, compression="gzip")
    return path


def d4rl_antmaze(lengths: tuple[int, ...] = (9, 7, 8)) -> dict[str, np.ndarray]:
    """What D4RL's generator stores: ``infos`` after the action, the last row's next state lost, far resets.

    The body walks 0.2 per step from a start of its own; every other number of the state counts up.
    """
    states = []
    for episode, length in enumerate(lengths):
        state = np.arange((length + 1) * 29, dtype=np.float32).reshape(length + 1, 29) / 1000
        state[:, 0], state[:, 1] = 0.2 * np.arange(length + 1), 8.0 * episode
        states.append(state)
    before, after = np.concatenate([s[:-1] for s in states]), np.concatenate([s[1:] for s in states])
    timeouts = np.zeros(len(before), bool)
    timeouts[np.cumsum(lengths) - 1] = True
    return {
        "observations": before,
        "actions": np.linspace(-1, 1, before.shape[0] * 8, dtype=np.float32).reshape(-1, 8),
        "rewards": np.zeros(len(before), np.float32),
        "terminals": np.zeros(len(before), bool),
        "timeouts": timeouts,
        "infos/goal": np.full((len(before), 2), 5.0, np.float32),
        "infos/qpos": after[:, :15],
        "infos/qvel": after[:, 15:],
    }
