"""The numbers behind the figures: learning curves and scans with their intervals."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from qdos_brax.config.schema import format_value
from qdos_brax.report.settings import short_key
from qdos_brax.report.statistics import mean_curve
from qdos_brax.report.study import Member, Setting, Study, headline


@dataclasses.dataclass(frozen=True)
class Curve:
    """Hold one measure of one setting's members over the environment steps.

    Attributes:
        setting: the setting.
        offline: whether the method only learned offline, so that there is one level instead of a curve.
        steps: float[points].
        mean: float[points], over the members.
        low: float[points], the lower end of the mean's 95 % interval; nan for a single member.
        high: its upper end.
        members: each member with its own float[2, points]: steps and values.
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
    """Hold final success over the values of one hyperparameter that was varied.

    Attributes:
        task: the task's full name.
        measure: "success", or "score" where nobody succeeded.
        key: the dotted key of the hyperparameter.
        lines: one for each choice of method and of everything else that was varied. Where no two settings differ in
            this key alone (values drawn at random, or in pairs), one for each method, not joined.
    """

    task: str
    measure: str
    key: str
    lines: list[ScanLine]

    @property
    def log_scale(self) -> bool:
        """Return whether the values are positive numbers over a decade or more, which need a logarithmic axis."""
        values = [value for line in self.lines for value in line.values]
        return all(map(_is_number, values)) and min(values) > 0 and max(values) >= 10 * min(values)


@dataclasses.dataclass(frozen=True)
class ScanLine:
    """Hold one line of a scan.

    Attributes:
        label: the method, and what else was varied.
        values: the values of the key, in rising order if they are numbers.
        mean: float[values], of the scan's measure.
        low: the lower end of the mean's 95 % interval; nan for a single member.
        high: its upper end.
        members: the evaluated members at each value.
        joined: whether all else is equal along it, so that its points are joined.
    """

    label: str
    values: list[Any]
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    members: list[list[Member]]
    joined: bool


@dataclasses.dataclass(frozen=True)
class Surface:
    """Hold final success over two hyperparameters that were varied in all combinations, mean over all else.

    Attributes:
        task: the task's full name.
        measure: as of a scan.
        method: the method's name.
        keys: the dotted keys of the hyperparameters along x and along y.
        x: the values of the first, in rising order.
        y: the values of the second, in rising order.
        mean: float[y, x]; nan where nothing was evaluated.
    """

    task: str
    measure: str
    method: str
    keys: tuple[str, str]
    x: list[float]
    y: list[float]
    mean: np.ndarray


def curves(study: Study, task: str, column: str) -> list[Curve]:
    """Return the curves of a column of metrics.csv, one per setting that was measured on the task.

    A member that was measured at other steps than the others is interpolated. Before its first and after its last
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
    """Return float[2, points], a member's environment steps and values; the last value of each step counts."""
    found = {float(row["env_steps"] or 0): float(row[column]) for row in member.rows if row.get(column)}
    kept = [(step, value) for step, value in found.items() if not math.isnan(value)]
    return np.asarray(sorted(kept)).T if kept else np.empty((2, 0))


def mean_over_steps(member: Member) -> float:
    """Return the area under a member's curve of success over the steps from its first evaluation to its last.

    Divided by those steps, so that it is a share, 0 to 1; nan of a member that has no two evaluations online.
    """
    steps, success = points(member, "eval/success")
    return float(np.trapezoid(success, steps) / (steps[-1] - steps[0])) if len(steps) > 1 else math.nan


def scans(study: Study) -> list[Scan]:
    """Return each key of which a method has several values on a task, with the success under each value."""
    found = []
    for task in study.tasks:
        measure = headline(study, task)
        present = [setting for setting in study.settings if task in setting.members]
        for key in dict.fromkeys(key for setting in present for key in setting.values):
            groups: dict[str, list[Setting]] = {}
            for setting in present:
                if key in setting.values:
                    rest = [f"{short_key(k)} {format_value(v)}" for k, v in setting.values.items() if k != key]
                    groups.setdefault(", ".join([setting.method, *rest]), []).append(setting)
            lines = [
                _scan_line(label, group, task, measure, key, True) for label, group in groups.items() if len(group) > 1
            ]
            if not lines:
                drawn: dict[str, list[Setting]] = {}
                for setting in present:
                    if key in setting.values:
                        drawn.setdefault(setting.method, []).append(setting)
                lines = [_scan_line(method, group, task, measure, key, False) for method, group in drawn.items()]
            if any(len(line.values) > 1 for line in lines):
                found.append(Scan(task, measure, key, lines))
    return found


def surfaces(study: Study) -> list[Surface]:
    """Return each pair of keys with numeric values of which a method has all combinations on a task."""
    found = []
    for task in study.tasks:
        measure = headline(study, task)
        for method in dict.fromkeys(setting.method for setting in study.settings):
            settings = [s for s in study.settings if s.method == method and task in s.members]
            keys = [
                k for k in (settings[0].values if settings else ()) if all(_is_number(s.values[k]) for s in settings)
            ]
            for first, second in itertools.combinations(keys, 2):
                x, y = (sorted({s.values[key] for s in settings}) for key in (first, second))
                cells: dict[tuple[Any, Any], list[float]] = {}
                for setting in settings:
                    own = cells.setdefault((setting.values[first], setting.values[second]), [])
                    own += [getattr(m, measure) for m in setting.members[task] if not math.isnan(getattr(m, measure))]
                if min(len(x), len(y)) > 1 and len(cells) == len(x) * len(y):
                    mean = [[float(np.mean(cells[a, b])) if cells[a, b] else math.nan for a in x] for b in y]
                    found.append(Surface(task, measure, method, (first, second), x, y, np.asarray(mean)))
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _scan_line(label: str, settings: Sequence[Setting], task: str, measure: str, key: str, joined: bool) -> ScanLine:
    if all(_is_number(setting.values[key]) for setting in settings):
        settings = sorted(settings, key=lambda setting: setting.values[key])
    members = [[m for m in setting.members[task] if not math.isnan(getattr(m, measure))] for setting in settings]
    settings = [setting for setting, group in zip(settings, members, strict=True) if group]
    members = [group for group in members if group]
    ends = [[float(x[0]) for x in mean_curve(np.asarray([[getattr(m, measure)] for m in group]))] for group in members]
    mean, low, high = np.asarray(ends).reshape(-1, 3).T
    return ScanLine(label, [setting.values[key] for setting in settings], mean, low, high, members, joined)
