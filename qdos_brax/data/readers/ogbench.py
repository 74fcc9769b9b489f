"""Read OGBench's ``.npz``: the files as published, and both layouts of OGBench's own loader if someone saved them."""

from __future__ import annotations

import numpy as np

from qdos_brax.data.readers.rows import Rows, breaks_of, discrete, mismatch_of, note_breaks
from qdos_brax.data.readers.table import DataTable
from qdos_brax.errors import UserError

_OPTIONAL = ("next_observations", "valids", "rewards", "masks", "qpos", "qvel", "button_states")


def load(table: DataTable) -> Rows:
    """Return the transitions of an OGBench ``.npz``.

    Published files have T + 1 rows per trajectory; the last is only a next state. ``load_dataset`` makes of them the
    regular layout (``next_observations``, T rows) or the compact one (``valids``, T + 1 rows, both of the last two
    marked in ``terminals``). The names of the arrays show which one it is.

    Raises:
        UserError: unreadable, incomplete, or sizes that do not fit.
    """
    num_rows = table.require(("observations", "actions", "terminals"), _OPTIONAL)
    marked = table.column("terminals") != 0
    notes: list[str] = []
    mismatch = ""
    if num_rows and not marked[-1]:
        notes.append("the last trajectory is cut off before its end")
    if "next_observations" in table:
        keep = None
        (observations,), (following,) = table.floats("observations", None), table.floats("next_observations", None)
        # Others than OGBench may mark terminals alone, as D4RL's ``qlearning_dataset`` does.
        breaks = breaks_of(observations, following)
        ends, mismatch = marked | breaks, mismatch_of(observations, following, breaks)
        if num_rows and not mismatch:
            note_breaks(notes, marked, breaks)
    else:
        keep = table.column("valids") != 0 if "valids" in table else ~marked
        if num_rows:
            keep[-1] = False  # a file cut inside a trajectory: its last row has no next state either
        is_next = np.roll(keep, 1)
        ends = ~np.roll(keep, -1)[keep]
        if "valids" in table and not np.array_equal(ends, marked[keep]) and not notes:
            raise UserError(f"{table.path}: 'valids' and 'terminals' mark different trajectories: the file is damaged")
        observations, following = table.floats("observations", keep, is_next)
    if len(ends):
        ends[-1] = True
    rows = Rows(observations, table.floats("actions", keep)[0], following, ends, notes=notes, mismatch=mismatch)
    for key in ("qpos", "qvel"):
        if key in table:
            setattr(rows, key, table.floats(key, keep)[0])
    if "button_states" in table:  # the scene's discrete state; other buttons are no task here
        rows.extra = discrete(table.path, "button_states", table.floats("button_states", keep)[0])
    if "rewards" in table:
        rows.rewards = table.numbers("rewards", keep)
    if "masks" in table:
        rows.terminals = 1.0 - table.numbers("masks", keep)
    return rows
