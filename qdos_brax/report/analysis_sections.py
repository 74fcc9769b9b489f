"""The sections of the page on what a run has learned: its segment weights, its latents, its skills, an episode."""

from __future__ import annotations

import colorsys
from typing import Any

import numpy as np

from qdos_brax.report.elements import PALETTE, Figure, Section, axis_layout, json_numbers, log_axis
from qdos_brax.report.episode_section import episode_section
from qdos_brax.report.maps import MAP_HEIGHT, dots, embedding_layout, goal_star, map_layout, path_line
from qdos_brax.report.member_analysis import (
    MemberAnalysis,
    part_colours,
    part_names,
    quality_colours,
    quality_groups,
    quality_names,
)

PROGRESS = "progress (decrease of the distance to the goal)"
SKILL_SETS = (("grid", "a grid of skills"), ("between", "from one skill to another"))
_COLOUR_BY = ("quality", "subtask", "progress", "return", "weight")
_PLAIN_MARKER = {"size": 6, "opacity": 0.6, "color": "#9aa1aa", "showscale": False}  # of what is not known
_COLOUR_BAR = {"thickness": 10, "outlinewidth": 0}


def analysis_sections(analyses: list[MemberAnalysis]) -> list[Section]:
    """Return the sections that have something to show; arrays that a task or a method cannot give leave theirs out."""
    made = (_weights(analyses), _latents(analyses), _skill_paths(analyses), episode_section(analyses))
    return [section for section in made if section.figures or section.subsections]


def skill_colours(name: str, count: int) -> list[str]:
    """Return the colours of the paths of a set of skills.

    A grid is coloured by the direction from its middle, which is grey; other sets go from blue to orange.

    Args:
        name: of the set, one of ``SKILL_SETS``.
        count: its number of skills.
    """
    if name == "grid":
        ticks = np.linspace(-1, 1, round(count**0.5))
        return [_by_direction(x, y) for y in ticks for x in ticks]
    first, last = np.array([0, 114, 178]), np.array([230, 159, 0])
    return [_hex(first + (last - first) * share) for share in np.linspace(0, 1, count)]


# --- Segments of the data --------------------------------------------------------------------------------------


def _weights(analyses: list[MemberAnalysis]) -> Section:
    """Return a chart per member: weight over true progress, coloured by the behaviour that produced the segment."""
    text = (
        "Each dot is a random segment of the data: its weight in skill learning over the true progress that it made "
        "towards the goal. Weights that follow the quality of segments rise to the right."
    )
    figures = [_weight_chart(a) for a in analyses if "weight" in a.own and "gain" in a.data]
    return Section("Weight against quality", text, figures=figures)


def _weight_chart(analysis: MemberAnalysis) -> Figure:
    weight, gain = analysis.own["weight"], analysis.data["gain"]
    groups = quality_groups(analysis, len(gain))
    data = [dots(gain[chosen], weight[chosen], colour, name, analysis) for chosen, colour, name in groups]
    layout = axis_layout(PROGRESS, "weight")
    layout["yaxis"] |= log_axis(weight)
    return Figure(analysis.label, data, layout)


def _latents(analyses: list[MemberAnalysis]) -> Section:
    markers = [(analysis, _markers(analysis)) for analysis in analyses if "tsne" in analysis.own]
    known = [name for name in _COLOUR_BY if any(name in own for _, own in markers)]
    text = (
        "The same random segments of the data as each method's encoder represents them, laid out by t-SNE. Choose what "
        "the colour shows: the behaviour that produced a segment, which subtask it did or undid, its progress towards "
        "the goal, its return or its weight. Grey: not known, or no subtask."
    )
    figures = [_latent_chart(analysis, own, known) for analysis, own in markers]
    return Section("Latents of segments (t-SNE)", text, figures=figures, choices=known)


def _latent_chart(analysis: MemberAnalysis, markers: dict[str, dict[str, Any]], known: list[str]) -> Figure:
    x, y = analysis.own["tsne"].T
    trace = dots(x, y, PALETTE[0], "segment", analysis) | {"marker": next(iter(markers.values()), _PLAIN_MARKER)}
    if facts := _facts(analysis):
        trace |= {"customdata": facts, "hovertemplate": "%{customdata}<extra></extra>"}
    choices = {name: {"marker": markers.get(name, _PLAIN_MARKER)} for name in known}
    return Figure(analysis.label, [trace], embedding_layout(), choices, MAP_HEIGHT)


