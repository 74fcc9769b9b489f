"""The paper's tables for the runs of a study: final success, and environment steps to the first goal."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Sequence

from qdos_brax.report.series import mean_over_steps
from qdos_brax.report.statistics import Estimate, interquartile_mean, mean_std, probability_of_improvement
from qdos_brax.report.study import Member, Setting, Study, final_results
from qdos_brax.runs.metrics import PART_DONE

_ALL = "all tasks"
_NONE = "-"
_CsvRow = dict[str, str | float]


@dataclasses.dataclass(frozen=True)
class Table:
    """Hold cells of text under a heading.

    Attributes:
        title: what the table shows.
        header: names of the columns; the first column holds the rows' names.
        rows: the cells.
        note: how to read it.
        words: how many columns, from the left, hold words rather than numbers.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    note: str = ""
    words: int = 1

    def text(self) -> str:
        """Return the table for a terminal."""
        widths = [max(map(len, column)) for column in zip(self.header, *self.rows, strict=True)]
        lines = [
            "  ".join(
                cell.ljust(width) if i < self.words else cell.rjust(width)
                for i, (cell, width) in enumerate(zip(row, widths, strict=True))
            )
            for row in (self.header, *self.rows)
        ]
        return "\n".join(line.rstrip() for line in (self.title, *lines, self.note) if line)

    def markdown(self) -> str:
        """Return the table in Markdown."""
        rule = ["---"] * self.words + ["---:"] * (len(self.header) - self.words)
        cells = [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in (self.header, rule, *self.rows)]
        return "\n\n".join(part for part in (f"**{self.title}**", "\n".join(cells), self.note) if part)


def tables(study: Study) -> list[Table]:
    """Return table 1, of success and, where tasks have parts, of the score, its statistics over seeds, table 2, the
    parts, and what others published if that is shown.
    """
    title = "Table 1. Success at the last evaluation (%), mean ± std"
    shown = [_result_table(study, "success", title)]
    if any(final_results(_members(study, setting, _ALL), "score") for setting in study.settings):
        title = "Table 1, score: the share of the task's parts that episodes of the last evaluation did (%), mean ± std"
        shown.append(_result_table(study, "score", title))
    others = [_published_table(study)] if study.published else []
    return [*shown, _statistics_table(study), _first_goal_table(study), *_parts_tables(study), *others]


def success_csv(study: Study) -> str:
    """Return table 1 as CSV: one row per setting and task, and one over all tasks if there are several.

    Success and its statistics, the score and the area under the curve of success (``mean_over_steps``) are shares, 0 to
    1; a cell is empty where there are too few seeds, and of tasks without parts and methods without curves.
    """
    rows: list[_CsvRow] = []
    for setting, task, scores, improvement in _statistics(study):
        mean, std = mean_std([score for group in scores for score in group])
        members = _members(study, setting, task)
        rows.append(
            {
                "task": task,
                "method": setting.label,
                "seeds": sum(map(len, scores)),
                "mean": mean,
                "std": std,
                **dict(zip(("score", "score_std"), mean_std(final_results(members, "score")), strict=True)),
                **dict(zip(("area", "area_std"), mean_std(_areas(members)), strict=True)),
                **_named("iqm", interquartile_mean(scores)),
                "reference": study.reference.label,
                **_named("improvement", improvement or Estimate(math.nan, math.nan, math.nan)),
            }
        )
    return _csv(rows)


def first_goal_csv(study: Study) -> str:
    """Return table 2 as CSV, a row per setting and task: environment steps of the seeds that reached the goal."""
    rows: list[_CsvRow] = []
    for setting in study.settings:
        for task in study.tasks:
            steps, seeds = _first_goals(setting.members.get(task, []))
            if seeds:
                mean, std = mean_std(steps)
                reached = len(steps)
                row: _CsvRow = {"task": task, "method": setting.label, "seeds": seeds, "reached": reached}
                rows.append({**row, "mean": mean, "std": std})
    return _csv(rows)


def _result_table(study: Study, measure: str, title: str) -> Table:
    rows = [
        [
            setting.label,
            *(_percent(*mean_std(final_results(setting.members.get(task, []), measure))) for task in study.tasks),
        ]
        for setting in study.settings
    ]
    note = "standard deviation over seeds, with n - 1; not defined for one seed"
    return Table(title, ["method", *study.tasks], rows, note)


def _statistics_table(study: Study) -> Table:
    several = len(study.settings) > 1
    rows = []
    for setting, task, scores, improvement in _statistics(study):
        area = _percent(*mean_std(_areas(_members(study, setting, task))))
        iqm = _interval(interquartile_mean(scores), 100, "{:.0f}")
        row = [setting.label, task, str(sum(map(len, scores))), iqm, area]
        rows.append([*row, _interval(improvement, 1, "{:.2f}")] if several else row)
    header = ["method", "task", "seeds", "IQM (%) [95 %]", "area (%)"]
    if several:
        header.append(f"P(better than {study.reference.label}) [95 %]")
    note = (
        "IQM: interquartile mean (of fewer than four scores: the mean); [95 %]: bootstrap over seeds within a task; "
        "area: under the curve of success, from the first evaluation to the last, mean ± std"
    )
    return Table("Table 1, continued. Statistics over seeds", header, rows, note, words=2)


