"""D4RL's flat ``.hdf5``, which is also what is written here (with ``next_observations`` and checksums)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from qdos_brax.data.readers.rows import Rows, after_action, unreadable
from qdos_brax.data.readers.table import HDF5Table

_OPTIONAL = ("next_observations", "rewards", "timeouts", "infos/qpos", "infos/qvel", "infos/quality")
JUMP = 1.5  # no ant or humanoid gets that far in one control step; the first D4RL files have resets without a mark
_KITCHEN_SIZES = (60, 9)  # numbers per observation and action of D4RL's kitchen
_KITCHEN_SOLVED = 4.0  # its reward counts the tasks that are complete


def load(path: Path) -> Rows:
    """The transitions of a D4RL-flat ``.hdf5``.

    Where episodes end is found, not believed: ant mazes of version 0 have ``timeouts`` out of step, those of version 2
    mark every row at the goal as terminal although the episode goes on, the kitchen has no ``timeouts`` and marks the
    last row of every demonstration as terminal, solved or not. Without next observations the last row of an episode
    is only a next state.

    Raises:
        UserError: unreadable, incomplete, or sizes that do not fit.
    """
    with unreadable(path), HDF5Table(path) as table:
        table.require(("observations", "actions", "terminals"), _OPTIONAL)
        terminals = table.column("terminals") != 0
        marked = table.column("timeouts") != 0 if "timeouts" in table else terminals.copy()
        notes: list[str] = []
        keep = None
        (observations,) = table.floats("observations", None)
        if "next_observations" in table:
            (following,) = table.floats("next_observations", None)
            breaks = _breaks(observations, following)
        else:
            breaks = _jumps(observations) if "infos/qpos" in table else np.zeros(len(observations), bool)
        ends = marked | breaks
        if len(ends):
            ends[-1] = True
            _note_breaks(notes, marked, breaks)
        if "next_observations" not in table:
            keep, is_next = ~ends, np.roll(~ends, 1)
            observations, following = observations[keep], observations[is_next]
            ends = np.roll(ends, -1)[keep]
        rows = Rows(observations, table.floats("actions", keep)[0], following, ends, notes=notes)
        rows.terminals = terminals.astype(np.float32) if keep is None else terminals[keep].astype(np.float32)
        for key in ("qpos", "qvel"):
            if f"infos/{key}" in table:
                setattr(rows, key, table.floats(f"infos/{key}", keep)[0])
        if "rewards" in table:
            rows.rewards = table.numbers("rewards", keep)
        if "infos/quality" in table:
            quality = table.column("infos/quality").astype(np.int8)
            rows.quality = quality if keep is None else quality[keep]
        if "timeouts" not in table:
            _mend_kitchen(rows)
        after_action(path, rows)
        return rows


def _breaks(observations: np.ndarray, following: np.ndarray) -> np.ndarray:
    """bool[N]: the next observation is not the next row's."""
    breaks = np.zeros(len(observations), bool)
    if observations.shape == following.shape:  # else the sizes are reported by the checks
        breaks[:-1] = np.abs(observations[1:] - following[:-1]).reshape(len(breaks) - 1, -1).max(axis=1) > 1e-6
    return breaks


def _jumps(observations: np.ndarray) -> np.ndarray:
    """bool[N]: the body is somewhere else in the next row.

    Every body's observation begins with its place. ``infos/qpos`` would not do: D4RL stores it after the action.
    """
    jumps = np.zeros(len(observations), bool)
    if observations.ndim == 2:  # else the sizes are reported by the checks
        jumps[:-1] = np.linalg.norm(np.diff(observations[:, :2], axis=0), axis=1) > JUMP
    return jumps


def _note_breaks(notes: list[str], marked: np.ndarray, breaks: np.ndarray) -> None:
    unmarked = breaks & ~marked
    unmarked[-1] = False
    if unmarked.any():
        notes.append(
            f"{unmarked.sum()} episode ends are not marked, the first at row {unmarked.argmax()}: "
            "timeouts out of step; ends are taken where the state jumps as well"
        )


def _mend_kitchen(rows: Rows) -> None:
    sizes = (rows.observations.shape[-1], rows.actions.shape[-1])
    if sizes == _KITCHEN_SIZES and rows.rewards is not None:
        rows.terminals = (rows.rewards >= _KITCHEN_SOLVED).astype(np.float32)
        rows.notes.append("no timeouts: demonstrations end at their terminals, and only four complete tasks terminate")
