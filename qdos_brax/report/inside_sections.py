"""The parts of the page that show what a run has learned: its weights, its latents, its skills, an episode."""

from __future__ import annotations

import base64
import colorsys
import io
from typing import Any

import matplotlib.image
import numpy as np

from qdos_brax.report.looks import QUALITIES, QUALITY_COLOURS, WALL, Look, by_quality, extent
from qdos_brax.report.parts import PALETTE, Figure, Image, Section, Trace, axes, logarithmic, member_id, numbers

_COLOUR_BY = ("quality", "progress", "return", "weight")
_UNKNOWN = "#9aa1aa"  # of what is not known of a segment
_SQUARE = 430  # pixels, the height of a map


def inside_sections(looks: list[Look]) -> list[Section]:
    """Those that there is something to show in."""
    made = (_weights(looks), _latents(looks), _map(looks), _episodes(looks))
    return [section for section in made if section.figures or section.inner]


def skill_colours(name: str, count: int) -> list[str]:
    """Of the paths of a grid of skills: hue by direction from its middle, which is grey; else from blue to orange."""
    if name == "grid":
        ticks = np.linspace(-1, 1, round(count**0.5))
        return [_by_direction(x, y) for y in ticks for x in ticks]
    first, last = np.array([0, 114, 178]), np.array([230, 159, 0])
    return [_hex(first + (last - first) * share) for share in np.linspace(0, 1, count)]


def _weights(looks: list[Look]) -> Section:
    """Weight against what the segment gained, coloured by what produced it."""
    figures = []
    for look in looks:
        if "weight" in look.own and "gain" in look.data:
            weight, gain = look.own["weight"], look.data["gain"]
            data = [
                _dots(gain[chosen], weight[chosen], colour, name, look) for chosen, colour, name in by_quality(look)
            ]
            layout = axes("units of path to the goal gained", "weight")
            layout["yaxis"] |= logarithmic(weight)
            figures.append(Figure(look.label, data, layout))
    text = (
        "Random segments of the data: the weight of each in skill learning, against the way towards the goal that it "
        "truly made. A good estimate of quality rises to the right."
    )
    return Section("Weight against quality", text, figures=figures)


def _latents(looks: list[Look]) -> Section:
    figures = []
    for look in looks:
        if "tsne" in look.own:
            markers = _markers(look)
            x, y = look.own["tsne"].T
            data = _dots(x, y, PALETTE[0], "segment", look) | {"marker": next(iter(markers.values()))}
            data |= {"customdata": _facts(look), "hovertemplate": "%{customdata}<extra></extra>"}
            layout = axes("", "") | {"margin": {"l": 14, "r": 10, "t": 14, "b": 14}}
            for axis in ("xaxis", "yaxis"):
                layout[axis] |= {"showticklabels": False, "zeroline": False}
            choices = {name: {"marker": marker} for name, marker in markers.items()}
            figures.append(Figure(look.label, [data], layout, choices, _SQUARE))
    text = (
        "The same random segments of the data as each method's encoder sees them, laid out by t-SNE. Choose the "
        "colour: what produced a segment, the way it made towards the goal, its return, its weight; grey where it is "
        "not known."
    )
    known = [name for name in _COLOUR_BY if any(name in figure.choices for figure in figures)]
    plain = {"marker": {"size": 6, "opacity": 0.6, "color": _UNKNOWN, "showscale": False}}
    for figure in figures:
        assert isinstance(figure.choices, dict)
        figure.choices.update({name: plain for name in known if name not in figure.choices})
    return Section("Latents of segments (t-SNE)", text, figures=figures, choices=known)


def _markers(look: Look) -> dict[str, dict[str, Any]]:
    """Plotly's markers by what colours the segments."""
    found = {}
    common = {"size": 6, "opacity": 0.8}
    if "quality" in look.data:
        edges = [[at, colour] for i, colour in enumerate(QUALITY_COLOURS) for at in (i / 4, (i + 1) / 4)]
        scale = {"colorscale": edges, "cmin": -0.5, "cmax": 3.5}
        bar = _bar() | {"tickvals": [0, 1, 2, 3], "ticktext": QUALITIES}
        found["quality"] = {**common, **scale, "color": numbers(look.data["quality"]), "colorbar": bar}
    for name, measure in _measures(look).items():
        if np.isfinite(measure).any():
            low, high = np.nanquantile(measure, [0.02, 0.98])
            scale = {"colorscale": "Viridis", "cmin": float(low), "cmax": float(high)}
            found[name] = {**common, **scale, "color": numbers(measure), "colorbar": _bar()}
    return found


def _measures(look: Look) -> dict[str, np.ndarray]:
    """What is known of the segments in numbers."""
    found = {"progress": look.data.get("gain"), "return": look.data["return"], "weight": look.own.get("weight")}
    return {name: measure for name, measure in found.items() if measure is not None}


def _facts(look: Look) -> list[str]:
    """Everything that is known of each segment, in words."""
    words = [[f"{name} {value:.3g}" for value in measure] for name, measure in _measures(look).items()]
    if "quality" in look.data:
        words.insert(0, [QUALITIES[code] for code in look.data["quality"]])
    return ["<br>".join(of_one) for of_one in zip(*words, strict=True)]


