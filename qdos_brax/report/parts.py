"""What a page is made of: sections with charts, tables, pictures and texts.

A chart is plotly's JSON as a plain dict. ``meta`` on a trace says what the page's filter hides it with: "member" is a
member's own trace, "setting" one that stands for all members of a setting.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from qdos_brax.report.study import Member
from qdos_brax.report.tables import Table

Trace = dict[str, Any]
# Okabe and Ito's colours, which differ for colour-blind eyes too; without their yellow and
# black, which are no lines on white and on a dark page.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A7A7A", "#9A5FB5", "#8C6D31", "#A5AA99")


class Card(NamedTuple):
    """One answer of the page's top: what is asked, the answer in a few words, and what it rests on."""

    title: str
    value: str
    text: str


class Image(NamedTuple):
    """A picture: what it shows, and the picture itself as a data URI."""

    title: str
    source: str


@dataclasses.dataclass(frozen=True)
class Figure:
    """One chart.

    Attributes:
        title: above it.
        data: plotly's traces.
        layout: plotly's layout, without what the page sets for all (fonts, colours, margins, legend).
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
    """One part of the page.

    Attributes:
        title: its heading.
        text: how to read it.
        cards: its answers in short.
        figures: its charts.
        choices: names of what the reader can switch in its charts; the first one is drawn at first.
        tables: its tables.
        images: its pictures.
        listings: (title, text) of longer texts, folded away.
        inner: parts of it, each folded away under its title.
        opened: whether, as such a part, it begins unfolded.
    """

    title: str
    text: str = ""
    cards: Sequence[Card] = ()
    figures: Sequence[Figure] = ()
    choices: Sequence[str] = ()
    tables: Sequence[Table] = ()
    images: Sequence[Image] = ()
    listings: Sequence[tuple[str, str]] = ()
    inner: Sequence[Section] = ()
    opened: bool = False


def member_id(member: Member) -> str:
    """What the filter calls a member."""
    return f"{member.run}#{member.task}#{member.seed}#{sorted(member.values.items())}"


def axes(x: str, y: str, share: bool = False) -> dict[str, Any]:
    vertical: dict[str, Any] = {"title": {"text": y}, "automargin": True}
    if share:
        vertical |= {"range": [-0.03, 1.03], "tickformat": ".0%"}
    return {"xaxis": {"title": {"text": x}, "automargin": True}, "yaxis": vertical}


def numbers(values: Iterable[Any]) -> list[float | None]:
    """Numbers for JSON: five digits, null for what is not finite."""
    return [float(f"{number:.5g}") if math.isfinite(number) else None for number in np.asarray(list(values), float)]


def logarithmic(values: Iterable[float]) -> dict[str, Any]:
    """A logarithmic axis for positive numbers, with a label at every decade, or at 1, 2 and 5 if there are few."""
    positive = [value for value in values if math.isfinite(value) and value > 0]
    decades = math.log10(max(positive) / min(positive)) if positive else 0.0
    return {"type": "log", "dtick": 1 if decades > 2 else "D2"}
