"""report.html: one file that holds everything it shows, and asks no network for anything."""

from __future__ import annotations

import importlib.resources
import json
from pathlib import Path
from typing import Any

import jinja2

from qdos_brax.files import write_text
from qdos_brax.report.curves import colours_of
from qdos_brax.report.looks import Look
from qdos_brax.report.parts import Section, member_id
from qdos_brax.report.sections import sections
from qdos_brax.report.study import Study

_SHOWN_AS_THEY_ARE = ("title", "text", "cards", "choices", "tables", "images", "listings", "opened")


def write_page(study: Study, looks: list[Look], out: Path) -> None:
    """Writes the page.

    Args:
        study: what was run.
        looks: what was seen inside its runs.
        out: the file; its folder must exist.

    Raises:
        UserError: it cannot be written.
    """
    figures: list[dict[str, Any]] = []
    parts = [_part(section, figures) for section in sections(study, looks)]
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
    """A section for the template, which knows charts by their place in ``figures``; they are added there."""
    shown = []
    for figure in section.figures:
        shown.append({"title": figure.title, "id": len(figures), "height": figure.height})
        figures.append({"data": figure.data, "layout": figure.layout, "choices": figure.choices})
    own = {name: getattr(section, name) for name in _SHOWN_AS_THEY_ARE}
    return own | {"figures": shown, "inner": [_part(inner, figures) for inner in section.inner]}


def _subtitle(study: Study) -> str:
    counts = {
        "method": len({setting.method for setting in study.settings}),
        "setting": len(study.settings),
        "member": sum(len(run.members) for run in study.runs),
        "run": len(study.runs),
    }
    return ", ".join(f"{count} {name}" + ("" if count == 1 else "s") for name, count in counts.items())


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
