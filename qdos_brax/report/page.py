"""report.html: one file that holds everything it shows, and asks no network for anything."""

from __future__ import annotations

import importlib.resources
import json
from pathlib import Path
from typing import Any

import jinja2

from qdos_brax.report.curves import colours_of
from qdos_brax.report.parts import member_id
from qdos_brax.report.sections import sections
from qdos_brax.report.study import Study
from qdos_brax.runs.folder import write_text


def write_page(study: Study, out: Path) -> None:
    """Writes the page.

    Args:
        study: what was run.
        out: the file; its folder must exist.

    Raises:
        UserError: it cannot be written.
    """
    figures: list[dict[str, Any]] = []
    parts = []
    for section in sections(study):
        shown = []
        for figure in section.figures:
            shown.append({"title": figure.title, "id": len(figures)})
            figures.append({"data": figure.data, "layout": figure.layout})
        parts.append(
            {
                "title": section.title,
                "text": section.text,
                "tables": section.tables,
                "figures": shown,
                "images": section.images,
                "listings": section.listings,
                "folded": section.folded,
            }
        )
    members = sum(len(run.members) for run in study.runs)
    template = _environment().get_template("page.html")
    page = template.render(
        title=", ".join(study.tasks),
        subtitle=f"{members} members, {len(study.settings)} settings, {len(study.runs)} runs",
        filter=_filter(study),
        sections=parts,
        figures_json=_json(figures),
        plotly_js=_plotly_js(),
    )
    write_text(out, page)


def _plotly_js() -> str:
    """The script that the plotly package ships (what ``plotly.offline.get_plotlyjs`` returns, without its import)."""
    file = importlib.resources.files("plotly") / "package_data" / "plotly.min.js"
    return file.read_text(encoding="utf-8")


def _filter(study: Study) -> list[dict[str, Any]]:
    colours = colours_of(study)
    several = len(study.tasks) > 1
    return [
        {
            "label": setting.label,
            "colour": colours[setting.label],
            "members": [
                {"id": member_id(member), "name": f"seed {member.seed}" + (f", {member.task}" if several else "")}
                for members in setting.members.values()
                for member in members
            ],
        }
        for setting in study.settings
    ]


def _json(content: Any) -> str:
    """JSON that can stand in a script element: nothing in it ends the element or opens a comment."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=False,
    )
