"""The members of a run at a glance, for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from qdos_brax.config.schema import format_value
from qdos_brax.runs.metrics import Row, measured

_SHOWN = {"success": "eval/success", "score": "eval/score", "return": "eval/return", "first goal": "first_goal_step"}


class MemberBoard:
    """Show a table of the members' latest numbers, built again whenever rich draws it.

    Args:
        members: the population; keys with one value for all are not shown, except for the seed.
    """

    def __init__(self, members: Sequence[Mapping[str, Any]]) -> None:
        self._members = members
        self._names = [key for key in members[0] if key == "seed" or len({str(m[key]) for m in members}) > 1]
        self._latest: list[dict[str, float]] = [{} for _ in members]
        self._loss = ["" for _ in members]

    def begin(self, rows: Sequence[Row]) -> None:
        """Add the rows so far."""
        self.append(rows)

    def append(self, rows: Sequence[Row]) -> None:
        """Add new rows."""
        for row in rows:
            index, numbers = int(row["member"]), measured(row, self._members)
            self._latest[index] |= numbers
            losses = [name for name in numbers if name.endswith("loss")]
            if losses:
                self._loss[index] = f"{numbers[losses[0]]:.4g} ({losses[0].removesuffix('_loss').replace('_', ' ')})"

    def end(self) -> None:
        """Do nothing: there is nothing to close."""

    def __rich__(self) -> Table:
        """Return the current table."""
        table = Table(box=None, pad_edge=False, header_style="bold")
        shown = {name: column for name, column in _SHOWN.items() if name != "score" or column in self._latest[0]}
        for name in (*self._names, *shown, "loss", ""):
            table.add_column(name.rpartition(".")[2].replace("_", " "), justify="right", no_wrap=True)
        for member, latest, loss in zip(self._members, self._latest, self._loss, strict=True):
            cells = [format_value(member[name]) for name in self._names]
            cells += [f"{latest[column]:,.4g}" if column in latest else "" for column in shown.values()]
            frozen = latest.get("status_ok") == 0
            table.add_row(*cells, loss, "frozen" if frozen else "", style="red" if frozen else "")
        return table
