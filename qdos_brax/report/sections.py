"""The parts of the page that need nothing but the run folders' text files: data in, figures out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from qdos_brax.config import to_yaml
from qdos_brax.report.curves import MEASURES, TICKS, colours_of, positions
from qdos_brax.report.headlines import PHASES, cards, duration, ranked
from qdos_brax.report.inside_sections import inside_sections
from qdos_brax.report.looks import Look
from qdos_brax.report.parts import PALETTE, Figure, Section, Trace, axes, logarithmic, member_id, numbers
from qdos_brax.report.series import Curve, Scan, Surface, curves, scans, surfaces
from qdos_brax.report.statistics import mean_curve
from qdos_brax.report.study import Member, Run, Setting, Study, plain, short
from qdos_brax.report.tables import Table, tables

_NOT_MEASURES = {"member", "seed", "phase", "env_steps", "update", "status_ok", "first_goal_step"}


def sections(study: Study, looks: list[Look]) -> list[Section]:
    """Everything there is something to show of, in the order of the page: the answers, and what they rest on."""
    made = (
        _in_short(study),
        _learning(study),
        _scan(study),
        _first_goal(study),
        Section("Tables", tables=tables(study)),
        *inside_sections(looks),
        _wall_time(study),
        _diagnostics(study),
        _provenance(study),
    )
    return [section for section in made if section.cards or section.figures or section.tables or section.inner]


def _in_short(study: Study) -> Section:
    colours = colours_of(study)
    figures = []
    for task in study.tasks:
        order = ranked(study, task)
        if order:
            data = [trace for setting, _ in order for trace in _spread(setting, task, colours[setting.label])]
            layout = axes("success at the last evaluation", "")
            layout["xaxis"] |= {"range": [-0.03, 1.03], "tickformat": ".0%"}
            layout["yaxis"] |= _rows(setting.label for setting, _ in order)
            figures.append(Figure(_titled(study, "every setting", task), data, layout, height=_height(len(order))))
    text = "Bar: 95 % bootstrap interval of the mean over seeds; diamond: the mean; dots: members." if figures else ""
    return Section("In short", text, cards(study), figures)


def _spread(setting: Setting, task: str, colour: str) -> Iterable[Trace]:
    """A setting's mean with its interval, and its members."""
    members = [member for member in setting.members[task] if not math.isnan(member.success)]
    mean, low, high = (float(x[0]) for x in mean_curve(np.asarray([[member.success] for member in members])))
    errors = {"type": "data", "symmetric": False, "thickness": 5, "width": 0}
    errors |= {"array": numbers([high - mean]), "arrayminus": numbers([mean - low])}
    yield {
        "x": numbers([mean]),
        "y": [setting.label],
        "error_x": errors,
        "mode": "markers",
        "marker": {"color": colour, "size": 12, "symbol": "diamond"},
        "name": f"{setting.label}, mean",
        "showlegend": False,
        "meta": {"setting": setting.label},
    }
    for member in members:
        yield _dot(member, member.success, setting.label, colour)


def _dot(member: Member, x: float, y: Any, colour: str, size: int = 8) -> Trace:
    """A member's own point; crossed out if it was frozen."""
    symbol = {"symbol": "x-thin-open", "line": {"width": 2}} if member.frozen else {}
    return {
        "x": [x],
        "y": [y],
        "mode": "markers",
        "marker": {"color": colour, "opacity": 0.55, "size": size, **symbol},
        "name": _name(member),
        "showlegend": False,
        "meta": {"member": member_id(member)},
    }


def _name(member: Member) -> str:
    return f"seed {member.seed}" + (" (frozen)" if member.frozen else "")


def _rows(names: Iterable[str]) -> dict[str, Any]:
    """A vertical axis of names, the first at the top."""
    return {"type": "category", "categoryarray": list(names)[::-1], "categoryorder": "array"}


def _height(rows: int) -> int:
    """Pixels of a chart with so many rows."""
    return 110 + 38 * rows


def _titled(study: Study, title: str, task: str) -> str:
    return f"{title}, {task}" if len(study.tasks) > 1 else title


def _learning(study: Study) -> Section:
    colours = colours_of(study)
    figures = [
        Figure(
            _titled(study, name, task),
            [trace for curve in drawn for trace in _curve(curve, colours[curve.setting.label])],
            axes("environment steps", name, share=name == "success"),
        )
        for task in study.tasks
        for column, name in MEASURES
        for drawn in [curves(study, task, column)]
        if drawn
    ]
    text = (
        "Thick: mean over a setting's members, with its 95 % bootstrap interval; thin: each member. Dashed: offline. "
        "Crossed out: frozen there, because its numbers were no longer finite."
    )
    return Section("Learning curves", text, figures=figures)


