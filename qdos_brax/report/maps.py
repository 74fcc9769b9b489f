"""Traces and layouts of maps and paths, which several sections of the page draw."""

from __future__ import annotations

from typing import Any

import numpy as np

from qdos_brax.report.elements import Trace, axis_layout, json_numbers, member_id
from qdos_brax.report.member_analysis import WALL_COLOUR, MemberAnalysis, maze_extent

MAP_HEIGHT = 430  # pixels


def dots(x: np.ndarray, y: np.ndarray, colour: str, name: str, analysis: MemberAnalysis) -> Trace:
    """Return a cloud of dots that belongs to a member."""
    marker = {"color": colour, "size": 6, "opacity": 0.65}
    meta = {"member": member_id(analysis.member)}
    return {"x": json_numbers(x), "y": json_numbers(y), "mode": "markers", "marker": marker, "name": name, "meta": meta}


def path_line(path: np.ndarray, colour: str, name: str, analysis: MemberAnalysis) -> Trace:
    """Return a line with a dot at its end."""
    x, y = path.T
    sizes = [0] * (len(path) - 1) + [6]
    drawn = {"mode": "lines+markers", "line": {"color": colour, "width": 2}, "showlegend": False}
    return dots(x, y, colour, name, analysis) | drawn | {"marker": {"color": colour, "size": sizes, "opacity": 1}}


def goal_star(analysis: MemberAnalysis) -> list[Trace]:
    """Return a star at the goal; nothing for a task whose goal is no place."""
    if "goal" not in analysis.data:
        return []
    x, y = analysis.data["goal"]
    marker = {"symbol": "star", "size": 15, "color": "#d00000"}
    own = {"mode": "markers", "marker": marker, "name": "goal", "showlegend": False}
    return [{"x": [float(x)], "y": [float(y)], **own}]


def map_layout(analysis: MemberAnalysis) -> dict[str, Any]:
    """Return the layout of a map: one unit is as long in x as in y, walls are grey boxes."""
    layout = axis_layout("", "") | {"margin": {"l": 30, "r": 10, "t": 10, "b": 26}}
    layout["xaxis"] |= {"constrain": "domain", "showgrid": False, "zeroline": False}
    layout["yaxis"] |= {"constrain": "domain", "showgrid": False, "zeroline": False, "scaleanchor": "x"}
    if (extent := maze_extent(analysis)) is not None:
        (left, low), (right, high), half = extent
        layout["shapes"] = [_wall(x, y, half) for x, y in analysis.data["walls"]]
        layout["xaxis"]["range"] = [float(left), float(right)]
        layout["yaxis"]["range"] = [float(low), float(high)]
    return layout


def embedding_layout() -> dict[str, Any]:
    """Return the layout of a plane whose directions and distances mean nothing, as t-SNE's."""
    layout = axis_layout("", "") | {"margin": {"l": 14, "r": 10, "t": 14, "b": 14}}
    for axis in ("xaxis", "yaxis"):
        layout[axis] |= {"showticklabels": False, "zeroline": False}
    return layout


def _wall(x: float, y: float, half: float) -> dict[str, Any]:
    box = {"x0": float(x) - half, "x1": float(x) + half, "y0": float(y) - half, "y1": float(y) + half}
    return {"type": "rect", **box, "fillcolor": WALL_COLOUR, "line": {"width": 0}, "layer": "below"}
