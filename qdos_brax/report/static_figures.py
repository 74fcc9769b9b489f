"""The charts of the page as PNG files, apart from curves and scans (``curves``)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")  # no display is needed to write a file
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize

from qdos_brax.report.analysis_sections import PROGRESS, SKILL_SETS, skill_colours
from qdos_brax.report.curves import save_figure, setting_colours
from qdos_brax.report.elements import PALETTE
from qdos_brax.report.episode_section import DISTANCE
from qdos_brax.report.latent_trajectory import SKILLS_COLOUR, moment, picture_decisions
from qdos_brax.report.member_analysis import (
    WALL_COLOUR,
    MemberAnalysis,
    maze_extent,
    part_colours,
    part_names,
    quality_colours,
    quality_groups,
    quality_names,
)
from qdos_brax.report.study import Study
from qdos_brax.report.summary_cards import PHASES


def draw_static_figures(study: Study, analyses: list[MemberAnalysis], out: Path) -> list[Path]:
    """Draw every chart that has something to show.

    Args:
        study: what was run.
        analyses: what was found inside its runs.
        out: the folder for the files, which must exist.

    Returns:
        The files, in the order of the page.

    Raises:
        UserError: a file cannot be written.
    """
    first_goals, wall_time = out / "first_goals.png", out / "wall_time.png"
    files = [first_goals] if _first_goals(study, first_goals) else []
    files += [out / kind.file for kind in _KINDS if _panels(analyses, kind, out / kind.file)]
    _wall_time(study, wall_time)
    return [*files, wall_time]


class _Kind(NamedTuple):
    """Hold a kind of figure: a row of panels per member.

    Attributes:
        file: its name.
        shown: whether a member has what is needed.
        draw: function that draws the panels of a member; it may leave panels empty.
        columns: panels per member.
    """

    file: str
    shown: Callable[[MemberAnalysis], bool]
    draw: Callable[[Iterable[Axes], MemberAnalysis], None]
    columns: int


def _panels(analyses: list[MemberAnalysis], kind: _Kind, out: Path) -> bool:
    """Draw a figure; return False, without writing a file, if no member has what is needed."""
    analyses = [analysis for analysis in analyses if kind.shown(analysis)]
    if not analyses:
        return False
    size = (max(6, 4.6 * kind.columns), 4 * len(analyses))
    figure, axes = plt.subplots(len(analyses), kind.columns, figsize=size, layout="constrained", squeeze=False)
    for row, analysis in zip(axes, analyses, strict=True):
        kind.draw(row, analysis)
        row[0].set_title(analysis.label, loc="left", fontsize="medium", fontweight="bold")
        for axis in row:
            if not axis.has_data():
                axis.set_axis_off()
    save_figure(figure, out)
    return True


def _weights(axes: Iterable[Axes], analysis: MemberAnalysis) -> None:
    (axis,) = axes
    gain, weight = analysis.data["gain"], analysis.own["weight"]
    for chosen, colour, name in quality_groups(analysis, len(gain)):
        axis.plot(gain[chosen], weight[chosen], ".", color=colour, alpha=0.6, label=name)
    axis.set(xlabel=PROGRESS, ylabel="weight", yscale="log")
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")


def _latents(axes: Iterable[Axes], analysis: MemberAnalysis) -> None:
    by_quality, by_progress, by_return = axes
    names = quality_names(analysis)
    colours = ListedColormap(quality_colours(analysis)) if names else None
    _scatter_latents(by_quality, analysis, "quality", analysis.data.get("quality"), colours, names)
    for axis, name, measure in ((by_progress, "progress", "gain"), (by_return, "return", "return")):
        _scatter_latents(axis, analysis, name, analysis.data.get(measure))


def _latents_by_part(axes: Iterable[Axes], analysis: MemberAnalysis) -> None:
    (axis,) = axes
    colours = ListedColormap(part_colours(analysis))
    _scatter_latents(axis, analysis, "subtask", analysis.data["part"], colours, part_names(analysis))


def _trajectory(axes: Iterable[Axes], analysis: MemberAnalysis) -> None:
    """Draw the episode's path in latent space, and its scenes beside it."""
    plane, *scenes = axes
    places, decisions = analysis.own["tsne_episode"], picture_decisions(analysis)
    plane.plot(*analysis.own["tsne"].T, ".", color=SKILLS_COLOUR, alpha=0.4)
    plane.plot(*places.T, ".-", color=PALETTE[0], linewidth=1)
    plane.plot(*places[decisions].T, "o", color=PALETTE[1])
    for decision in set(decisions):
        plane.annotate(str(decision), places[decision], (0, 5), textcoords="offset points", ha="center")
    plane.set(xticks=[], yticks=[], xlabel="t-SNE of latents; grey: segments of the data")
    pictures = (analysis.own.get("frames", ()), analysis.own.get("frame_steps", ()))
    for scene, frame, step in zip(scenes, *pictures, strict=False):
        scene.imshow(frame)
        scene.set(xticks=[], yticks=[], xlabel=moment(analysis, int(step)))


def _scatter_latents(
    axis: Axes,
    analysis: MemberAnalysis,
    name: str,
    measure: np.ndarray | None,
    colours: ListedColormap | None = None,
    names: Sequence[str] = (),
) -> None:
    """Draw the latents coloured by a measure of their segments; grey where it is not known."""
    x, y = analysis.own["tsne"].T
    axis.set(xticks=[], yticks=[], xlabel=f"{name}: not known" if measure is None else f"colour: {name}")
    if measure is None:
        axis.scatter(x, y, s=9, c="#9aa1aa")
        return
    limits = None if colours is None else Normalize(-0.5, colours.N - 0.5)
    points = axis.scatter(x, y, s=9, c=measure, cmap=colours or "viridis", norm=limits)
    bar = axis.figure.colorbar(points, ax=axis, shrink=0.8)
    if colours is not None:
        bar.set_ticks(range(colours.N), labels=names)


