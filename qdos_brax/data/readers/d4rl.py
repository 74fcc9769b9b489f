"""Read D4RL's flat layout, an ``.hdf5`` as a rule.

It is also what is written here, with ``next_observations`` and checksums.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qdos_brax.data.readers.rows import Rows, after_action, breaks_of, discrete, mismatch_of, note_breaks
from qdos_brax.data.readers.table import DataTable

_OPTIONAL = ("next_observations", "rewards", "timeouts", "infos/qpos", "infos/qvel", "infos/extra", "infos/quality")


class _Kitchen(NamedTuple):
    """Describe D4RL's kitchen files, which have no ``timeouts`` and mark the end of every demonstration as terminal."""

    observation_size: int
    action_size: int
    rewards: tuple[float, ...]  # how many of four subtasks are complete

    def fits(self, table: DataTable, rows: Rows) -> bool:
        """Return whether the file is one of them: no timeouts, their sizes, and no rewards but theirs."""
        sizes = (rows.observations.shape[-1], rows.actions.shape[-1])
        if "timeouts" in table or sizes != (self.observation_size, self.action_size) or rows.rewards is None:
            return False
        return bool(np.isin(rows.rewards, self.rewards).all())


_KITCHEN = _Kitchen(observation_size=60, action_size=9, rewards=(0.0, 1.0, 2.0, 3.0, 4.0))


def is_d4rl(table: DataTable) -> bool:
    """Return whether an archive has keys that D4RL's files have and OGBench's do not."""
    return any(key == "timeouts" or key.startswith("infos/") for key in table.shapes)


def load(table: DataTable, jump: float | None) -> Rows:
    """Return the transitions of a D4RL-flat file.

    Args:
        table: the file: an ``.hdf5``, or what ``numpy.savez`` made of the same arrays.
        jump: distance that the first two numbers of an observation, a position, never move in one step, which the
            first D4RL files need to find unmarked resets; None: they are no position.

    Episode ends are checked, not trusted: ant mazes of version 0 have ``timeouts`` out of step, those of version 2
    mark every row at the goal as terminal although the episode goes on, the kitchen has no ``timeouts`` and marks the
    last row of every demonstration as terminal, solved or not. Where neither next observations nor positions show
    whether an episode goes on after a terminal, it ends there (as in D4RL's ``sequence_dataset``). Without next
    observations the last row of an episode is only a next state, unless it is terminal.

    Raises:
        UserError: unreadable, incomplete, or sizes that do not fit.
    """
    table.require(("observations", "actions", "terminals"), _OPTIONAL)
    terminals = table.column("terminals") != 0
    marked = table.column("timeouts") != 0 if "timeouts" in table else terminals.copy()
    notes: list[str] = []
    keep, mismatch = None, ""
    (observations,) = table.floats("observations", None)
    if "next_observations" in table:
        (following,) = table.floats("next_observations", None)
        breaks = breaks_of(observations, following)
        mismatch = mismatch_of(observations, following, breaks)
    elif jump is not None and "infos/qpos" in table:
        breaks = _jumps(observations, jump)
    else:
        breaks, marked = np.zeros(len(observations), bool), marked | terminals
    ends = marked | breaks
    if len(ends):
        ends[-1] = True
        if not mismatch:
            note_breaks(notes, marked, breaks)
    if "next_observations" not in table:
        # A last row without a next state is of use where the task terminates in it: labelling decides.
        last_kept = ends & terminals
        keep = ~ends | last_kept
        following = observations[np.where(ends, np.arange(len(ends)), np.arange(1, len(ends) + 1))[keep]]
        unknown = last_kept[keep]
        ends = (ends | np.roll(ends & ~last_kept, -1))[keep]
        observations = observations[keep]
    rows = Rows(observations, table.floats("actions", keep)[0], following, ends, notes=notes, mismatch=mismatch)
    rows.unknown_next = None if keep is None else unknown
    rows.terminals = terminals.astype(np.float32) if keep is None else terminals[keep].astype(np.float32)
    for key in ("qpos", "qvel"):
        if f"infos/{key}" in table:
            setattr(rows, key, table.floats(f"infos/{key}", keep)[0])
    if "infos/extra" in table:
        rows.extra = discrete(table.path, "infos/extra", table.floats("infos/extra", keep)[0])
    if "rewards" in table:
        rows.rewards = table.numbers("rewards", keep)
    if "infos/quality" in table:
        quality = table.column("infos/quality").astype(np.int8)
        rows.quality = quality if keep is None else quality[keep]
    if _KITCHEN.fits(table, rows):
        rows.terminals = np.asarray(rows.rewards == _KITCHEN.rewards[-1], np.float32)
        if rows.unknown_next is not None:
            rows.drop(rows.unknown_next)
        notes.append("no timeouts: demonstrations end at their terminals, and only four complete tasks terminate")
    after_action(table.path, rows)
    return rows


def _jumps(observations: np.ndarray, jump: float) -> np.ndarray:
    """Return bool[N]: the body is somewhere else in the next row.

    ``infos/qpos`` would not do: D4RL stores it after the action.
    """
    jumps = np.zeros(len(observations), bool)
    if observations.ndim == 2:  # else the sizes are reported by the checks
        jumps[:-1] = np.linalg.norm(np.diff(observations[:, :2], axis=0), axis=1) > jump
    return jumps
