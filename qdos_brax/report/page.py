"""report.html: one file that holds everything it shows and loads nothing from the network."""

from __future__ import annotations

import importlib.resources
import json
from pathlib import Path
from typing import Any

import jinja2

from qdos_brax.files import write_text
from qdos_brax.report.curves import setting_colours
from qdos_brax.report.elements import Section, describe, member_id
from qdos_brax.report.member_analysis import MemberAnalysis
from qdos_brax.report.sections import sections
from qdos_brax.report.study import Study

_PASSED_ON = ("title", "text", "cards", "choices", "tables", "films", "images", "listings", "expanded")


def write_page(study: Study, analyses: list[MemberAnalysis], out: Path) -> None:
    """Write the page.

    Args:
        study: what was run.
        analyses: what was found inside its runs.
        out: the file; its folder must exist.

    Raises:
        UserError: the file cannot be written.
    """
    figures: list[dict[str, Any]] = []
    parts = [_part(section, figures) for section in sections(study, analyses)]
    template = _environment().get_template("page.html")
    page = template.render(
        title=", ".join(study.tasks),
        subtitle=_subtitle(study),
        notes=study.notes,
        filter=_filter(study),
        sections=parts,
        figures_json=_json(figures),
        plotly_js=_plotly_js(),
    )
    write_text(out, page)


def _part(section: Section, figures: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a section for the template; its charts are added to ``figures``, and the template knows their index."""
    shown = []
    for figure in section.figures:
        own = {"title": figure.title, "description": describe(figure), "height": figure.height}
        shown.append(own | {"id": len(figures)})
        figures.append({"data": figure.data, "layout": figure.layout, "choices": figure.choices})
    passed_on = {name: getattr(section, name) for name in _PASSED_ON}
    return passed_on | {"figures": shown, "subsections": [_part(part, figures) for part in section.subsections]}


def _subtitle(study: Study) -> str:
    counts = {
        "method": len({setting.method for setting in study.settings}),
        "setting": len(study.settings),
        "member": sum(len(run.members) for run in study.runs),
        "run": len(study.runs),
    }
    return ", ".join(f"{count} {name}" + ("" if count == 1 else "s") for name, count in counts.items())


def _plotly_js() -> str:
    """Return the script of the plotly package (as ``plotly.offline.get_plotlyjs``, whose import takes long)."""
    file = importlib.resources.files("plotly") / "package_data" / "plotly.min.js"
    return file.read_text(encoding="utf-8")


def _filter(study: Study) -> list[dict[str, Any]]:
    colours = setting_colours(study)
    several = len(study.tasks) > 1
    return [
        {
            "label": setting.label,
            "colour": colours[setting.label],
            "members": [
                {
                    "id": member_id(member),
                    "name": f"seed {member.seed}" + (f", {member.task}" if several else ""),
                    "frozen": member.frozen,
                }
                for members in setting.members.values()
                for member in members
            ],
        }
        for setting in study.settings
    ]


def _json(content: Any) -> str:
    """Return JSON for a script element: nothing in it ends the element or opens a comment."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=False,
    )
