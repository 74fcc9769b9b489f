"""The section of the page on an episode of each member: its skills, distance, path, pictures and film."""

from __future__ import annotations

import base64
import dataclasses
import io

import matplotlib.image
import numpy as np

from qdos_brax.report.elements import PALETTE, Figure, Film, Image, Section, axis_layout, json_numbers, member_id
from qdos_brax.report.latent_trajectory import latent_trajectory, moment, parts_done
from qdos_brax.report.maps import MAP_HEIGHT, dots, goal_star, map_layout, path_line
from qdos_brax.report.member_analysis import MemberAnalysis

DISTANCE = "distance left to the goal"
_COLOUR_BAR = {"thickness": 10, "outlinewidth": 0}
_MOST_FILMS = 9  # of some 300 kB each: a page stays below 10 MB


def episode_section(analyses: list[MemberAnalysis]) -> Section:
    """Return a folded part per member, the first one unfolded."""
    parts = [
        Section(a.label, figures=_episode_charts(a), films=_films(a) if i < _MOST_FILMS else [], images=_images(a))
        for i, a in enumerate(analyses)
    ]
    shown = [part for part in parts if part.figures or part.films or part.images]
    text = (
        "The first evaluation episode of each member: the latent of each decision (a skill, played until the next "
        "one), their path in latent space over segments of the data, the distance left to the goal, the path of what "
        "acts, the scene at the marked steps, and a film, as far as the task has them."
    )
    shown[:1] = [dataclasses.replace(part, expanded=True) for part in shown[:1]]
    return Section("Skills over an episode", text, subsections=shown)


def _episode_charts(analysis: MemberAnalysis) -> list[Figure]:
    figures = []
    if "latents" in analysis.own:
        figures.append(_skills_over_time(analysis))
    figures += latent_trajectory(analysis)
    if "left" in analysis.own:
        figures.append(_distance_over_time(analysis))
    if "path" in analysis.own:
        data = [path_line(analysis.own["path"], PALETTE[0], "path", analysis), *goal_star(analysis)]
        figures.append(Figure("path", data, map_layout(analysis), height=MAP_HEIGHT))
    return figures


def _skills_over_time(analysis: MemberAnalysis) -> Figure:
    """Return the latents of an episode, dimension by dimension, at the steps at which they were chosen."""
    latents = analysis.own["latents"]
    period = int(analysis.member.values["skills.horizon"])
    largest = float(np.abs(latents).max())
    heat = {
        "type": "heatmap",
        "x": [period * i for i in range(len(latents))],
        "z": [json_numbers(column) for column in latents.T],
        "colorscale": "RdBu",
        "zmin": -largest,
        "zmax": largest,
        "colorbar": _COLOUR_BAR | {"title": {"text": "z"}},
        "name": "z",
        "hovertemplate": "step %{x}, dimension %{y}: %{z:.2f}<extra></extra>",
        "meta": {"member": member_id(analysis.member)},
    }
    layout = axis_layout("environment steps", "dimension of the latent")
    return Figure("skills over time", [heat], layout)


def _distance_over_time(analysis: MemberAnalysis) -> Figure:
    left = analysis.own["left"]
    data = [path_line(np.stack([np.arange(len(left)), left], axis=1), PALETTE[0], DISTANCE, analysis)]
    if steps := [step for step, _ in _frames(analysis)]:
        data.append(dots(np.asarray(steps), left[steps], PALETTE[1], "picture", analysis) | {"showlegend": False})
    layout = axis_layout("environment steps", "distance")
    layout["yaxis"] |= {"rangemode": "tozero"}
    return Figure(DISTANCE, data, layout)


def _films(analysis: MemberAnalysis) -> list[Film]:
    frames = _frames(analysis)
    if not frames or not {"film", "film_speed"} <= set(analysis.own):
        return []
    source = _data_uri("image/webp", analysis.own["film"].tobytes())
    title = f"the whole episode, {float(analysis.own['film_speed']):.1f} times as fast"
    steps = f"from step {frames[0][0]}{_measured(analysis, 0)} to step {frames[-1][0]}{_measured(analysis, -1)}"
    return [Film(title, source, _jpeg(frames[0][1]), f"Film of the episode of {analysis.label}, {steps}")]


def _images(analysis: MemberAnalysis) -> list[Image]:
    return [
        Image(moment(analysis, step), _jpeg(frame), f"The scene at {moment(analysis, step)}{_measured(analysis, step)}")
        for step, frame in _frames(analysis)
    ]


def _measured(analysis: MemberAnalysis, step: int) -> str:
    """Return what a task measures at a step, in words; nothing for a task that measures nothing."""
    left = f"{analysis.own['left'][step]:.1f} from the goal" if "left" in analysis.own else ""
    words = "; ".join(filter(None, (left, parts_done(analysis, step))))
    return f" ({words})" if words else ""


def _frames(analysis: MemberAnalysis) -> list[tuple[int, np.ndarray]]:
    """Return (step, uint8[height, width, 3]) of each picture of the episode."""
    if not {"frames", "frame_steps"} <= set(analysis.own):
        return []
    return list(zip(map(int, analysis.own["frame_steps"]), analysis.own["frames"], strict=True))


def _jpeg(frame: np.ndarray) -> str:
    """Return a picture as a data URI."""
    content = io.BytesIO()
    matplotlib.image.imsave(content, frame, format="jpeg")
    return _data_uri("image/jpeg", content.getvalue())


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
