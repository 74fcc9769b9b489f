"""The page's other charts as PNGs: first goals, wall time, and what a look inside the runs found."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display is needed to write a file
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from qdos_brax.report.curves import colours_of, save
from qdos_brax.report.headlines import PHASES
from qdos_brax.report.inside_sections import skill_colours
from qdos_brax.report.looks import QUALITIES, QUALITY_COLOURS, WALL, Look, by_quality, extent
from qdos_brax.report.parts import PALETTE
from qdos_brax.report.study import Study


def draw_stills(study: Study, looks: list[Look], out: Path) -> list[Path]:
    """Draws everything there is something to draw of; the files, in the order of the page.

    Args:
        study: what was run.
        looks: what was seen inside its runs.
        out: the folder, which must exist.

    Raises:
        UserError: a picture cannot be written.
    """
    kinds: tuple[tuple[str, Callable[[], bool]], ...] = (
        ("first_goals.png", lambda: _first_goals(study, out / "first_goals.png")),
        ("weights.png", lambda: _panels(looks, "weight", _weights, 1, out / "weights.png")),
        ("latents.png", lambda: _panels(looks, "tsne", _latents, 3, out / "latents.png")),
        ("skills.png", lambda: _panels(looks, "grid", _skills, 2, out / "skills.png")),
        ("episodes.png", lambda: _panels(looks, "path", _episode, 3, out / "episodes.png")),
        ("wall_time.png", lambda: _wall_time(study, out / "wall_time.png")),
    )
    return [out / name for name, draw in kinds if draw()]


def _panels(
    looks: list[Look], needed: str, draw: Callable[[Iterable[Axes], Look], None], count: int, out: Path
) -> bool:
    """A row of panels per member; False, and no file, if none has what is needed."""
    looks = [look for look in looks if needed in look.own and (needed != "weight" or "gain" in look.data)]
    if not looks:
        return False
    figure, axes = plt.subplots(
        len(looks), count, figsize=(max(6, 4.6 * count), 4 * len(looks)), layout="constrained", squeeze=False
    )
    for row, look in zip(axes, looks, strict=True):
        draw(row, look)
        row[0].set_title(look.label, loc="left", fontsize="medium", fontweight="bold")
    save(figure, out)
    return True


def _weights(axes: Iterable[Axes], look: Look) -> None:
    (axis,) = axes
    for chosen, colour, name in by_quality(look):
        axis.plot(look.data["gain"][chosen], look.own["weight"][chosen], ".", color=colour, alpha=0.6, label=name)
    axis.set(xlabel="units of path to the goal gained", ylabel="weight", yscale="log")
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")


def _latents(axes: Iterable[Axes], look: Look) -> None:
    by_kind, by_gain, by_return = axes
    x, y = look.own["tsne"].T
    for axis, colours, name in (
        (by_kind, look.data.get("quality"), "quality"),
        (by_gain, look.data.get("gain"), "progress"),
        (by_return, look.data["return"], "return"),
    ):
        axis.set_xlabel(f"colour: {name}" if colours is not None else f"{name}: not known")
        axis.set(xticks=[], yticks=[])
        scale: dict[str, Any] = {"cmap": "viridis"}
        if name == "quality":
            scale = {"cmap": ListedColormap(QUALITY_COLOURS), "vmin": -0.5, "vmax": 3.5}
        points = axis.scatter(
            x, y, s=9, c="#9aa1aa" if colours is None else colours, **scale if colours is not None else {}
        )
        if colours is not None:
            bar = axis.figure.colorbar(points, ax=axis, shrink=0.8)
            if name == "quality":
                bar.set_ticks(range(len(QUALITIES)), labels=QUALITIES)


def _skills(axes: Iterable[Axes], look: Look) -> None:
    for axis, name, words in zip(axes, ("grid", "between"), ("a grid of skills", "from one to another"), strict=True):
        paths = look.own[name]
        for path, colour in zip(paths, skill_colours(name, len(paths)), strict=True):
            axis.plot(*path.T, color=colour, linewidth=1.5)
            axis.plot(*path[-1], ".", color=colour)
        _maze(axis, look)
        axis.set_xlabel(words)


def _episode(axes: Iterable[Axes], look: Look) -> None:
    over_time, way, path = axes
    latents, left = look.own["latents"], look.own["left"]
    largest = float(np.abs(latents).max())
    ends = (0, len(latents) * int(look.member.values["skills.horizon"]))
    image = over_time.imshow(
        latents.T, aspect="auto", cmap="RdBu_r", vmin=-largest, vmax=largest, interpolation="nearest",
        extent=(*ends, latents.shape[1] - 0.5, -0.5),
    )  # fmt: skip
    over_time.figure.colorbar(image, ax=over_time, label="z", shrink=0.8)
    over_time.set(xlabel="environment steps", ylabel="dimension of the latent")
    way.plot(left, color=PALETTE[0])
    way.set(xlabel="environment steps", ylabel="way left to the goal", ylim=(0, None))
    way.grid(alpha=0.3)
    path.plot(*look.own["path"].T, color=PALETTE[0])
    _maze(path, look)


def _maze(axis: Axes, look: Look) -> None:
    (left, low), (right, high), half = extent(look)
    for x, y in look.data["walls"]:
        axis.add_patch(plt.Rectangle((x - half, y - half), 2 * half, 2 * half, color=WALL, linewidth=0, zorder=0))
    axis.plot(*look.data["goal"], "*", color="#d00000", markersize=13)
    axis.set(xlim=(left, right), ylim=(low, high), aspect="equal")


def _first_goals(study: Study, out: Path) -> bool:
    reached = [m for s in study.settings for group in s.members.values() for m in group if not math.isnan(m.first_goal)]
    if not reached:
        return False
    colours = colours_of(study)
    size = (9, max(2.5, 0.4 * len(study.settings) + 1.2) * len(study.tasks))
    figure, axes = plt.subplots(len(study.tasks), 1, figsize=size, layout="constrained", squeeze=False)
    for axis, task in zip(axes[:, 0], study.tasks, strict=True):
        settings = [setting for setting in study.settings if task in setting.members]
        for row, setting in enumerate(settings):
            steps = [member.first_goal for member in setting.members[task]]
            axis.plot(steps, [row] * len(steps), "o", color=colours[setting.label], alpha=0.7)
        names = [
            f"{s.label} ({sum(not math.isnan(m.first_goal) for m in s.members[task])}/{len(s.members[task])})"
            for s in settings
        ]
        axis.set_yticks(range(len(settings)), names)
        axis.set(xlabel="environment steps to the first goal", title=task, xlim=(0, None))
        axis.set_ylim(len(settings) - 0.5, -0.5)
        axis.grid(alpha=0.3)
    save(figure, out)
    return True


def _wall_time(study: Study, out: Path) -> bool:
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
    save(figure, out)
    return True