def _markers(analysis: MemberAnalysis) -> dict[str, dict[str, Any]]:
    """Return plotly's markers by what colours the segments."""
    found = {}
    common = {"size": 6, "opacity": 0.8}
    if names := quality_names(analysis):
        found["quality"] = common | _by_code(analysis.data["quality"], names, quality_colours(analysis))
    if names := part_names(analysis):
        codes = analysis.data["part"]
        sizes = {"size": [4 if code == 0 else 8 for code in codes]}  # segments of no subtask are many
        found["subtask"] = common | sizes | _by_code(codes, names, part_colours(analysis))
    for name, measure in _measures(analysis).items():
        if np.isfinite(measure).any():
            low, high = np.nanquantile(measure, [0.02, 0.98])
            scale = {"colorscale": "Viridis", "cmin": float(low), "cmax": float(high)}
            found[name] = {**common, **scale, "color": json_numbers(measure), "colorbar": _COLOUR_BAR}
    return found


def _by_code(codes: np.ndarray, names: list[str], colours: list[str]) -> dict[str, Any]:
    """Return what colours markers by codes 0, 1, .., and explains the colours."""
    count = len(names)
    edges = [[at, colour] for i, colour in enumerate(colours) for at in (i / count, (i + 1) / count)]
    bar = _COLOUR_BAR | {"tickvals": list(range(count)), "ticktext": names}
    scale = {"colorscale": edges, "cmin": -0.5, "cmax": count - 0.5}
    return {**scale, "color": json_numbers(codes), "colorbar": bar}


def _measures(analysis: MemberAnalysis) -> dict[str, np.ndarray]:
    """Return the numbers that are known of the segments, by name."""
    data = analysis.data
    found = {"progress": data.get("gain"), "return": data.get("return"), "weight": analysis.own.get("weight")}
    return {name: measure for name, measure in found.items() if measure is not None}


def _facts(analysis: MemberAnalysis) -> list[str]:
    """Return everything that is known of each segment, in words; [] if nothing is."""
    words = [[f"{name} {value:.3g}" for value in measure] for name, measure in _measures(analysis).items()]
    if names := part_names(analysis):
        words.insert(0, [f"subtask: {names[code]}" for code in analysis.data["part"]])
    if names := quality_names(analysis):
        words.insert(0, [names[code] for code in analysis.data["quality"]])
    return ["<br>".join(of_one) for of_one in zip(*words, strict=True)]


# --- Skills ----------------------------------------------------------------------------------------------------


def _skill_paths(analyses: list[MemberAnalysis]) -> Section:
    figures = [
        _skill_map(analysis, name, words) for analysis in analyses for name, words in SKILL_SETS if name in analysis.own
    ]
    text = (
        "Each line is one skill, kept for the length of three segments from the task's start; the dot is its end, the "
        "star the goal. A grid of skills: along the two directions in which the latents of the data vary most, up to "
        "two standard deviations; the hue is the direction from the middle of the grid. From one skill to another: on "
        "a straight line between the latents of two segments of the data, from blue to orange. Drag over a part of "
        "the map to enlarge it."
    )
    return Section("Where skills lead", text, figures=figures)


def _skill_map(analysis: MemberAnalysis, name: str, words: str) -> Figure:
    paths = analysis.own[name]
    colours = skill_colours(name, len(paths))
    data = [path_line(path, colours[i], f"skill {i + 1} of {len(paths)}", analysis) for i, path in enumerate(paths)]
    return Figure(f"{words}: {analysis.label}", [*data, *goal_star(analysis)], map_layout(analysis), height=MAP_HEIGHT)


def _by_direction(x: float, y: float) -> str:
    away = min(1.0, float(np.hypot(x, y)))
    colour = colorsys.hsv_to_rgb(float(np.arctan2(y, x)) / (2 * np.pi) % 1, 0.85 * away, 0.6 + 0.2 * away)
    return _hex(np.array(colour) * 255)


def _hex(colour: np.ndarray) -> str:
    return "#" + "".join(f"{round(float(part)):02x}" for part in colour)