def _map(looks: list[Look]) -> Section:
    figures = []
    for look in looks:
        for name, words in (("grid", "a grid of skills"), ("between", "from one skill to another")):
            if name in look.own:
                paths = look.own[name]
                shades = skill_colours(name, len(paths))
                data = [_path(path, shades[i], f"skill {i + 1} of {len(paths)}", look) for i, path in enumerate(paths)]
                figures.append(Figure(f"{words}: {look.label}", [*data, _goal(look)], _maze(look), height=_SQUARE))
    text = (
        "Each line is one skill, held for three segments' time from the task's start; its dot is the end. A grid: "
        "along the two directions in which latents of the data spread most, to two standard deviations; the hue is the "
        "direction from the grid's middle. From one to another: straight between the latents of two segments of the "
        "data, from blue to orange. Drag over a part of the maze to enlarge it."
    )
    return Section("Where skills lead", text, figures=figures)


def _episodes(looks: list[Look]) -> Section:
    inner = [_episode(look, opened=i == 0) for i, look in enumerate(looks) if "path" in look.own]
    text = (
        "The first evaluation episode of a member: the latent of every decision, the way left to the goal, the path, "
        "and the scene at the steps that are marked."
    )
    return Section("Skills over an episode", text, inner=inner)


def _episode(look: Look, opened: bool) -> Section:
    left, steps = look.own["left"], look.own.get("frame_steps", np.zeros(0, int))
    way = _path(np.stack([np.arange(len(left)), left], axis=1), PALETTE[0], "way left", look)
    marks = _dots(steps, left[steps], PALETTE[1], "picture", look) | {"showlegend": False}
    layout = axes("environment steps", "units of path to the goal")
    layout["yaxis"] |= {"rangemode": "tozero"}
    path = _path(look.own["path"], PALETTE[0], "path", look)
    figures = [
        _skills_over_time(look),
        Figure("way left to the goal", [way, marks], layout),
        Figure("path", [path, _goal(look)], _maze(look), height=_SQUARE),
    ]
    images = [
        Image(f"step {step}", _jpeg(frame)) for step, frame in zip(steps, look.own.get("frames", ()), strict=True)
    ]
    return Section(look.label, figures=figures, images=images, opened=opened)


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
        "colorbar": _bar() | {"title": {"text": "z"}},
        "name": "z",
        "hovertemplate": "step %{x}, dimension %{y}: %{z:.2f}<extra></extra>",
        "meta": {"member": member_id(look.member)},
    }
    layout = axes("environment steps", "dimension of the latent")
    return Figure("skills over time", [heat], layout)


# --- Traces ----------------------------------------------------------------------------------------------------


def _bar() -> dict[str, Any]:
    """The scale beside a chart."""
    return {"thickness": 10, "outlinewidth": 0}


def _dots(x: np.ndarray, y: np.ndarray, colour: str, name: str, look: Look) -> Trace:
    marker = {"color": colour, "size": 6, "opacity": 0.65}
    meta = {"member": member_id(look.member)}
    return {"x": numbers(x), "y": numbers(y), "mode": "markers", "marker": marker, "name": name, "meta": meta}


def _path(path: np.ndarray, colour: str, name: str, look: Look) -> Trace:
    """A line with a dot at its end."""
    x, y = path.T
    sizes = [0] * (len(path) - 1) + [6]
    drawn = {"mode": "lines+markers", "line": {"color": colour, "width": 2}, "showlegend": False}
    return _dots(x, y, colour, name, look) | drawn | {"marker": {"color": colour, "size": sizes, "opacity": 1}}


def _goal(look: Look) -> Trace:
    x, y = look.data["goal"]
    marker = {"symbol": "star", "size": 15, "color": "#d00000"}
    return {"x": [float(x)], "y": [float(y)], "mode": "markers", "marker": marker, "name": "goal", "showlegend": False}


def _maze(look: Look) -> dict[str, Any]:
    """A map's layout: one unit as long in x as in y, the walls as grey boxes."""
    (left, low), (right, high), half = extent(look)
    layout = axes("", "") | {"margin": {"l": 30, "r": 10, "t": 10, "b": 26}}
    layout["shapes"] = [
        {"type": "rect", "x0": float(x) - half, "x1": float(x) + half, "y0": float(y) - half, "y1": float(y) + half,
         "fillcolor": WALL, "line": {"width": 0}, "layer": "below"}
        for x, y in look.data["walls"]
    ]  # fmt: skip
    layout["xaxis"] |= {"range": [float(left), float(right)], "constrain": "domain", "showgrid": False}
    layout["yaxis"] |= {"range": [float(low), float(high)], "scaleanchor": "x", "constrain": "domain"}
    layout["yaxis"] |= {"showgrid": False, "zeroline": False}
    layout["xaxis"] |= {"zeroline": False}
    return layout


def _by_direction(x: float, y: float) -> str:
    away = min(1.0, float(np.hypot(x, y)))
    colour = colorsys.hsv_to_rgb(float(np.arctan2(y, x)) / (2 * np.pi) % 1, 0.85 * away, 0.6 + 0.2 * away)
    return _hex(np.array(colour) * 255)


def _hex(colour: np.ndarray) -> str:
    return "#" + "".join(f"{round(float(part)):02x}" for part in colour)


def _jpeg(frame: np.ndarray) -> str:
    """A picture as a data URI."""
    content = io.BytesIO()
    matplotlib.image.imsave(content, frame, format="jpeg")
    return "data:image/jpeg;base64," + base64.b64encode(content.getvalue()).decode()
