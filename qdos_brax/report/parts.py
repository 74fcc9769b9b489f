"""What a page is made of: sections with charts, tables, pictures and texts.

A chart is plotly's JSON as a plain dict. ``meta`` on a trace says what the page's filter hides it with: "member" is a
member's own trace, "setting" one that stands for all members of a setting.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from qdos_brax.report.study import Member
from qdos_brax.report.tables import Table

Trace = dict[str, Any]
# Okabe and Ito's colours, which differ for colour-blind eyes too; their yellow is too light for a line.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#7F3C8D", "#8C6D31", "#A5AA99")


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
        layout: plotly's layout, without what the page sets for all (fonts, margins, legend).
    """

    title: str
    data: list[Trace]
    layout: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes:
        title: its heading.
        text: how to read it.
        figures: its charts.
        tables: its tables.
        images: its pictures.
        listings: (title, text) of longer texts, folded away.
        folded: whether the charts are drawn only once the reader opens them.
    """

    title: str
    text: str = ""
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    images: Sequence[Image] = ()
    listings: Sequence[tuple[str, str]] = ()
    folded: bool = False


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
