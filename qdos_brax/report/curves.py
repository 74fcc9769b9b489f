"""Learning curves and scans, as PNG files."""

from __future__ import annotations

import itertools
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed to write a file
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qdos_brax.config.schema import format_value
from qdos_brax.files import replacing
from qdos_brax.report.elements import PALETTE
from qdos_brax.report.series import Curve, Scan, ScanLine, curves, scans
from qdos_brax.report.settings import short_key
from qdos_brax.report.study import Study

GREYS = ("#4d4d4d", "#7a7a7a", "#a5a5a5")  # of what others published
SHARES = ("success", "score")  # measures between 0 and 1
TICKS = 8  # the most values of a scan that all get a label on its axis
MEASURES = (("eval/success", "success"), ("eval/score", "score"), ("eval/return", "return"))
WORDS = {"score": "score (share of the task's parts done)"}
"""What an axis says of a measure, where its name alone does not say what it is."""


def draw_curves(study: Study, out: Path) -> None:
    """Draw success, return and, where a task has one, the score over the environment steps, a row of panels per task.

    A thick line is the mean of a setting's members, the band its 95 % bootstrap interval, a thin line a member. A
    dashed horizontal line is a method that only learned offline, a dotted one what others published at the end of their
    runs.

    Args:
        study: what was run.
        out: the file; its folder must exist.

    Raises:
        UserError: the file cannot be written.
    """
    tasks = len(study.tasks)
    scored = any(curves(study, task, "eval/score") for task in study.tasks)
    measures = [(column, name) for column, name in MEASURES if name != "score" or scored]
    figure, axes = plt.subplots(
        tasks, len(measures), figsize=(5.5 * len(measures), 4 * tasks), layout="constrained", squeeze=False
    )
    colours = setting_colours(study)
    for row, task in zip(axes, study.tasks, strict=True):
        for axis, (column, name) in zip(row, measures, strict=True):
            for curve in curves(study, task, column):
                _draw_curve(axis, curve, colours[curve.setting.label])
            _draw_published(axis, study, task, name)
            axis.set_xlabel("environment steps")
            axis.set_ylabel(WORDS.get(name, name))
            axis.set_title(task)
            axis.grid(alpha=0.3)
            if not axis.lines:
                axis.text(0.5, 0.5, f"no {column} measured", ha="center", va="center", transform=axis.transAxes)
            if name in SHARES:
                axis.set_ylim(-0.02, 1.02)
                if axis.lines:
                    axis.legend(fontsize="small")
    save_figure(figure, out)


def draw_scans(study: Study, out: Path) -> bool:
    """Draw final success over each hyperparameter that was varied; return False, without a file, if none was."""
    found = scans(study)
    if not found:
        return False
    figure, axes = plt.subplots(1, len(found), figsize=(5.5 * len(found), 4), layout="constrained", squeeze=False)
    for axis, scan in zip(axes[0], found, strict=True):
        _draw_scan(axis, scan)
    save_figure(figure, out)
    return True


def setting_colours(study: Study) -> dict[str, str]:
    """Return one colour per setting, by label; it is the same in every figure of a report."""
    return {setting.label: PALETTE[i % len(PALETTE)] for i, setting in enumerate(study.settings)}


def axis_positions(line: ScanLine, scan: Scan) -> tuple[list[float], list[str] | None]:
    """Return the places of a line's values on the axis, and the labels of the places if the values are words."""
    every = [value for other in scan.lines for value in other.values]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in every):
        return [float(value) for value in line.values], None
    names = list(dict.fromkeys(map(format_value, every)))
    return [float(names.index(format_value(value))) for value in line.values], names


def _draw_curve(axis: Axes, curve: Curve, colour: str) -> None:
    label = f"{curve.setting.label} ({len(curve.members)})"
    if curve.offline:
        axis.axhline(curve.mean[-1], color=colour, linestyle="--", label=f"{label}, offline")
        axis.axhspan(curve.low[-1], curve.high[-1], color=colour, alpha=0.1, linewidth=0)
        return
    axis.plot(curve.steps, curve.mean, linewidth=2, marker="o", markersize=3, color=colour, label=label)
    if len(curve.members) > 1:
        axis.fill_between(curve.steps, curve.low, curve.high, color=colour, alpha=0.2, linewidth=0)
        for _, xy in curve.members:
            axis.plot(*xy, color=colour, linewidth=0.7, alpha=0.4)
    for member, xy in curve.members:
        if member.frozen:
            axis.plot(*xy[:, -1], "x", color=colour, markersize=9)


def _draw_published(axis: Axes, study: Study, task: str, measure: str) -> None:
    rows = [row for row in study.published if (row.task, row.measure) == (task, measure)]
    for row, grey in zip(rows, itertools.cycle(GREYS), strict=False):
        axis.axhline(row.result, color=grey, linestyle=":", linewidth=1, label=row.label)


def _draw_scan(axis: Axes, scan: Scan) -> None:
    for line, colour in zip(scan.lines, itertools.cycle(PALETTE), strict=False):
        x, _ = axis_positions(line, scan)
        errors = np.nan_to_num(np.stack([line.mean - line.low, line.high - line.mean]))
        label = f"{line.label} (mean, 95 %)"
        if line.joined:
            axis.errorbar(x, line.mean, errors, color=colour, marker="o", capsize=3, linewidth=2, label=label)
        else:
            axis.plot([], [], "o", color=colour, label=line.label)
        for at, members in zip(x, line.members, strict=True):
            axis.plot([at] * len(members), [getattr(m, scan.measure) for m in members], ".", color=colour, alpha=0.5)
    ticks = sorted({at for line in scan.lines for at in axis_positions(line, scan)[0]})
    if scan.log_scale:
        axis.set_xscale("log")
    if len(ticks) <= TICKS:
        axis.set_xticks(ticks, axis_positions(scan.lines[0], scan)[1] or [format_value(tick) for tick in ticks])
        axis.set_xticks([], minor=True)
    label = f"{scan.measure} at the last evaluation"
    axis.set(xlabel=short_key(scan.key), ylabel=label, title=scan.task, ylim=(-0.02, 1.02))
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")


def save_figure(figure: Figure, out: Path) -> None:
    """Write a figure to a file, as a whole or not at all, and free its memory."""
    try:
        if engine := figure.get_layout_engine():
            engine.execute(figure)  # once, where savefig lays it out twice, and draws it for each
            figure.set_layout_engine(None)
        with replacing(out) as partial:
            figure.savefig(partial, dpi=120)
    finally:
        plt.close(figure)
