"""metrics.csv: one row per member and log point, and the summary that follows from it."""

from __future__ import annotations

import contextlib
import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from qdos_brax.errors import UserError
from qdos_brax.files import user_errors, write_text

Row = dict[str, str]
_FIRST = ("phase", "env_steps", "update", "eval/success", "eval/return")
_LAST = "sps"

PART_DONE = "eval/done/"
"""With the name of a part of the task: the column of the share of evaluation episodes that end with it done."""


class Observer(Protocol):
    """Receive every row that is written to metrics.csv."""

    def begin(self, rows: Sequence[Row]) -> None:
        """Start with the rows of the run so far; forget rows that an earlier process sent."""
        ...

    def append(self, rows: Sequence[Row]) -> None:
        """Take a log point: one new row per member, with a cell for each column that it has."""
        ...

    def end(self) -> None:
        """Finish, because the run ends or stops."""
        ...


class MetricsTable:
    """Hold the rows so far, in memory and on disk.

    A column may appear late: the file is then replaced by one with the new header, and earlier rows have an empty cell
    there. A missing number is an empty cell, never 0.

    Args:
        path: the CSV file.
        members: the population in order: what varies between the members ("seed", "alpha", ...).
    """

    def __init__(self, path: Path, members: Sequence[Mapping[str, Any]]) -> None:
        self._path = path
        self._members = [{"member": str(i), **{k: _cell(v) for k, v in m.items()}} for i, m in enumerate(members)]
        self.columns: list[str] = [*self._members[0], *_FIRST, _LAST]
        self.rows: list[Row] = []
        self._latest: list[dict[str, float]] = [{} for _ in members]
        self._observers: Sequence[Observer] = ()

    @contextlib.contextmanager
    def observed(self, observers: Sequence[Observer]) -> Iterator[None]:
        """Send the rows so far and all new ones to the observers."""
        self._observers = observers
        try:
            for observer in observers:
                observer.begin(self.rows)
            yield
        finally:
            self._observers = ()
            for observer in observers:
                observer.end()

    def start(self) -> None:
        """Write the header of a new table."""
        self._rewrite()

    def cut_back(self, rows: int, columns: Sequence[str]) -> None:
        """Read the file and keep its first ``rows``, with the ``columns`` that they had.

        Raises:
            UserError: the file holds fewer rows than that, or none of those columns.
        """
        table = read_rows(self._path)
        if len(table) < rows or (table and not set(columns) <= set(table[0])):
            raise UserError(f"{self._path} has lost rows that the checkpoint counts ({len(table)} of {rows})")
        self.columns = list(columns)
        self.rows, self._latest = [], [{} for _ in self._members]
        try:
            self._add([{name: row[name] for name in columns} for row in table[:rows]])
        except (ValueError, IndexError) as error:
            raise UserError(f"{self._path} is damaged ({error})") from error
        self._rewrite()

    def append(self, phase: str, metrics: Mapping[str, Any], sps: float) -> None:
        """Add one row per member.

        Args:
            phase: the phase's name.
            metrics: by column; each a scalar or one number per member.
            sps: steps per second of one member.
        """
        count = len(self._members)
        values = {name: np.broadcast_to(np.asarray(value), (count,)) for name, value in metrics.items()}
        new = [name for name in values if name not in self.columns]
        rows = []
        for i, member in enumerate(self._members):
            cells = {name: _cell(column[i]) for name, column in values.items()}
            rows.append({**member, "phase": phase, **cells, _LAST: f"{sps:.1f}"})
        self._add(rows)
        if new:
            self.columns[-1:] = [*new, _LAST]
            self._rewrite()
        else:
            with user_errors(self._path), self._path.open("a", encoding="utf-8", newline="") as file:
                file.write(_text(self.columns, rows))
        for observer in self._observers:
            observer.append(rows)

    def latest(self, column: str) -> list[float]:
        """Return the last number of the column for each member; nan where there is none yet."""
        return [latest.get(column, math.nan) for latest in self._latest]

    def summary(self) -> list[dict[str, Any]]:
        """Return one entry per member, as in summary.json; what was never measured is None."""
        return [self._member_summary(i) for i in range(len(self._members))]

    def _member_summary(self, index: int) -> dict[str, Any]:
        latest = self._latest[index]
        cells = [row.get("eval/success") for row in self.rows if row["member"] == str(index)]
        successes = [float(cell) for cell in cells if cell and cell != "nan"]
        return {
            **{key: _plain(text) for key, text in self._members[index].items() if key != "member"},
            "env_steps": int(latest.get("env_steps", 0)),
            "eval_success": _or_none(latest, "eval/success"),
            **({"eval_score": latest["eval/score"]} if "eval/score" in latest else {}),
            "eval_return": _or_none(latest, "eval/return"),
            "eval_episodes": _whole_or_none(latest, "eval/episodes"),
            "best_success": max(successes, default=None),
            "first_goal_step": _whole_or_none(latest, "first_goal_step"),
            "status": "nan" if latest.get("status_ok") == 0 else "ok",
        }

    def _add(self, rows: Sequence[Row]) -> None:
        names = {*self._members[0], "phase"}
        for row in rows:
            numbers = {name: float(cell) for name, cell in row.items() if cell and name not in names}
            self._latest[int(row["member"])] |= numbers
        self.rows += rows

    def _rewrite(self) -> None:
        write_rows(self._path, self.columns, self.rows)


def write_rows(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> None:
    """Replace the file by a whole table at once."""
    write_text(path, ",".join(columns) + "\n" + _text(columns, rows))


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a metrics file, without a last line that a kill left incomplete.

    Raises:
        UserError: the file is missing or is not a metrics file.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read {path}: {error}") from error
    complete = text[: text.rfind("\n") + 1]
    reader = csv.DictReader(io.StringIO(complete))
    if "member" not in (reader.fieldnames or ()):
        raise UserError(f"{path} is not a metrics file: it has no column 'member'")
    return list(reader)


def measured(row: Row, members: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the measurements of a row by column: without nan, the member's keys and the step.

    Args:
        row: a row of metrics.csv.
        members: the population; its keys are no measurements.
    """
    names = {"member", *members[0], "phase", "env_steps", "update"}
    numbers = {name: float(cell) for name, cell in row.items() if cell and name not in names}
    return {name: number for name, number in numbers.items() if not math.isnan(number)}


def step_of(row: Row) -> int:
    """Return a row's position on the axis of its phase: environment steps once there are any, else updates."""
    return int(float(row.get("env_steps") or 0)) or int(float(row.get("update") or 0))


def _text(columns: Sequence[str], rows: Sequence[Row]) -> str:
    text = io.StringIO()
    csv.DictWriter(text, columns, restval="", lineterminator="\n").writerows(rows)
    return text.getvalue()


def _cell(value: Any) -> str:
    """Return a number as text: whole numbers exactly, others with the nine digits that identify a float32.

    A text (a member's "auto") stays as it is.
    """
    if isinstance(value, str):
        return value
    number = np.asarray(value).item()
    return str(int(number)) if isinstance(number, int | bool) else f"{number:.9g}"


def _plain(text: str) -> float | int | str:
    """Return a member's cell as it was."""
    if text.lstrip("-").isdigit():
        return int(text)
    try:
        return float(text)
    except ValueError:
        return text


def _or_none(numbers: Mapping[str, float], name: str) -> float | None:
    number = numbers.get(name, math.nan)
    return None if math.isnan(number) else number


def _whole_or_none(numbers: Mapping[str, float], name: str) -> int | None:
    number = _or_none(numbers, name)
    return None if number is None else int(number)