def _skills(axes: Iterable[Axes], analysis: MemberAnalysis) -> None:
    for axis, (name, words) in zip(axes, SKILL_SETS, strict=True):
        if name in analysis.own:
            paths = analysis.own[name]
            for path, colour in zip(paths, skill_colours(name, len(paths)), strict=True):
                axis.plot(*path.T, color=colour, linewidth=1.5)
                axis.plot(*path[-1], ".", color=colour)
            _draw_map(axis, analysis)
            axis.set_xlabel(words)


def _episode(axes: Iterable[Axes], analysis: MemberAnalysis) -> None:
    latents, distance, path = axes
    if "latents" in analysis.own:
        _draw_latents(latents, analysis)
    if "left" in analysis.own:
        distance.plot(analysis.own["left"], color=PALETTE[0])
        distance.set(xlabel="environment steps", ylabel=DISTANCE, ylim=(0, None))
        distance.grid(alpha=0.3)
    if "path" in analysis.own:
        path.plot(*analysis.own["path"].T, color=PALETTE[0])
        _draw_map(path, analysis)


def _draw_latents(axis: Axes, analysis: MemberAnalysis) -> None:
    """Draw the latents of an episode over its steps, one row per dimension."""
    latents = analysis.own["latents"]
    largest = float(np.abs(latents).max())
    ends = (0, len(latents) * int(analysis.member.values["skills.horizon"]))
    image = axis.imshow(
        latents.T, aspect="auto", cmap="RdBu_r", vmin=-largest, vmax=largest, interpolation="nearest",
        extent=(*ends, latents.shape[1] - 0.5, -0.5),
    )  # fmt: skip
    axis.figure.colorbar(image, ax=axis, label="z", shrink=0.8)
    axis.set(xlabel="environment steps", ylabel="dimension of the latent")


def _draw_map(axis: Axes, analysis: MemberAnalysis) -> None:
    """Draw walls and goal, where the task has them, with one unit as long in x as in y."""
    if "goal" in analysis.data:
        axis.plot(*analysis.data["goal"], "*", color="#d00000", markersize=13)
    if (extent := maze_extent(analysis)) is not None:
        (left, low), (right, high), half = extent
        for x, y in analysis.data["walls"]:
            corner = (x - half, y - half)
            axis.add_patch(plt.Rectangle(corner, 2 * half, 2 * half, color=WALL_COLOUR, linewidth=0, zorder=0))
        axis.set(xlim=(left, right), ylim=(low, high))
    axis.set_aspect("equal")


_KINDS = (
    _Kind("weights.png", lambda a: "weight" in a.own and "gain" in a.data, _weights, 1),
    _Kind("latents.png", lambda a: "tsne" in a.own, _latents, 3),
    _Kind("subtasks.png", lambda a: "tsne" in a.own and "part" in a.data and bool(part_names(a)), _latents_by_part, 1),
    _Kind("trajectory.png", lambda a: {"tsne", "tsne_episode"} <= set(a.own), _trajectory, 7),
    _Kind("skills.png", lambda a: not a.own.keys().isdisjoint(("grid", "between")), _skills, 2),
    _Kind("episodes.png", lambda a: not a.own.keys().isdisjoint(("latents", "left", "path")), _episode, 3),
)


def _first_goals(study: Study, out: Path) -> bool:
    """Draw the steps of each member to its first goal; return False, without writing a file, if nobody reached it."""
    everyone = [member for setting in study.settings for group in setting.members.values() for member in group]
    if all(math.isnan(member.first_goal) for member in everyone):
        return False
    size = (9, max(2.5, 0.4 * len(study.settings) + 1.2) * len(study.tasks))
    figure, axes = plt.subplots(len(study.tasks), 1, figsize=size, layout="constrained", squeeze=False)
    for axis, task in zip(axes[:, 0], study.tasks, strict=True):
        _draw_first_goals(axis, study, task)
    save_figure(figure, out)
    return True


def _draw_first_goals(axis: Axes, study: Study, task: str) -> None:
    colours, names = setting_colours(study), []
    for row, setting in enumerate(s for s in study.settings if task in s.members):
        steps = [member.first_goal for member in setting.members[task]]
        axis.plot(steps, [row] * len(steps), "o", color=colours[setting.label], alpha=0.7)
        names.append(f"{setting.label} ({sum(not math.isnan(step) for step in steps)}/{len(steps)})")
    axis.set_yticks(range(len(names)), names)
    axis.set(xlabel="environment steps to the first goal", title=task, xlim=(0, None))
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.grid(alpha=0.3)


def _wall_time(study: Study, out: Path) -> None:
    figure, axis = plt.subplots(figsize=(9, 1.8 + 0.4 * len(study.runs)), layout="constrained")
    done = np.zeros(len(study.runs))
    for phase, colour in zip(PHASES, PALETTE, strict=False):
        minutes = np.asarray([float(run.summary["wall_seconds"].get(phase, 0.0)) / 60 for run in study.runs])
        axis.barh(range(len(study.runs)), minutes, left=done, color=colour, label=phase)
        done += minutes
    axis.set_yticks(range(len(study.runs)), [run.path.name for run in study.runs])
    axis.invert_yaxis()
    axis.set_xlabel("minutes")
    axis.legend(fontsize="small", ncols=len(PHASES))
    save_figure(figure, out)
