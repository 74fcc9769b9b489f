"""The parts of the page that show what a run has learned, from the run folders' inside.npz.

What its arrays are says ``qdos_brax.methods.inside``, which writes it.
"""

from __future__ import annotations

import base64
import io
import zipfile
from collections.abc import Iterator
from typing import Any, NamedTuple

import matplotlib.image
import numpy as np

from qdos_brax.errors import UserError
from qdos_brax.report.parts import PALETTE, Figure, Image, Section, Trace, axes, member_id, numbers
from qdos_brax.report.study import Member, Run, Study
from qdos_brax.runs.folder import RunFolder

_QUALITIES = ("good", "noisy", "wandering", "failing")  # by code, as data.quality.QUALITY has them
_COLOURS = ("#009E73", "#56B4E9", "#E69F00", "#D55E00")  # of these
_VIRIDIS = ("#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725")


class Look(NamedTuple):
    """What was found of one member.

    Attributes:
        member: whose it is.
        label: its setting and seed.
        data: the arrays that all members of the run share.
        own: its own arrays.
    """

    member: Member
    label: str
    data: dict[str, np.ndarray]
    own: dict[str, np.ndarray]


def inside_sections(study: Study) -> list[Section]:
    """Those that there is something to show in."""
    looks = [look for run in study.runs for look in _looks(study, run)]
    made = (_weights(looks), _latents(looks), _map(looks), _episodes(looks))
    return [section for section in made if section.figures]


