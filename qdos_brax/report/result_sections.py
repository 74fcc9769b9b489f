"""The sections of the page on how well the members did: summary, learning curves, scans, steps to the first goal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from qdos_brax.config.schema import format_value
from qdos_brax.report.curves import MEASURES, SHARES, TICKS, WORDS, axis_positions, setting_colours
from qdos_brax.report.elements import (
    PALETTE,
    Figure,
    Section,
    Trace,
    axis_layout,
    height_of_rows,
    json_numbers,
    log_axis,
    member_dot,
    member_id,
    member_name,
    name_axis,
    title_with_task,
)
from qdos_brax.report.series import Curve, Scan, Surface, curves, scans, surfaces
from qdos_brax.report.settings import short_key
from qdos_brax.report.statistics import mean_curve
from qdos_brax.report.study import Member, Setting, Study, final_results, headline
from qdos_brax.report.summary_cards import rank_settings, summary_cards

# --- Summary ---------------------------------------------------------------------------------------------------


def summary_section(study: Study) -> Section:
    """Return the answers in short, and a chart per task of the final success of each setting, the best on top."""
    figures = [
        _success_chart(study, task, order) for task in study.tasks for order in [rank_settings(study, task)] if order
    ]
    text = "Diamond: the mean over seeds. Bar: its 95 % bootstrap interval. Dots: the members." if figures else ""
    return Section("Summary", text, summary_cards(study), figures)


def _success_chart(study: Study, task: str, order: list[tuple[Setting, list[float]]]) -> Figure:
    colours, measure = setting_colours(study), headline(study, task)
    shown = [_mean_and_members(setting, task, measure, colours[setting.label]) for setting, _ in order]
    data = [trace for traces in shown for trace in traces]
    layout = axis_layout(f"{measure} at the last evaluation", "")
    layout["xaxis"] |= {"range": [-0.03, 1.03], "tickformat": ".0%"}
    layout["yaxis"] |= name_axis(setting.label for setting, _ in order)
    return Figure(title_with_task(study, "every setting", task), data, layout, height=height_of_rows(len(order)))


def _mean_and_members(setting: Setting, task: str, measure: str, colour: str) -> Iterable[Trace]:
    """Yield a setting's mean with its interval, and its members."""
    members = [member for member in setting.members[task] if not math.isnan(getattr(member, measure))]
    results = np.asarray(final_results(members, measure))
    mean, low, high = (float(x[0]) for x in mean_curve(results[:, None]))
    errors = {"type": "data", "symmetric": False, "thickness": 5, "width": 0}
    errors |= {"array": json_numbers([high - mean]), "arrayminus": json_numbers([mean - low])}
    yield {
        "x": json_numbers([mean]),
        "y": [setting.label],
        "error_x": errors,
        "mode": "markers",
        "marker": {"color": colour, "size": 12, "symbol": "diamond"},
        "name": f"{setting.label}, mean",
        "showlegend": False,
        "meta": {"setting": setting.label},
    }
    for member, result in zip(members, results, strict=True):
        yield member_dot(member, float(result), setting.label, colour)


# --- Learning curves -------------------------------------------------------------------------------------------


def learning_section(study: Study) -> Section:
    """Return a chart per task and measure: success, score and return over the environment steps."""
    colours = setting_colours(study)
    figures = [
        Figure(
            title_with_task(study, name, task),
            [trace for curve in drawn for trace in _curve(curve, colours[curve.setting.label])]
            + _published(study, task, name, drawn),
            axis_layout("environment steps", WORDS.get(name, name), share=name in SHARES),
        )
        for task in study.tasks
        for column, name in MEASURES
        for drawn in [curves(study, task, column)]
        if drawn
    ]
    text = (
        "Thick line: the mean over a setting's members; band: its 95 % bootstrap interval; thin lines: the members. "
        "Dashed: methods that only learn offline. Dotted: what others published, in settings of their own. Cross: the "
        "member was frozen there, because its numbers were no longer finite."
    )
    return Section("Learning curves", text, figures=figures)


