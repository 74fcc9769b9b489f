"""The study that a report is about: members of finished runs, grouped by method and by what was varied."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from qdos_brax.config import Config
from qdos_brax.report.published import Published
from qdos_brax.runs.metrics import Row


@dataclasses.dataclass(frozen=True)
class Member:
    """Hold one seed with one setting, trained to its end.

    Attributes:
        run: its run folder.
        task: the task's full name.
        method: the method's name.
        seed: its seed.
        values: by dotted key, everything in the configuration in which two settings may differ.
        success: at the last evaluation, 0 to 1; nan if it was never evaluated.
        score: the share of the task that episodes of the last evaluation did, 0 to 1; nan for a task without parts.
        first_goal: environment steps when the goal was first reached; nan if never.
        frozen: whether it was frozen because its numbers were no longer finite.
        rows: its rows of metrics.csv.
    """

    run: Path
    task: str
    method: str
    seed: int
    values: dict[str, Any]
    success: float
    score: float
    first_goal: float
    frozen: bool
    rows: list[Row]


@dataclasses.dataclass(frozen=True)
class Run:
    """Hold what a run folder says of a finished run.

    Attributes:
        path: the folder.
        config: its configuration.
        provenance: the content of run.json; empty if there is none.
        summary: the content of summary.json.
        members: its members, in the population's order.
    """

    path: Path
    config: Config
    provenance: dict[str, Any]
    summary: dict[str, Any]
    members: list[Member]


@dataclasses.dataclass(frozen=True)
class Setting:
    """Hold a method with one choice of its varied hyperparameters: one row of the tables, one colour of the figures.

    Attributes:
        label: its name, such as "qdos" or "qdos, alpha 0.3".
        method: the method's name.
        values: the values of what was varied, by dotted key.
        members: its members by task, one per seed.
    """

    label: str
    method: str
    values: dict[str, Any]
    members: dict[str, list[Member]]


@dataclasses.dataclass(frozen=True)
class Study:
    """Hold everything that one report is about.

    Attributes:
        runs: the runs.
        tasks: the full names of the tasks, sorted.
        settings: the settings, in the order in which they were given.
        reference: the setting that the others are compared with.
        notes: warnings to a reader who compares the settings, one line each.
        published: what others published for the tasks, if the reader asked for it.
    """

    runs: list[Run]
    tasks: list[str]
    settings: list[Setting]
    reference: Setting
    notes: list[str]
    published: list[Published] = dataclasses.field(default_factory=list)


def headline(study: Study, task: str) -> str:
    """Return the measure by which a task's settings are told apart: "success", or "score" where nobody succeeded."""
    members = [member for setting in study.settings for member in setting.members.get(task, [])]
    return "score" if any(m.score > 0 for m in members) and not any(m.success > 0 for m in members) else "success"


def final_results(members: Iterable[Member], measure: str) -> list[float]:
    """Return the success or score at the last evaluation of the members that were evaluated, 0 to 1."""
    return [result for member in members if not math.isnan(result := getattr(member, measure))]
