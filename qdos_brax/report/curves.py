"""Learning curves of one run or of several, as a PNG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed to write a file
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from qdos_brax.config import from_yaml
from qdos_brax.runs.folder import RunFolder, user_errors
from qdos_brax.runs.metrics import Row, read_rows

_PANELS = (("eval/success", "success"), ("eval/return", "return"))
_NOT_SCANNED = {"member", "seed", "phase"}


def draw_curves(runs: Sequence[Path], out: Path) -> None:
    """Draws success and return over the environment steps: thin lines for members, a thick one for their mean.

    Members that differ in nothing but the seed share a colour.

    Args:
        runs: run folders.
        out: the picture; its folder must exist.

    Raises:
        UserError: a run has no metrics, or the picture cannot be written.
    """
    figure, axes = plt.subplots(1, len(_PANELS), figsize=(10, 4), layout="constrained")
    titles = []
    for path in runs:
        folder = RunFolder.open(path)
        config = from_yaml(folder.config)
        titles.append(config.env)
        rows = read_rows(folder.metrics)
        prefix = f"{path.name}: " if len(runs) > 1 else ""
        for label, group in _by_setting(rows).items():
            for axis, (column, _) in zip(axes, _PANELS, strict=True):
                _draw_group(axis, group, column, f"{prefix}{config.method} {label}")
    for axis, (column, name) in zip(axes, _PANELS, strict=True):
        axis.set_xlabel("environment steps")
        axis.set_ylabel(name)
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize="small")
        else:
            axis.text(0.5, 0.5, f"no {column} yet", ha="center", va="center", transform=axis.transAxes)
    axes[0].set_ylim(-0.02, 1.02)
    figure.suptitle(", ".join(dict.fromkeys(titles)))
    with user_errors(out):
        figure.savefig(out, dpi=120)
    plt.close(figure)


def _by_setting(rows: Sequence[Row]) -> dict[str, dict[str, list[Row]]]:
    """{"alpha 0.3": {member: its rows}}: members grouped by everything that was scanned but the seed."""
    groups: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        # What tells members apart stands before the phase, see MetricsTable.
        columns = list(row)
        scanned = [name for name in columns[: columns.index("phase")] if name not in _NOT_SCANNED]
        label = ", ".join(f"{name} {row[name]}" for name in scanned)
        groups.setdefault(label, {}).setdefault(row["member"], []).append(row)
    return groups


def _draw_group(axis: Axes, members: dict[str, list[Row]], column: str, label: str) -> None:
    curves = [_curve(rows, column) for rows in members.values()]
    curves = [curve for curve in curves if curve.size]
    if not curves:
        return
    steps = sorted({step for curve in curves for step in curve[0]})
    mean = np.mean([np.interp(steps, *curve) for curve in curves], axis=0)
    (line,) = axis.plot(steps, mean, linewidth=2, marker="o", markersize=3, label=label)
    if len(curves) > 1:
        for curve in curves:
            axis.plot(*curve, color=line.get_color(), linewidth=0.8, alpha=0.5)


def _curve(rows: Sequence[Row], column: str) -> np.ndarray:
    """float[2, points]: environment steps and values; empty if nothing was measured."""
    points = [(float(row["env_steps"] or 0), float(row[column])) for row in rows if row.get(column)]
    points = [point for point in points if not math.isnan(point[1])]
    return np.asarray(points).T if points else np.empty((2, 0))