def _curve(curve: Curve, colour: str) -> Iterable[Trace]:
    if curve.offline:
        yield _level(curve, colour)
        return
    if len(curve.members) > 1:
        yield _band(curve, colour)
        yield from _member_lines(curve, colour)
    label = curve.setting.label
    style = {"line": {"color": colour, "width": 3}, "meta": {"setting": label}, "mode": "lines+markers"}
    yield {
        "x": json_numbers(curve.steps), "y": json_numbers(curve.mean), "name": label, "legendgroup": label, **style
    }  # fmt: skip
    for member, (x, y) in curve.members:
        if member.frozen:
            name = {"name": f"{label}, {member_name(member)}"}
            yield member_dot(member, float(x[-1]), float(y[-1]), colour, size=12) | name


def _published(study: Study, task: str, measure: str, drawn: Sequence[Curve]) -> list[Trace]:
    """Return dotted grey lines at what others published, over the steps of the curves."""
    end = max((float(curve.steps[-1]) for curve in drawn if len(curve.steps)), default=1.0)
    line = {"mode": "lines", "line": {"color": "#7a7a7a", "dash": "dot", "width": 1}}
    return [
        {"x": [0, end], "y": json_numbers([row.result] * 2), "name": f"{row.label} ({row.source})", **line}
        for row in study.published
        if (row.task, row.measure) == (task, measure)
    ]


def _level(curve: Curve, colour: str) -> Trace:
    """Return a dashed line at the success of a method that only learned offline, over the steps of the others."""
    label = curve.setting.label
    end = max((float(member.values["high_level.env_steps"]) for member, _ in curve.members), default=1.0)
    style = {"mode": "lines", "line": {"color": colour, "dash": "dash"}, "meta": {"setting": label}}
    return {"x": [0, end], "y": json_numbers([curve.mean[-1]] * 2), "name": label, "legendgroup": label, **style}


def _band(curve: Curve, colour: str) -> Trace:
    label = curve.setting.label
    x, y = [*curve.steps, *curve.steps[::-1]], [*curve.high, *curve.low[::-1]]
    fill = {"fill": "toself", "fillcolor": _faint(colour), "line": {"width": 0}, "hoverinfo": "skip", "mode": "lines"}
    group = {"name": label, "legendgroup": label, "showlegend": False, "meta": {"setting": label}}
    return {"x": json_numbers(x), "y": json_numbers(y), **fill, **group}


def _member_lines(curve: Curve, colour: str) -> Iterable[Trace]:
    label = curve.setting.label
    style = {"mode": "lines", "line": {"color": colour, "width": 1}, "opacity": 0.5}
    for member, (x, y) in curve.members:
        name = {"name": f"{label}, {member_name(member)}", "legendgroup": label, "showlegend": False}
        yield {"x": json_numbers(x), "y": json_numbers(y), **style, **name, "meta": {"member": member_id(member)}}


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.18)"


# --- Steps to the first goal -----------------------------------------------------------------------------------


def first_goal_section(study: Study) -> Section:
    """Return a chart per task of when each member first reached the goal; none for tasks that nobody reached it on."""
    figures = [_first_goal_chart(study, task) for task in study.tasks if _any_reached(study, task)]
    text = "One dot per member. Open triangle: the member never reached the goal; it stands where its training ended."
    return Section("Steps to the first goal", text, figures=figures)


def _any_reached(study: Study, task: str) -> bool:
    members = [member for setting in study.settings for member in setting.members.get(task, [])]
    return any(not math.isnan(member.first_goal) for member in members)


def _first_goal_chart(study: Study, task: str) -> Figure:
    colours = setting_colours(study)
    settings = [setting for setting in study.settings if task in setting.members]
    dots = [_first_goal_dot(s, member, colours[s.label]) for s in settings for member in s.members[task]]
    layout = axis_layout("environment steps", "")
    layout["yaxis"] |= name_axis(setting.label for setting in settings)
    layout["xaxis"] |= {"rangemode": "tozero"}
    data, title = [dot for dot in dots if dot], title_with_task(study, "every member", task)
    return Figure(title, data, layout, height=height_of_rows(len(settings)))


