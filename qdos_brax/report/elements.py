"""The elements that a page is made of: sections with charts, tables, pictures and texts, and what charts share.

A chart is plotly's JSON as a plain dict. ``meta`` on a trace names what the page's filter hides it with: "member" for a
member's own trace, "setting" for one that stands for all members of a setting.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from qdos_brax.report.study import Member, Study
from qdos_brax.report.tables import Table

Trace = dict[str, Any]
# The colours of Okabe and Ito, which colour-blind readers can tell apart. Their yellow and black are left out: lines in
# them cannot be seen on a white or on a dark page.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A7A7A", "#9A5FB5", "#8C6D31", "#A5AA99")
_MOST_NAMES = 12  # in the description of a chart


class Card(NamedTuple):
    """Hold one answer at the top of the page.

    Attributes:
        title: the question.
        value: the answer in a few words.
        text: what it rests on.
    """

    title: str
    value: str
    text: str


class Image(NamedTuple):
    """Hold a picture.

    Attributes:
        title: the line below it.
        source: the picture itself, as a data URI.
        description: what is to be seen, for those who cannot see it.
    """

    title: str
    source: str
    description: str


class Film(NamedTuple):
    """Hold an animated picture, which stands still until the reader starts it.

    Attributes:
        title: the line below it.
        source: the animated picture itself, as a data URI.
        still: the picture that is shown before, likewise.
        description: what is to be seen, for those who cannot see it.
    """

    title: str
    source: str
    still: str
    description: str


@dataclasses.dataclass(frozen=True)
class Figure:
    """Hold one chart.

    Attributes:
        title: the line above it.
        data: plotly's traces.
        layout: plotly's layout, without what the page sets for all charts (fonts, colours, margins, legend).
        choices: by a name of the section's ``choices``, what that choice changes in the first trace.
        height: in pixels.
    """

    title: str
    data: list[Trace]
    layout: dict[str, Any]
    choices: Mapping[str, Trace] = dataclasses.field(default_factory=dict)
    height: int = 360


@dataclasses.dataclass(frozen=True)
class Section:
    """Hold one section of the page.

    Attributes:
        title: its heading.
        text: how to read it.
        cards: its answers in short.
        figures: its charts.
        choices: names of what the reader can switch in its charts; the first one is shown at first.
        tables: its tables.
        films: its animated pictures.
        images: its pictures.
        listings: (title, text) of longer texts, folded away.
        subsections: sections within it, each folded away under its title.
        expanded: whether it is unfolded at first, as a subsection.
    """

    title: str
    text: str = ""
    cards: Sequence[Card] = ()
    figures: Sequence[Figure] = ()
    choices: Sequence[str] = ()
    tables: Sequence[Table] = ()
    films: Sequence[Film] = ()
    images: Sequence[Image] = ()
    listings: Sequence[tuple[str, str]] = ()
    subsections: Sequence[Section] = ()
    expanded: bool = False


def describe(figure: Figure) -> str:
    """Return what a chart shows, in words: its title, its axes, and the names in its legend."""
    x, y = (figure.layout.get(axis, {}).get("title", {}).get("text", "") for axis in ("xaxis", "yaxis"))
    axes = f"{y} over {x}" if x and y else x or y
    names = dict.fromkeys(trace["name"] for trace in figure.data if trace.get("name") and trace.get("showlegend", True))
    parts = (figure.title, axes, ", ".join(list(names)[:_MOST_NAMES]))
    return "Chart: " + "; ".join(part for part in parts if part)


# --- Names -----------------------------------------------------------------------------------------------------


def member_id(member: Member) -> str:
    """Return the name by which the page's filter knows a member; short, since every trace bears it."""
    everything = f"{member.run}#{member.task}#{member.seed}#{sorted(member.values.items())}"
    return hashlib.sha256(everything.encode()).hexdigest()[:12]


def member_name(member: Member) -> str:
    """Return a member's name within its setting."""
    return f"seed {member.seed}" + (" (frozen)" if member.frozen else "")


def title_with_task(study: Study, title: str, task: str) -> str:
    """Return a chart's title, with the task where the study has several."""
    return f"{title}, {task}" if len(study.tasks) > 1 else title


# --- Charts ----------------------------------------------------------------------------------------------------


def member_dot(member: Member, x: float, y: Any, colour: str, size: int = 8) -> Trace:
    """Return a member's own point, which is a cross if the member was frozen."""
    symbol = {"symbol": "x-thin-open", "line": {"width": 2}} if member.frozen else {}
    return {
        "x": [x],
        "y": [y],
        "mode": "markers",
        "marker": {"color": colour, "opacity": 0.55, "size": size, **symbol},
        "name": member_name(member),
        "showlegend": False,
        "meta": {"member": member_id(member)},
    }


def axis_layout(x: str, y: str, share: bool = False) -> dict[str, Any]:
    """Return the layout of two axes with titles.

    Args:
        x: title of the horizontal axis.
        y: title of the vertical axis.
        share: whether the vertical axis shows shares, 0 to 1, as percentages.
    """
    vertical: dict[str, Any] = {"title": {"text": y}, "automargin": True}
    if share:
        vertical |= {"range": [-0.03, 1.03], "tickformat": ".0%"}
    return {"xaxis": {"title": {"text": x}, "automargin": True}, "yaxis": vertical}


def log_axis(values: Iterable[float]) -> dict[str, Any]:
    """Return a logarithmic axis for positive numbers, with labels at decades, or at 1, 2 and 5 if there are few."""
    positive = [value for value in values if math.isfinite(value) and value > 0]
    decades = math.log10(max(positive) / min(positive)) if positive else 0.0
    return {"type": "log", "dtick": 1 if decades > 2 else "D2"}


def name_axis(names: Iterable[str]) -> dict[str, Any]:
    """Return a vertical axis of names, the first at the top."""
    return {"type": "category", "categoryarray": list(names)[::-1], "categoryorder": "array"}


def height_of_rows(rows: int) -> int:
    """Return the height in pixels of a chart with this many rows."""
    return 110 + 38 * rows


def json_numbers(values: Iterable[Any]) -> list[float | None]:
    """Return numbers for JSON: five digits, null for what is not finite."""
    return [float(f"{number:.5g}") if math.isfinite(number) else None for number in np.asarray(list(values), float)]