def _curve(curve: Curve, colour: str) -> Iterable[Trace]:
    label, own = curve.setting.label, {"setting": curve.setting.label}
    group = {"legendgroup": label, "mode": "lines"}
    if curve.offline:
        end = max((float(m.values["high_level.env_steps"]) for m, _ in curve.members), default=1.0)
        line: Trace = {"color": colour, "dash": "dash"}
        yield {**group, "x": [0, end], "y": numbers([curve.mean[-1]] * 2), "name": label, "line": line, "meta": own}
        return
    several = len(curve.members) > 1
    if several:
        band = {"x": numbers([*curve.steps, *curve.steps[::-1]]), "y": numbers([*curve.high, *curve.low[::-1]])}
        fill = {"fill": "toself", "fillcolor": _faint(colour), "line": {"width": 0}, "hoverinfo": "skip"}
        yield {**group, **band, **fill, "name": label, "showlegend": False, "meta": own}
        for member, xy in curve.members:
            line = {"color": colour, "width": 1}
            name = {"name": f"{label}, {_name(member)}", "showlegend": False, "opacity": 0.5}
            meta = {"member": member_id(member)}
            yield {**group, **name, "x": numbers(xy[0]), "y": numbers(xy[1]), "line": line, "meta": meta}
    line = {"color": colour, "width": 3}
    mean = {"x": numbers(curve.steps), "y": numbers(curve.mean), "line": line, "name": label, "meta": own}
    yield {**group, **mean, "mode": "lines+markers"}
    for member, xy in curve.members:
        if member.frozen:
            yield _dot(member, float(xy[0][-1]), float(xy[1][-1]), colour, 12) | {"name": f"{label}, {_name(member)}"}


def _first_goal(study: Study) -> Section:
    colours = colours_of(study)
    figures = []
    for task in study.tasks:
        members = [(s, m) for s in study.settings for m in s.members.get(task, [])]
        if all(math.isnan(member.first_goal) for _, member in members):
            continue
        data = []
        for setting, member in members:
            end = max((float(row["env_steps"] or 0) for row in member.rows), default=0.0)
            if not math.isnan(member.first_goal):
                data.append(_dot(member, member.first_goal, setting.label, colours[setting.label], 11))
            elif end:  # nothing is played online by what only learns offline
                dot = _dot(member, end, setting.label, colours[setting.label], 11)
                dot["marker"] |= {"symbol": "triangle-right-open", "line": {"width": 2}}
                data.append(dot | {"name": f"{_name(member)}: not reached by then"})
        layout = axes("environment steps", "")
        names = [setting.label for setting in study.settings if task in setting.members]
        layout["yaxis"] |= _rows(names)
        layout["xaxis"] |= {"rangemode": "tozero"}
        figures.append(Figure(_titled(study, "every member", task), data, layout, height=_height(len(names))))
    text = "One dot per member; an open triangle, where its training ended, for one that never reached the goal."
    return Section("Steps to the first goal", text, figures=figures)


def _scan(study: Study) -> Section:
    figures = []
    for scan in scans(study):
        layout = axes(short(scan.key), "success", share=True)
        names = positions(scan.lines[0], scan)[1]
        every = sorted({value for line in scan.lines for value in line.values}) if names is None else []
        if scan.wide:
            layout["xaxis"] |= logarithmic(every)
        if names is not None:
            layout["xaxis"] |= {"tickvals": list(range(len(names))), "ticktext": names}
        elif len(every) <= TICKS:
            layout["xaxis"] |= {"tickvals": every, "ticktext": [plain(value) for value in every]}
        title = _titled(study, f"success over {short(scan.key)}", scan.task)
        figures.append(Figure(title, list(_scan_traces(scan)), layout))
    figures += [_surface(study, surface) for surface in surfaces(study)]
    text = (
        "Success at the last evaluation. Line: mean over seeds with its 95 % bootstrap interval; dots: members. "
        "Without a line: other things were varied with it."
    )
    return Section("What was varied", text, figures=figures)


def _scan_traces(scan: Scan) -> Iterable[Trace]:
    for i, line in enumerate(scan.lines):
        colour, (x, _) = PALETTE[i % len(PALETTE)], positions(line, scan)
        if line.joined:
            errors = {"type": "data", "symmetric": False, "thickness": 1.5}
            errors |= {"array": numbers(line.high - line.mean), "arrayminus": numbers(line.mean - line.low)}
            yield {
                "x": x,
                "y": numbers(line.mean),
                "error_y": errors,
                "mode": "lines+markers",
                "line": {"color": colour, "width": 2},
                "name": line.label,
            }
        for at, members in zip(x, line.members, strict=True):
            for member in members:
                yield _dot(member, at, member.success, colour)


def _surface(study: Study, surface: Surface) -> Figure:
    heat = {
        "type": "heatmap",
        "x": [plain(value) for value in surface.x],
        "y": [plain(value) for value in surface.y],
        "z": [numbers(row) for row in surface.mean],
        "zmin": 0,
        "zmax": 1,
        "colorscale": "Viridis",
        "texttemplate": "%{z:.0%}",
        "colorbar": {"thickness": 10, "outlinewidth": 0, "tickformat": ".0%"},
        "hovertemplate": "%{x}, %{y}: %{z:.1%}<extra></extra>",
        "name": surface.method,
    }
    first, second = map(short, surface.keys)
    layout = axes(first, second)
    for axis in ("xaxis", "yaxis"):
        layout[axis] |= {"type": "category"}
    title = _titled(study, f"mean success over {first} and {second}, {surface.method}", surface.task)
    return Figure(title, [heat], layout)


