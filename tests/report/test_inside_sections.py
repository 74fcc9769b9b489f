"""What a look inside a run found, on the page: every number where it belongs, in figures that plotly takes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest

from qdos_brax.report.inside_sections import inside_sections
from qdos_brax.report.looks import read_looks
from qdos_brax.report.page import write_page
from qdos_brax.report.study import read_study
from qdos_brax.report.write import write_report
from tests.report.folders import write_run

TITLES = ["Weight against quality", "Latents of segments (t-SNE)", "Where skills lead", "Skills over an episode"]


def write_inside(run: Path, **without: bool) -> None:
    """inside.npz of member 1, in a maze of 3 x 3 cells with its goal in the middle."""
    rng = np.random.default_rng(0)
    walls = [[4.0 * x, 4.0 * y] for x in range(3) for y in range(3) if (x, y) != (1, 1)]
    gain = np.linspace(-2, 2, 8)
    arrays = {
        "members": np.asarray([1]),
        "goal": np.asarray([4.0, 4.0]),
        "walls": np.asarray(walls),
        "return": -np.arange(8.0),
        "gain": gain,
        "quality": np.asarray([0, 0, 0, 0, 0, 3, 3, 2]),
        "1/weight": np.exp(gain),
        "1/latent": rng.normal(size=(8, 3)),
        "1/tsne": rng.normal(size=(8, 2)),
        "1/grid": rng.normal(size=(4, 6, 2)),
        "1/between": rng.normal(size=(3, 6, 2)),
        "1/path": rng.normal(size=(41, 2)),
        "1/left": np.linspace(9, 1, 41),
        "1/latents": np.asarray([[1.0, 0.0, 0.0], [0.0, -4.0, 2.0]]),
        "1/frames": np.zeros((2, 6, 8, 3), np.uint8),
        "1/frame_steps": np.asarray([0, 40]),
    }
    np.savez(run / "inside.npz", **{name: array for name, array in arrays.items() if not without.get(name, False)})


def test_everything_found_is_shown(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", success=[0.5, 0.7])
    write_inside(run)
    study = read_study([run])
    looks, notes = read_looks(study)
    sections = {section.title: section for section in inside_sections(looks)}
    assert list(sections) == TITLES and not notes
    (episode,) = sections[TITLES[3]].inner
    assert episode.title == "qdos, seed 1" and episode.opened
    for figure in episode.figures:
        go.Figure({"data": figure.data, "layout": figure.layout})
    for section in sections.values():
        for figure in section.figures:
            go.Figure({"data": figure.data, "layout": figure.layout})
            assert "qdos, seed 1" in figure.title
    good, wandering, failing = sections[TITLES[0]].figures[0].data
    assert [good["name"], wandering["name"], failing["name"]] == ["good", "wandering", "failing"]
    assert wandering["x"] == [2.0] and wandering["y"] == [pytest.approx(np.exp(2), rel=1e-4)]
    (latents,) = sections[TITLES[1]].figures
    buttons = {name: choice["marker"] for name, choice in latents.choices.items()}
    assert list(buttons) == list(sections[TITLES[1]].choices) == ["quality", "progress", "return", "weight"]
    assert buttons["return"]["color"] == [-float(i) for i in range(8)] and buttons["quality"]["color"][5] == 3
    for marker in buttons.values():
        go.Scatter(marker=marker)
    grid, between = sections[TITLES[2]].figures
    assert (len(grid.data), len(between.data)) == (4 + 1, 3 + 1)  # and the goal
    assert len(grid.layout["shapes"]) == 8 and grid.layout["xaxis"]["range"] == [-2, 10]
    skills, way, path = episode.figures
    assert skills.data[0]["x"] == [0, 20] and skills.data[0]["z"] == [[1, 0], [0, -4], [0, 2]]
    assert way.data[1]["x"] == [0, 40] and way.data[1]["y"] == [9, 1] and len(path.data[0]["x"]) == 41
    assert [image.title for image in episode.images] == ["step 0", "step 40"]
    write_page(study, looks, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text().count('<img src="data:image/jpeg;base64,') == 2


def test_what_was_not_found_is_left_out(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", success=[0.5, 0.7])
    assert read_looks(read_study([run])) == ([], [])
    missing = ["quality", "gain", "1/weight", "1/tsne", "1/grid", "1/between", "1/frames", "1/frame_steps"]
    write_inside(run, **dict.fromkeys(missing, True))
    (section,) = inside_sections(read_looks(read_study([run]))[0])
    assert section.title == TITLES[3] and not section.inner[0].images
    for figure in section.inner[0].figures:
        go.Figure({"data": figure.data, "layout": figure.layout})


@pytest.mark.parametrize("damage", ["empty", "cut", "text", "foreign", "of more members"])
def test_damage_is_left_out_with_one_line(tmp_path: Path, damage: str) -> None:
    run = write_run(tmp_path / "run")
    contents = {"empty": b"", "cut": b"PK\x03\x04 cut", "text": b"members"}
    if damage in contents:
        (run / "inside.npz").write_bytes(contents[damage])
    else:
        np.savez(run / "inside.npz", **({"other": np.ones(1)} if damage == "foreign" else {"members": np.asarray([3])}))
    looks, (note,) = read_looks(read_study([run]))
    assert looks == [] and "\n" not in note
    assert "inside.npz" in note and "remove it, and --resume" in note
    if damage == "cut":
        report = write_report([run], tmp_path / "out")
        assert f"note: {note}" in report.text and "remove it, and --resume" in report.page.read_text()
