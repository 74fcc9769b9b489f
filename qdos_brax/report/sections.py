"""The parts of the page that need nothing but the run folders' text files: data in, figures out."""

from __future__ import annotations

import math
from collections.abc import Iterable

from qdos_brax.config import to_yaml
from qdos_brax.report.curves import MEASURES, colours_of, positions
from qdos_brax.report.inside_sections import inside_sections
from qdos_brax.report.parts import PALETTE, Figure, Section, Trace, axes, member_id, numbers
from qdos_brax.report.series import Curve, Scan, curves, scans
from qdos_brax.report.study import Member, Setting, Study, short
from qdos_brax.report.tables import Table, tables

_PARTS = ("data", "pretrain", "label", "online", "eval")
_NOT_MEASURES = {"member", "seed", "phase", "env_steps", "update", "status_ok", "first_goal_step"}


def sections(study: Study) -> list[Section]:
    """Everything there is something to show of, in the order of the page."""
    made = (_results(study), _learning(study), _first_goal(study), _scan(study), _wall_time(study), _diagnostics(study))
    shown = [section for section in made if section.figures or section.tables]
    return [*shown[:-1], *inside_sections(study), *shown[-1:], _provenance(study)]


def _results(study: Study) -> Section:
    return Section("Results", "\n".join(study.notes), tables=tables(study))


def _learning(study: Study) -> Section:
    colours = colours_of(study)
    figures = [
        Figure(
            f"{name}, {task}",
            [trace for curve in drawn for trace in _curve(curve, colours[curve.setting.label])],
            axes("environment steps", name, share=name == "success"),
        )
        for task in study.tasks
        for column, name in MEASURES
        for drawn in [curves(study, task, column)]
        if drawn
    ]
    text = "Thick: mean over a setting's members, with its 95 % bootstrap interval; thin: each member. Dashed: offline."
    return Section("Learning curves", text, figures)


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
            name = {"name": f"{label}, seed {member.seed}", "showlegend": False, "opacity": 0.5}
            meta = {"member": member_id(member)}
            yield {**group, **name, "x": numbers(xy[0]), "y": numbers(xy[1]), "line": line, "meta": meta}
    line = {"color": colour, "width": 3}
    mean = {"x": numbers(curve.steps), "y": numbers(curve.mean), "line": line, "name": label, "meta": own}
    yield {**group, **mean, "mode": "lines+markers"}


def _first_goal(study: Study) -> Section:
    colours = colours_of(study)
    figures = []
    for task in study.tasks:
        members = [(s, m) for s in study.settings for m in s.members.get(task, []) if not math.isnan(m.first_goal)]
        data = [
            {
                "x": [member.first_goal],
                "y": [setting.label],
                "mode": "markers",
                "marker": {"color": colours[setting.label], "size": 11, "opacity": 0.75},
                "name": f"seed {member.seed}",
                "showlegend": False,
                "meta": {"member": member_id(member)},
            }
            for setting, member in members
        ]
        if data:
            layout = axes("environment steps", "")
            names = [setting.label for setting in study.settings if task in setting.members]
            layout["yaxis"] |= {"type": "category", "categoryarray": names[::-1], "categoryorder": "array"}
            layout["xaxis"] |= {"rangemode": "tozero"}
            figures.append(Figure(task, data, layout))
    return Section("Steps to the first goal", "One dot per member; members that never reached it have none.", figures)


def _scan(study: Study) -> Section:
    figures = []
    for scan in scans(study):
        layout = axes(short(scan.key), "success", share=True)
        names = positions(scan.lines[0], scan)[1]
        if names is not None:
            layout["xaxis"] |= {"tickvals": list(range(len(names))), "ticktext": names}
        title = f"success over {short(scan.key)}, {scan.task}"
        figures.append(Figure(title, list(_scan_traces(scan)), layout))
    text = "Success at the last evaluation. Line: mean over seeds with its 95 % bootstrap interval; dots: members."
    return Section("What was varied", text, figures)


def _scan_traces(scan: Scan) -> Iterable[Trace]:
    for i, line in enumerate(scan.lines):
        colour, (x, _) = PALETTE[i % len(PALETTE)], positions(line, scan)
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
                yield {
                    "x": [at],
                    "y": [member.success],
                    "mode": "markers",
                    "marker": {"color": colour, "opacity": 0.45, "size": 8},
                    "name": f"seed {member.seed}",
                    "showlegend": False,
                    "meta": {"member": member_id(member)},
                }


def _wall_time(study: Study) -> Section:
    names = [_run_name(study, i) for i in range(len(study.runs))]
    data = [
        {
            "type": "bar",
            "orientation": "h",
            "y": names,
            "x": [round(float(run.summary["wall_seconds"].get(part, 0.0)) / 60, 3) for run in study.runs],
            "name": part,
            "marker": {"color": colour},
            "hovertemplate": "%{x:.1f} minutes<extra>%{fullData.name}</extra>",
        }
        for part, colour in zip(_PARTS, PALETTE, strict=False)
    ]
    layout = axes("minutes", "") | {"barmode": "stack"}
    layout["yaxis"] |= {"type": "category", "autorange": "reversed"}
    return Section("Wall time by phase", "Per run folder, all of its members together.", [Figure("", data, layout)])


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
    figures = []
    for task, phase, name in columns:
        data = [_measure(s, m, phase, name, colours[s.label]) for s, m in everyone if m.task == task]
        data = [trace for trace in data if trace["x"]]
        title = f"{phase}: {name}" + (f", {task}" if len(study.tasks) > 1 else "")
        figures.append(Figure(title, data, axes("updates", name)))
    return Section("Losses and other measures", "One line per member.", figures, folded=True)


def _measure(setting: Setting, member: Member, phase: str, name: str, colour: str) -> Trace:
    rows = [row for row in member.rows if row["phase"] == phase and row.get(name)]
    return {
        "x": [float(row["update"] or i) for i, row in enumerate(rows)],
        "y": numbers([float(row[name]) for row in rows]),
        "mode": "lines",
        "line": {"color": colour, "width": 1.5},
        "name": f"{setting.label}, seed {member.seed}",
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
        facts = [run.config.preset, run.config.physics, data.get("sha256", "")[:12], packages.get("jax", "")]
        rows.append([name, str(run.path), *(fact or "-" for fact in facts)])
        listings.append((f"{name}: config.yaml", to_yaml(run.config)))
        if run.provenance:
            command = " ".join(run.provenance.get("command", []))
            lines = [f"command   {command}", f"data      {data.get('path', '')}", f"SHA-256   {data.get('sha256', '')}"]
            lines += [f"python    {run.provenance.get('python', '')}"]
            lines += [f"{package} {version}" for package, version in packages.items()]
            listings.append((f"{name}: made from", "\n".join(lines)))
    header = ["run", "folder", "preset", "physics", "data (SHA-256)", "jax"]
    return Section("Configuration and provenance", tables=[Table("", header, rows, words=6)], listings=listings)


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