def _looks(study: Study, run: Run) -> Iterator[Look]:
    file = RunFolder(run.path).inside
    if not file.is_file():
        return
    try:
        with np.load(file, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
        members = {int(index): run.members[int(index)] for index in arrays["members"]}
    except (OSError, EOFError, LookupError, ValueError, zipfile.BadZipFile) as error:
        raise UserError(f"cannot read {file} ({error}); remove it, and --resume {run.path} makes it again") from error
    shared = {name: array for name, array in arrays.items() if "/" not in name}
    for index, member in members.items():
        own = {name.partition("/")[2]: array for name, array in arrays.items() if name.startswith(f"{index}/")}
        label = next(s.label for s in study.settings if member in s.members.get(member.task, []))
        several = len(study.tasks) > 1
        yield Look(member, f"{label}, seed {member.seed}" + (f", {member.task}" if several else ""), shared, own)


def _weights(looks: list[Look]) -> Section:
    """Weight against what the segment gained, coloured by what produced it."""
    figures = []
    for look in looks:
        if "weight" in look.own and "gain" in look.data:
            weight, gain = look.own["weight"], look.data["gain"]
            data = [
                _dots(gain[chosen], weight[chosen], colour, name, look) for chosen, colour, name in _by_quality(look)
            ]
            layout = axes("units of path to the goal gained", "weight")
            layout["yaxis"] |= {"type": "log"}
            figures.append(Figure(look.label, data, layout))
    text = "Random segments of the data: the weight of each in skill learning, against the way that it truly made."
    return Section("Weight against quality", text, figures)


def _latents(looks: list[Look]) -> Section:
    figures = []
    for look in looks:
        if "tsne" in look.own:
            markers = _markers(look)
            x, y = look.own["tsne"].T
            data = _dots(x, y, PALETTE[0], "segment", look) | {"marker": next(iter(markers.values()))}
            layout = axes("", "") | {"margin": {"l": 20, "r": 10, "t": 45, "b": 20}}
            buttons = [
                {"label": name, "method": "restyle", "args": [{"marker": [marker]}]} for name, marker in markers.items()
            ]
            place = {"type": "buttons", "active": 0, "direction": "right", "x": 0, "xanchor": "left", "y": 1.16}
            layout["updatemenus"] = [{"buttons": buttons, **place}]
            for axis in ("xaxis", "yaxis"):
                layout[axis] |= {"showticklabels": False, "zeroline": False}
            figures.append(Figure(look.label, [data], layout))
    text = (
        "The same random segments of the data as each method's encoder sees them, laid out by t-SNE. The buttons "
        "choose the colour: what produced a segment, the way it made towards the goal, its return, its weight."
    )
    return Section("Latents of segments (t-SNE)", text, figures)


def _markers(look: Look) -> dict[str, dict[str, Any]]:
    """Plotly's markers by what colours the segments."""
    found = {}
    common = {"size": 6, "opacity": 0.8}
    if "quality" in look.data:
        edges = [[at, colour] for i, colour in enumerate(_COLOURS) for at in (i / 4, (i + 1) / 4)]
        scale = {"colorscale": edges, "cmin": -0.5, "cmax": 3.5}
        bar = {"thickness": 10, "tickvals": [0, 1, 2, 3], "ticktext": _QUALITIES}
        found["quality"] = {**common, **scale, "color": numbers(look.data["quality"]), "colorbar": bar}
    measures = {"progress": look.data.get("gain"), "return": look.data["return"], "weight": look.own.get("weight")}
    for name, measure in measures.items():
        if measure is not None and np.isfinite(measure).any():
            low, high = np.nanquantile(measure, [0.02, 0.98])
            scale = {"colorscale": "Viridis", "cmin": float(low), "cmax": float(high)}
            found[name] = {**common, **scale, "color": numbers(measure), "colorbar": {"thickness": 10}}
    return found


def _map(looks: list[Look]) -> Section:
    figures = []
    for look in looks:
        for name, words in (("grid", "a grid of skills"), ("between", "from one skill to another")):
            if name in look.own:
                paths = look.own[name]
                shades = [_VIRIDIS[i * len(_VIRIDIS) // len(paths)] for i in range(len(paths))]
                data = [_path(path, shades[i], f"skill {i + 1}", look) for i, path in enumerate(paths)]
                figures.append(Figure(f"{words}: {look.label}", [*data, _goal(look)], _maze(look)))
    text = (
        "Each line is one skill, held for three segments' time from the task's start. A grid: along the two directions "
        "in which latents of the data spread most, to two standard deviations. From one to another: straight between "
        "the latents of two segments of the data."
    )
    return Section("Where skills lead", text, figures)


def _episodes(looks: list[Look]) -> Section:
    figures, images = [], []
    for look in looks:
        left, steps = look.own["left"], look.own.get("frame_steps", np.zeros(0, int))
        figures.append(_skills_over_time(look))
        way = _path(np.stack([np.arange(len(left)), left], axis=1), PALETTE[0], "way left", look)
        marks = _dots(steps, left[steps], PALETTE[1], "picture", look) | {"showlegend": False}
        layout = axes("environment steps", "units")
        figures.append(Figure(f"way left to the goal: {look.label}", [way, marks], layout))
        path = _path(look.own["path"], PALETTE[0], "path", look)
        figures.append(Figure(f"path: {look.label}", [path, _goal(look)], _maze(look)))
        for step, frame in zip(steps, look.own.get("frames", ()), strict=True):
            images.append(Image(f"{look.label}: step {step}", _jpeg(frame)))
    text = "The first evaluation episode of a member: the latent of every decision, the way left, the path, the scene."
    return Section("An episode", text, figures, images=images)


def _skills_over_time(look: Look) -> Figure:
    """The latents of an episode, dimension by dimension, at the steps where they were decided on."""
    latents = look.own["latents"]
    period = int(look.member.values["skills.horizon"])
    largest = float(np.abs(latents).max())
    heat = {
        "type": "heatmap",
        "x": [period * i for i in range(len(latents))],
        "z": [numbers(column) for column in latents.T],
        "colorscale": "RdBu",
        "zmin": -largest,
        "zmax": largest,
        "colorbar": {"title": {"text": "z"}, "thickness": 10},
        "name": "z",
        "meta": {"member": member_id(look.member)},
    }
    layout = axes("environment steps", "dimension of the latent")
    return Figure(f"skills over time: {look.label}", [heat], layout)


# --- Traces ----------------------------------------------------------------------------------------------------


def _by_quality(look: Look) -> Iterator[tuple[np.ndarray, str, str]]:
    """(which segments, colour, name) of every kind of behaviour in the data; one for all where nobody knows."""
    quality = look.data.get("quality")
    if quality is None:
        yield np.ones(len(look.data["return"]), bool), PALETTE[0], "segments"
        return
    for code, name in enumerate(_QUALITIES):
        if (quality == code).any():
            yield quality == code, _COLOURS[code], name


def _dots(x: np.ndarray, y: np.ndarray, colour: str, name: str, look: Look) -> Trace:
    marker = {"color": colour, "size": 6, "opacity": 0.65}
    meta = {"member": member_id(look.member)}
    return {"x": numbers(x), "y": numbers(y), "mode": "markers", "marker": marker, "name": name, "meta": meta}


def _path(path: np.ndarray, colour: str, name: str, look: Look) -> Trace:
    x, y = path.T
    trace = _dots(x, y, colour, name, look) | {"mode": "lines", "line": {"color": colour, "width": 2}}
    del trace["marker"]
    return trace | {"showlegend": False}


def _goal(look: Look) -> Trace:
    x, y = look.data["goal"]
    marker = {"symbol": "star", "size": 15, "color": "#d00000"}
    return {"x": [float(x)], "y": [float(y)], "mode": "markers", "marker": marker, "name": "goal", "showlegend": False}


def _maze(look: Look) -> dict[str, Any]:
    """A map's layout: one unit as long in x as in y, the walls as grey boxes."""
    walls = look.data["walls"]
    half = 0.5 * float(np.diff(np.unique(walls[:, 0])).min())
    layout = axes("", "")
    layout["shapes"] = [
        {"type": "rect", "x0": float(x) - half, "x1": float(x) + half, "y0": float(y) - half, "y1": float(y) + half,
         "fillcolor": "#c3c8ce", "line": {"width": 0}, "layer": "below"}
        for x, y in walls
    ]  # fmt: skip
    (left, low), (right, high) = walls.min(axis=0) - half, walls.max(axis=0) + half
    layout["xaxis"] |= {"range": [float(left), float(right)], "constrain": "domain"}
    layout["yaxis"] |= {"range": [float(low), float(high)], "scaleanchor": "x", "constrain": "domain"}
    return layout


def _jpeg(frame: np.ndarray) -> str:
    """A picture as a data URI."""
    content = io.BytesIO()
    matplotlib.image.imsave(content, frame, format="jpeg")
    return "data:image/jpeg;base64," + base64.b64encode(content.getvalue()).decode()
