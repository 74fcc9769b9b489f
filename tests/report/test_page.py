"""The page is self-contained: it loads nothing, and its numbers are those of the runs."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
import pytest

from qdos_brax.report.page import write_page
from qdos_brax.report.reading import read_study
from tests.report.folders import write_run


class Page(HTMLParser):
    """Hold the elements of a page and the content of its scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.words: list[str] = []
        self.titles: dict[int, str] = {}  # of the charts, by their place
        self._within: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attributes)))
        self._within.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        while self._within and self._within.pop() != tag:
            pass

    def handle_data(self, text: str) -> None:
        if self._within and self._within[-1] == "script":
            self.scripts[-1] += text
        else:
            self.words.append(text)
            if self._within and self._within[-1] == "h3":
                self.titles[sum("data-figure" in a for _, a in self.elements)] = text


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, int]:
    folder = tmp_path_factory.mktemp("page")
    runs = [
        write_run(folder / "q", success={0.1: [0.5, 0.6], 0.3: [0.7, 0.8]}, first_goals=[100, None, 300, 400]),
        write_run(folder / "s", "supe", [0.2, 0.4], first_goals=[700, 800]),
        write_run(folder / "q2", success=[0.25, 0.75], env="antsoccer-arena-task4"),
    ]
    write_page(read_study(runs), [], folder / "report.html")
    text = (folder / "report.html").read_text(encoding="utf-8")
    return Page(text), len(text.encode())


def test_nothing_is_fetched(page: tuple[Page, int]) -> None:
    for tag, attributes in page[0].elements:
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            assert not attributes.get(name) or str(attributes[name]).startswith(("data:", "#")), (tag, attributes)
    policy = next(a["content"] for t, a in page[0].elements if t == "meta" and a.get("http-equiv"))
    assert policy is not None and "default-src 'none'" in policy and "http" not in policy
    assert page[1] < 10_000_000


def test_every_figure_is_plotlys_and_has_its_place(page: tuple[Page, int]) -> None:
    figures = json.loads(page[0].scripts[0])
    places = [int(str(a["data-figure"])) for _, a in page[0].elements if "data-figure" in a]
    assert places == list(range(len(figures))) and len(figures) > 8
    for figure in figures:
        go.Figure(figure)  # raises on what plotly does not know


def test_figures_hold_the_runs_numbers(page: tuple[Page, int]) -> None:
    figures = json.loads(page[0].scripts[0])
    curves = {trace["name"]: trace for trace in _of(page[0], "success, antmaze-medium-task1") if trace.get("mode")}
    assert curves["supe"]["x"] == [1000, 2000, 4000] and curves["supe"]["y"] == [0.075, 0.15, 0.3]
    assert curves["qdos, alpha 0.3, seed 1"]["y"] == [0.2, 0.4, 0.8]
    goals = {
        (trace["y"][0], trace["name"]): trace["x"][0] for trace in _of(page[0], "every member, antmaze-medium-task1")
    }
    assert goals["qdos, alpha 0.1", "seed 0"] == 100 and goals["supe", "seed 1"] == 800
    assert goals["qdos, alpha 0.3", "seed 0: not reached by then"] == 4000
    means = {t["y"][0]: t["x"][0] for t in _of(page[0], "every setting, antmaze-medium-task1") if "error_x" in t}
    assert means == {"qdos, alpha 0.1": 0.55, "qdos, alpha 0.3": 0.75, "supe": 0.3}
    assert next(iter(means)) == "qdos, alpha 0.3"  # the best is on top
    bars = [trace for figure in figures for trace in figure["data"] if trace.get("type") == "bar"]
    assert {bar["name"]: bar["x"][0] for bar in bars} == {
        "data": 1,
        "pretrain": 2,
        "label": 0.1,
        "online": 3,
        "eval": 0.5,
    }


def test_filter_knows_every_trace(page: tuple[Page, int]) -> None:
    boxes = {a["data-member"]: a["data-of"] for _, a in page[0].elements if "data-member" in a}
    assert len(boxes) == 8
    traces = [trace for figure in json.loads(page[0].scripts[0]) for trace in figure["data"]]
    used = {trace["meta"]["member"] for trace in traces if "member" in trace.get("meta", {})}
    assert used == set(boxes)
    assert {trace["meta"]["setting"] for trace in traces if "setting" in trace.get("meta", {})} == set(boxes.values())


def test_configuration_and_provenance_are_told(page: tuple[Page, int]) -> None:
    text = "".join(page[0].words)
    assert "/data/a <b> & c.hdf5" in text and "d" * 64 in text and "jax 0.10.2" in text
    assert "advantage_temperature: 1.0" in text and "Table 2." in text


def test_foreign_names_stay_text(tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script>"
    run = write_run(tmp_path / "a", success=[0.5, 0.7])
    summary = json.loads((run / "summary.json").read_text())
    (run / "summary.json").write_text(json.dumps({**summary, "method": evil}))
    write_page(read_study([run]), [], tmp_path / "report.html")
    parsed = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert len(parsed.scripts) == 3 and evil in "".join(parsed.words)
    assert evil in {trace["name"] for trace in _of(parsed, "success")}


def test_a_frozen_member_is_marked(tmp_path: Path) -> None:
    """It is marked in the filter, at the end of its curve, and in every chart with a point of its own."""
    run = write_run(tmp_path / "a", success={0.1: [0.5, 0.6], 0.3: [0.7, 0.8]}, frozen=[2])
    write_page(read_study([run]), [], tmp_path / "report.html")
    parsed = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "".join(parsed.words).count("frozen (NaN)") == 1 and "was frozen" in "".join(parsed.words)
    for chart, name in (
        ("success", "qdos, alpha 0.1, seed 1 (frozen)"),
        ("every setting", "seed 1 (frozen)"),
        ("success over alpha", "seed 1 (frozen)"),
    ):
        crossed = [t for t in _of(parsed, chart) if str(t.get("marker", {}).get("symbol", "")).startswith("x")]
        assert [trace["name"] for trace in crossed] == [name]


def _of(page: Page, title: str) -> list[dict[str, Any]]:
    """Return the traces of the first chart with a title."""
    places = [int(str(a["data-figure"])) for _, a in page.elements if "data-figure" in a]
    titles = [page.titles.get(i) for i in range(len(places))]
    data: list[dict[str, Any]] = json.loads(page.scripts[0])[places[titles.index(title)]]["data"]
    return data
