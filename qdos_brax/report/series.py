"""The numbers behind the figures: learning curves and scans with their intervals. How they are drawn is elsewhere."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from qdos_brax.report.statistics import mean_curve
from qdos_brax.report.study import Member, Setting, Study, plain, short


@dataclasses.dataclass(frozen=True)
class Curve:
    """One measure of one setting's members over the environment steps.

    Attributes:
        setting: whose it is.
        offline: nothing was played online: evaluated after training, a level rather than a curve.
        steps: float[points].
        mean: float[points], over the members.
        low: float[points], the lower end of the mean's 95 % interval; nan for a single member.
        high: its upper end.
        members: each with its own float[2, points]: steps and values.
    """

    setting: Setting
    offline: bool
    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    members: list[tuple[Member, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Scan:
    """Final success over the values of one thing that was varied.

    Attributes:
        task: on which task.
        key: what was varied, dotted.
        lines: one for each choice of method and of everything else that was varied.
    """

    task: str
    key: str
    lines: list[ScanLine]


@dataclasses.dataclass(frozen=True)
class ScanLine:
    """One line of a scan.

    Attributes:
        label: the method, and what else was varied.
        values: the values of the key, rising if they are numbers; they are evenly spaced where they are words.
        mean: float[values], success.
        low: the lower end of the mean's 95 % interval; nan for a single member.
        high: its upper end.
        members: the members at each value.
    """

    label: str
    values: list[Any]
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    members: list[list[Member]]


def curves(study: Study, task: str, column: str) -> list[Curve]:
    """The curves of a column of metrics.csv, one per setting that was measured on the task.

    A member that was measured at other steps than the rest is interpolated; before its first and after its last
    measurement it keeps that value.
    """
    found = []
    for setting in study.settings:
        own = [(member, points(member, column)) for member in setting.members.get(task, [])]
        own = [(member, xy) for member, xy in own if xy.size]
        if own:
            steps = np.unique(np.concatenate([xy[0] for _, xy in own]))
            values = np.stack([np.interp(steps, *xy) for _, xy in own])
            found.append(Curve(setting, bool(steps[-1] == 0), steps, *mean_curve(values), own))
    return found


def points(member: Member, column: str) -> np.ndarray:
    """float[2, points]: environment steps and values; empty if nothing was measured. Offline, the last one counts."""
    found = {float(row["env_steps"] or 0): float(row[column]) for row in member.rows if row.get(column)}
    kept = [(step, value) for step, value in found.items() if not math.isnan(value)]
    return np.asarray(sorted(kept)).T if kept else np.empty((2, 0))


def scans(study: Study) -> list[Scan]:
    """Every key of which a method has several values on a task, with the success that each value led to."""
    found = []
    for task in study.tasks:
        present = [setting for setting in study.settings if task in setting.members]
        for key in dict.fromkeys(key for setting in present for key in setting.values):
            groups: dict[str, list[Setting]] = {}
            for setting in present:
                if key in setting.values:
                    rest = [f"{short(k)} {plain(v)}" for k, v in setting.values.items() if k != key]
                    groups.setdefault(", ".join([setting.method, *rest]), []).append(setting)
            lines = [_scan_line(label, group, task, key) for label, group in groups.items() if len(group) > 1]
            if lines:
                found.append(Scan(task, key, lines))
    return found


def _scan_line(label: str, settings: Sequence[Setting], task: str, key: str) -> ScanLine:
    if all(isinstance(setting.values[key], int | float) for setting in settings):
        settings = sorted(settings, key=lambda setting: setting.values[key])
    members = [[m for m in setting.members[task] if not math.isnan(m.success)] for setting in settings]
    settings = [setting for setting, group in zip(settings, members, strict=True) if group]
    members = [group for group in members if group]
    ends = [[float(x[0]) for x in mean_curve(np.asarray([[m.success] for m in group]))] for group in members]
    mean, low, high = np.asarray(ends).reshape(-1, 3).T
    return ScanLine(label, [setting.values[key] for setting in settings], mean, low, high, members)