def _wall_time(study: Study) -> Section:
    names = [_run_name(study, i) for i in range(len(study.runs))]
    # The longest bar says in which unit.
    longest = max(float(run.summary["wall_seconds"].get("total", 0.0)) for run in study.runs)
    unit, seconds = ("hours", 3600) if longest > 5400 else ("minutes", 60) if longest > 90 else ("seconds", 1)
    data = [
        {
            "type": "bar",
            "orientation": "h",
            "y": names,
            "x": [round(float(run.summary["wall_seconds"].get(part, 0.0)) / seconds, 3) for run in study.runs],
            "name": part,
            "marker": {"color": colour},
            "hovertemplate": f"%{{x:.3~g}} {unit}<extra>%{{fullData.name}}</extra>",
        }
        for part, colour in zip(PHASES, PALETTE, strict=False)
    ]
    layout = axes(unit, "") | {"barmode": "stack"}
    layout["yaxis"] |= {"type": "category", "autorange": "reversed"}
    figures = [Figure("", data, layout, height=_height(len(names)) + 30)]
    return Section("Wall time by phase", "Per run folder, all of its members together.", figures=figures)


def _diagnostics(study: Study) -> Section:
    """Every other column of metrics.csv, over the updates of its phase."""
    colours = colours_of(study)
    columns: dict[tuple[str, str, str], None] = {}
    everyone = [
        (setting, member) for setting in study.settings for group in setting.members.values() for member in group
    ]
    for _, member in everyone:
        for row in member.rows:
            for name, cell in row.items():
                if cell and name not in _NOT_MEASURES and "." not in name and name not in ("alpha", "eval/success"):
                    columns[member.task, row["phase"], name] = None
    inner: dict[tuple[str, str], list[Figure]] = {}
    for task, phase, name in columns:
        data = [_measure(s, m, phase, name, colours[s.label]) for s, m in everyone if m.task == task]
        data = [trace for trace in data if trace["x"]]
        inner.setdefault((task, phase), []).append(Figure(name, data, axes("updates", name), height=280))
    parts = [
        Section(_titled(study, f"{phase}: {', '.join(figure.title for figure in figures)}", task), figures=figures)
        for (task, phase), figures in inner.items()
    ]
    return Section("Losses and other measures", "One line per member, by phase.", inner=parts)


def _measure(setting: Setting, member: Member, phase: str, name: str, colour: str) -> Trace:
    rows = [row for row in member.rows if row["phase"] == phase and row.get(name)]
    return {
        "x": [float(row["update"] or i) for i, row in enumerate(rows)],
        "y": numbers([float(row[name]) for row in rows]),
        "mode": "lines",
        "line": {"color": colour, "width": 1.5},
        "name": f"{setting.label}, {_name(member)}",
        "showlegend": False,
        "meta": {"member": member_id(member)},
    }


def _provenance(study: Study) -> Section:
    listings = []
    rows = []
    for i, run in enumerate(study.runs):
        name = _run_name(study, i)
        data = run.provenance.get("dataset", {})
        packages = run.provenance.get("packages", {})
        total = duration(float(run.summary["wall_seconds"].get("total", 0.0)))
        facts = [run.config.preset, run.config.physics, data.get("sha256", "")[:12], packages.get("jax", ""), total]
        rows.append([name, str(run.path), *(fact or "-" for fact in facts)])
        listings.append((f"{name}: config.yaml", to_yaml(run.config)))
        if run.provenance:
            listings.append((f"{name}: command, data, versions", _made_from(run)))
    header = ["run", "folder", "preset", "physics", "data (SHA-256)", "jax", "wall time"]
    return Section("Configuration and provenance", tables=[Table("", header, rows, words=7)], listings=listings)


def _made_from(run: Run) -> str:
    data, packages = (run.provenance.get(key, {}) for key in ("dataset", "packages"))
    lines = [f"command   {' '.join(run.provenance.get('command', []))}", f"data      {data.get('path', '')}"]
    lines += [f"SHA-256   {data.get('sha256', '')}", f"python    {run.provenance.get('python', '')}"]
    return "\n".join([*lines, *(f"{package} {version}" for package, version in packages.items())])


def _run_name(study: Study, index: int) -> str:
    """Method and task, numbered where several runs share them."""
    names = [
        f"{run.config.method}, {run.config.env}" if len(study.tasks) > 1 else run.config.method for run in study.runs
    ]
    name = names[index]
    return name if names.count(name) == 1 else f"{name} ({names[: index + 1].count(name)})"


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.18)"