def _first_goal_dot(setting: Setting, member: Member, colour: str) -> Trace | None:
    """Return a member's mark; None if it took no environment steps, because it only learned offline."""
    if not math.isnan(member.first_goal):
        return member_dot(member, member.first_goal, setting.label, colour, size=11)
    end = max((float(row["env_steps"] or 0) for row in member.rows), default=0.0)
    if not end:
        return None
    dot = member_dot(member, end, setting.label, colour, size=11)
    dot["marker"] |= {"symbol": "triangle-right-open", "line": {"width": 2}}
    return dot | {"name": f"{member_name(member)}: not reached by then"}


# --- Scans -----------------------------------------------------------------------------------------------------


def scan_section(study: Study) -> Section:
    """Return a chart for each hyperparameter that was varied, and one for each pair in all combinations."""
    figures = [_scan_chart(study, scan) for scan in scans(study)]
    figures += [_surface_chart(study, surface) for surface in surfaces(study)]
    text = (
        "At the last evaluation. Line: the mean over seeds, with its 95 % bootstrap interval; dots: the "
        "members. There is no line where other hyperparameters were varied together with this one."
    )
    return Section("Varied hyperparameters", text, figures=figures)


def _scan_chart(study: Study, scan: Scan) -> Figure:
    layout = axis_layout(short_key(scan.key), WORDS.get(scan.measure, scan.measure), share=True)
    names = axis_positions(scan.lines[0], scan)[1]
    every = sorted({value for line in scan.lines for value in line.values}) if names is None else []
    if scan.log_scale:
        layout["xaxis"] |= log_axis(every)
    if names is not None:
        layout["xaxis"] |= {"tickvals": list(range(len(names))), "ticktext": names}
    elif len(every) <= TICKS:
        layout["xaxis"] |= {"tickvals": every, "ticktext": [format_value(value) for value in every]}
    title = title_with_task(study, f"{scan.measure} over {short_key(scan.key)}", scan.task)
    return Figure(title, list(_scan_traces(scan)), layout)


def _scan_traces(scan: Scan) -> Iterable[Trace]:
    for i, line in enumerate(scan.lines):
        colour, (x, _) = PALETTE[i % len(PALETTE)], axis_positions(line, scan)
        if line.joined:
            errors = {"type": "data", "symmetric": False, "thickness": 1.5}
            errors |= {"array": json_numbers(line.high - line.mean), "arrayminus": json_numbers(line.mean - line.low)}
            yield {
                "x": x,
                "y": json_numbers(line.mean),
                "error_y": errors,
                "mode": "lines+markers",
                "line": {"color": colour, "width": 2},
                "name": line.label,
            }
        for at, members in zip(x, line.members, strict=True):
            for member in members:
                yield member_dot(member, at, getattr(member, scan.measure), colour)


def _surface_chart(study: Study, surface: Surface) -> Figure:
    heat = {
        "type": "heatmap",
        "x": [format_value(value) for value in surface.x],
        "y": [format_value(value) for value in surface.y],
        "z": [json_numbers(row) for row in surface.mean],
        "zmin": 0,
        "zmax": 1,
        "colorscale": "Viridis",
        "texttemplate": "%{z:.0%}",
        "colorbar": {"thickness": 10, "outlinewidth": 0, "tickformat": ".0%"},
        "hovertemplate": "%{x}, %{y}: %{z:.1%}<extra></extra>",
        "name": surface.method,
    }
    first, second = map(short_key, surface.keys)
    layout = axis_layout(first, second)
    for axis in ("xaxis", "yaxis"):
        layout[axis] |= {"type": "category"}
    title = title_with_task(study, f"mean {surface.measure} over {first} and {second}, {surface.method}", surface.task)
    return Figure(title, [heat], layout)
