"""Numbers that others published for the tasks of a report: in settings of their own, and marked so wherever shown."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from importlib import resources
from typing import NamedTuple


class Published(NamedTuple):
    """Hold one published result; nan and None for what the source does not say.

    Attributes:
        task: as the report names it.
        method: its authors' name for it.
        measure: what they measured: success, or score (the share of the task's parts done).
        result: of it at the end, 0 to 1.
        std: over seeds, of the result.
        before: of it after the offline steps, 0 to 1.
        offline_steps: gradient steps on the data.
        online_steps: environment steps.
        seeds: how many.
        first_goal: environment steps to the first goal, the mean over seeds.
        first_goal_std: its standard deviation.
        source: publication and table.
    """

    task: str
    method: str
    measure: str
    result: float
    std: float
    before: float
    offline_steps: int | None
    online_steps: int | None
    seeds: int | None
    first_goal: float
    first_goal_std: float
    source: str

    @property
    def label(self) -> str:
        """Return the method's name, marked as published."""
        return f"{self.method}, published"


def published_on(tasks: Sequence[str]) -> list[Published]:
    """Return the published results on tasks by their full names, such as antmaze-large-task1.

    A result for an environment without a task's number (a mean over its tasks) is one for each of them.
    """
    text = resources.files(__package__).joinpath("published.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    return [
        _published(row, task) for task in tasks for row in rows if row["task"] in (task, task.rpartition("-task")[0])
    ]


def _published(row: dict[str, str], task: str) -> Published:
    return Published(
        task,
        row["method"],
        row["measure"],
        _number(row["result"]) / 100,
        _number(row["std"]) / 100,
        _number(row["before"]) / 100,
        _count(row["offline_steps"]),
        _count(row["online_steps"]),
        _count(row["seeds"]),
        _number(row["first_goal"]),
        _number(row["first_goal_std"]),
        row["source"],
    )


def _number(cell: str) -> float:
    return float(cell) if cell else math.nan


def _count(cell: str) -> int | None:
    return int(cell) if cell else None