def _first_goal_table(study: Study) -> Table:
    def cell(setting: Setting, task: str) -> str:
        steps, seeds = _first_goals(setting.members.get(task, []))
        mean, std = mean_std(steps)
        if not seeds:
            return _NONE
        words = _NONE if math.isnan(mean) else f"{mean:,.0f}" + ("" if math.isnan(std) else f" ± {std:,.0f}")
        return f"{words} ({len(steps)}/{seeds})"

    rows = [[setting.label, *(cell(setting, task) for task in study.tasks)] for setting in study.settings]
    note = "mean over the seeds that reached the goal; in brackets: how many did, of how many"
    return Table("Table 2. Environment steps to the first goal, mean ± std", ["method", *study.tasks], rows, note)


def _parts_tables(study: Study) -> list[Table]:
    """Return a table per task that has parts, a row per member: which of them its last evaluation ended with."""
    found = []
    for task in study.tasks:
        of_task = [
            (setting.label, member, _last_parts(member))
            for setting in study.settings
            for member in setting.members.get(task, [])
        ]
        names = list(dict.fromkeys(name for _, _, done in of_task for name in done))
        rows = [
            [label, str(member.seed), *(f"{100 * done[name]:.0f}" if name in done else _NONE for name in names)]
            for label, member, done in of_task
        ]
        if names:
            title = f"Parts of {task} that are done when an episode of the last evaluation ends (%)"
            found.append(Table(title, ["method", "seed", *names], rows))
    return found


def _last_parts(member: Member) -> dict[str, float]:
    """Return the share of episodes by part at the member's last evaluation; {} for a task without parts."""
    for row in reversed(member.rows):
        done = {
            key.removeprefix(PART_DONE): float(cell) for key, cell in row.items() if key.startswith(PART_DONE) and cell
        }
        if done:
            return done
    return {}


def _published_table(study: Study) -> Table:
    def count(value: int | None) -> str:
        return _NONE if value is None else f"{value:,}"

    rows = [
        [
            row.label,
            row.task,
            row.source,
            row.measure,
            _percent(row.before, math.nan),
            _percent(row.result, row.std),
            count(row.offline_steps),
            count(row.online_steps),
            count(row.seeds),
            _NONE if math.isnan(row.first_goal) else f"{row.first_goal:,.0f} ± {row.first_goal_std:,.0f}",
        ]
        for row in study.published
    ]
    counts = ["offline steps", "online steps", "seeds", "first goal"]
    header = ["method", "task", "source", "measure", "offline (%)", "end (%)", *counts]
    note = "settings of others: their data, networks, steps and seeds; -: not said, or not measured"
    return Table("Published by others, in settings of their own", header, rows, note, words=4)


def _statistics(study: Study) -> list[tuple[Setting, str, list[list[float]], Estimate | None]]:
    """Return (setting, task or all tasks, scores by task, probability to beat the reference) of all evaluated."""
    found = []
    for setting in study.settings:
        for task in (*study.tasks, *([_ALL] if len(study.tasks) > 1 else [])):
            tasks = _tasks(study, task)
            scores = [final_results(setting.members.get(name, []), "success") for name in tasks]
            if not all(scores):
                continue
            reference = [final_results(study.reference.members.get(name, []), "success") for name in tasks]
            compared = setting is not study.reference and all(reference)
            found.append((setting, task, scores, probability_of_improvement(scores, reference) if compared else None))
    return found


def _tasks(study: Study, name: str) -> list[str]:
    """Return the tasks that a row of the statistics is about."""
    return study.tasks if name == _ALL else [name]


def _members(study: Study, setting: Setting, name: str) -> list[Member]:
    return [member for task in _tasks(study, name) for member in setting.members.get(task, [])]


def _areas(members: Sequence[Member]) -> list[float]:
    return [area for member in members if not math.isnan(area := mean_over_steps(member))]


def _first_goals(members: Sequence[Member]) -> tuple[list[float], int]:
    return [member.first_goal for member in members if not math.isnan(member.first_goal)], len(members)


def _percent(mean: float, std: float) -> str:
    if math.isnan(mean):
        return _NONE
    return f"{100 * mean:.0f}" + ("" if math.isnan(std) else f" ± {100 * std:.0f}")


def _interval(estimate: Estimate | None, scale: float, form: str) -> str:
    if estimate is None:
        return _NONE
    value, low, high = (form.format(scale * number) for number in estimate)
    return value if math.isnan(estimate.low) else f"{value} [{low}, {high}]"


def _named(name: str, estimate: Estimate) -> dict[str, float]:
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}


def _csv(rows: Sequence[_CsvRow]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: _cell(value) for name, value in row.items()})
    return text.getvalue()


def _cell(value: str | float) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return str(value)
