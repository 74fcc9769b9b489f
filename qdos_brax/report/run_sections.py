"""The sections of the page on the runs themselves: wall time, losses and other measures, configuration, provenance."""

from __future__ import annotations

from collections.abc import Iterator

from qdos_brax.config import to_yaml
from qdos_brax.config.schema import labelled
from qdos_brax.report.curves import setting_colours
from qdos_brax.report.elements import (
    PALETTE,
    Figure,
    Section,
    Trace,
    axis_layout,
    height_of_rows,
    json_numbers,
    member_id,
    member_name,
    title_with_task,
)
from qdos_brax.report.study import Member, Run, Setting, Study
from qdos_brax.report.summary_cards import PHASES, format_duration
from qdos_brax.report.tables import Table

# Columns of metrics.csv that say where a row belongs, or that other sections show.
_NOT_MEASURES = {
    "member", "seed", *labelled(), "phase", "env_steps", "update", "status_ok", "first_goal_step", "eval/success",
}  # fmt: skip


def wall_time_section(study: Study) -> Section:
    """Return a stacked bar per run: the seconds of each phase, in the unit that suits the longest run."""
    names = [_run_name(study, i) for i in range(len(study.runs))]
    longest = max(_total_seconds(run) for run in study.runs)
    unit, seconds = ("hours", 3600) if longest > 5400 else ("minutes", 60) if longest > 90 else ("seconds", 1)
    data = [
        {
            "type": "bar",
            "orientation": "h",
            "y": names,
            "x": [round(float(run.summary["wall_seconds"].get(phase, 0.0)) / seconds, 3) for run in study.runs],
            "name": phase,
            "marker": {"color": colour},
            "hovertemplate": f"%{{x:.3~g}} {unit}<extra>%{{fullData.name}}</extra>",
        }
        for phase, colour in zip(PHASES, PALETTE, strict=False)
    ]
    layout = axis_layout(unit, "") | {"barmode": "stack"}
    layout["yaxis"] |= {"type": "category", "autorange": "reversed"}
    figures = [Figure("", data, layout, height=height_of_rows(len(names)) + 30)]
    return Section("Wall time by phase", "One bar per run folder, for all of its members together.", figures=figures)


def diagnostics_section(study: Study) -> Section:
    """Return a chart for each remaining column of metrics.csv, over the updates of its phase."""
    colours = setting_colours(study)
    everyone = [(setting, m) for setting in study.settings for group in setting.members.values() for m in group]
    charts: dict[tuple[str, str], list[Figure]] = {}
    for task, phase, name in dict.fromkeys(column for _, member in everyone for column in _measures(member)):
        data = [_line(s, m, phase, name, colours[s.label]) for s, m in everyone if m.task == task]
        data = [trace for trace in data if trace["x"]]
        charts.setdefault((task, phase), []).append(Figure(name, data, axis_layout("updates", name), height=280))
    parts = [
        Section(
            title_with_task(study, f"{phase}: {', '.join(figure.title for figure in figures)}", task), figures=figures
        )
        for (task, phase), figures in charts.items()
    ]
    return Section("Losses and other measures", "One line per member, by phase.", subsections=parts)


def provenance_section(study: Study) -> Section:
    """Return a table of the runs, with the configuration and provenance of each folded away below it."""
    listings, rows = [], []
    for i, run in enumerate(study.runs):
        name = _run_name(study, i)
        rows.append([name, *_facts(run)])
        listings.append((f"{name}: config.yaml", to_yaml(run.config)))
        if run.provenance:
            listings.append((f"{name}: command, data, versions", _provenance(run)))
    header = ["run", "folder", "preset", "physics", "data (SHA-256)", "jax", "wall time"]
    return Section("Configuration and provenance", tables=[Table("", header, rows, words=7)], listings=listings)


def _total_seconds(run: Run) -> float:
    return float(run.summary["wall_seconds"].get("total", 0.0))


def _measures(member: Member) -> Iterator[tuple[str, str, str]]:
    """Yield (task, phase, column) of each measure that a member has; dotted columns are its hyperparameters."""
    for row in member.rows:
        for name, cell in row.items():
            if cell and name not in _NOT_MEASURES and "." not in name:
                yield member.task, row["phase"], name


def _line(setting: Setting, member: Member, phase: str, name: str, colour: str) -> Trace:
    rows = [row for row in member.rows if row["phase"] == phase and row.get(name)]
    return {
        "x": [float(row["update"] or i) for i, row in enumerate(rows)],
        "y": json_numbers([float(row[name]) for row in rows]),
        "mode": "lines" if len(rows) > 1 else "markers",  # a line of one point cannot be seen
        "line": {"color": colour, "width": 1.5},
        "marker": {"color": colour, "size": 8},
        "name": f"{setting.label}, {member_name(member)}",
        "showlegend": False,
        "meta": {"member": member_id(member)},
    }


def _facts(run: Run) -> list[str]:
    """Return the cells of a run in the table; "-" for what is not known."""
    data, packages = (run.provenance.get(key, {}) for key in ("dataset", "packages"))
    known = [run.config.preset, run.config.physics, data.get("sha256", "")[:12], packages.get("jax", "")]
    return [str(run.path), *(fact or "-" for fact in known), format_duration(_total_seconds(run))]


def _provenance(run: Run) -> str:
    data, packages = (run.provenance.get(key, {}) for key in ("dataset", "packages"))
    lines = [f"command   {' '.join(run.provenance.get('command', []))}", f"data      {data.get('path', '')}"]
    lines += [f"SHA-256   {data.get('sha256', '')}", f"python    {run.provenance.get('python', '')}"]
    return "\n".join([*lines, *(f"{package} {version}" for package, version in packages.items())])


def _run_name(study: Study, index: int) -> str:
    """Return method and task of a run, numbered where several runs share them."""
    several = len(study.tasks) > 1
    names = [f"{run.config.method}, {run.config.env}" if several else run.config.method for run in study.runs]
    name = names[index]
    return name if names.count(name) == 1 else f"{name} ({names[: index + 1].count(name)})"
