"""The analysis of a run on the page: every number where it belongs, in figures that plotly accepts."""

from __future__ import annotations

import itertools
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import plotly.graph_objects as go
import pytest

from qdos_brax.report import static_figures
from qdos_brax.report.analysis_sections import analysis_sections
from qdos_brax.report.elements import describe
from qdos_brax.report.member_analysis import quality_colours, quality_groups, quality_names, read_analyses
from qdos_brax.report.page import write_page
from qdos_brax.report.reading import read_study
from qdos_brax.report.write import write_report
from tests.report.folders import write_run

TITLES = ["Weight against quality", "Latents of segments (t-SNE)", "Where skills lead", "Skills over an episode"]


def arrays_of_member_1() -> dict[str, np.ndarray]:
    """Return the arrays of an inside.npz, for a maze of 3 x 3 cells with its goal in the middle."""
    rng = np.random.default_rng(0)
    walls = [[4.0 * x, 4.0 * y] for x in range(3) for y in range(3) if (x, y) != (1, 1)]
    gain = np.linspace(-2, 2, 8)
    return {
        "members": np.asarray([1]),
        "goal": np.asarray([4.0, 4.0]),
        "walls": np.asarray(walls),
        "return": -np.arange(8.0),
        "gain": gain,
        "quality": np.asarray([0, 0, 0, 0, 0, 3, 3, 2]),
        "quality_names": np.asarray(["good", "noisy", "wandering", "failing"]),
        "part": np.asarray([0, 1, 0, 2, 0, 3, 0, 0]),
        "part_names": np.asarray(["none", "kettle", "light", "several"]),
        "1/weight": np.exp(gain),
        "1/latent": rng.normal(size=(8, 3)),
        "1/tsne": rng.normal(size=(8, 2)),
        "1/tsne_episode": np.asarray([[1.0, 2.0], [3.0, -4.0]]),
        "1/parts": np.arange(41)[:, None] >= [20, 99],
        "1/grid": rng.normal(size=(4, 6, 2)),
        "1/between": rng.normal(size=(3, 6, 2)),
        "1/path": rng.normal(size=(41, 2)),
        "1/left": np.linspace(9, 1, 41),
        "1/latents": np.asarray([[1.0, 0.0, 0.0], [0.0, -4.0, 2.0]]),
        "1/frames": np.zeros((2, 6, 8, 3), np.uint8),
        "1/frame_steps": np.asarray([0, 40]),
        "1/film": np.frombuffer(b"RIFF", np.uint8),
        "1/film_speed": np.asarray(3.25, np.float32),
    }


NAMES = [name for name in arrays_of_member_1() if name != "members"]
OF_MAZES = ["walls", "goal", "gain", "1/path", "1/left", "1/grid", "1/between"]


def write_inside(run: Path, *without: str) -> None:
    """Write inside.npz into a run folder, without some of its arrays."""
    assert set(without) <= set(NAMES)
    arrays = arrays_of_member_1()
    np.savez(run / "inside.npz", **{name: array for name, array in arrays.items() if name not in without})


def test_everything_found_is_shown(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", success=[0.5, 0.7])
    write_inside(run)
    study = read_study([run])
    analyses, notes = read_analyses(study)
    sections = {section.title: section for section in analysis_sections(analyses)}
    assert list(sections) == TITLES and not notes
    (episode,) = sections[TITLES[3]].subsections
    assert episode.title == "qdos, seed 1" and episode.expanded
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
    assert list(buttons) == list(sections[TITLES[1]].choices) == [
        "quality", "subtask", "progress", "return", "weight"
    ]  # fmt: skip
    assert buttons["return"]["color"] == [-float(i) for i in range(8)] and buttons["quality"]["color"][5] == 3
    assert buttons["subtask"]["colorbar"]["ticktext"] == ["none", "kettle", "light", "several"]
    assert buttons["subtask"]["color"] == [0, 1, 0, 2, 0, 3, 0, 0] and buttons["subtask"]["size"][:2] == [4, 8]
    assert latents.data[0]["customdata"][1].startswith("good<br>subtask: kettle<br>progress")
    for marker in buttons.values():
        go.Scatter(marker=marker)
    grid, between = sections[TITLES[2]].figures
    assert (len(grid.data), len(between.data)) == (4 + 1, 3 + 1)  # and the goal
    assert len(grid.layout["shapes"]) == 8 and grid.layout["xaxis"]["range"] == [-2, 10]
    skills, trajectory, way, path = episode.figures
    cloud, decisions, marks = trajectory.data
    assert len(cloud["x"]) == 8 and decisions["x"] == [1, 3] and decisions["y"] == [2, -4]
    assert decisions["customdata"] == ["decision 0<br>step 0<br>done: nothing", "decision 1<br>step 20<br>done: kettle"]
    assert marks["text"] == ["0", "1"] and (marks["x"], marks["y"]) == ([1, 3], [2, -4])
    assert describe(trajectory) == (
        "Chart: the episode in latent space (t-SNE); segments of the data, decisions, pictures, by decision"
    )
    assert skills.data[0]["x"] == [0, 20] and skills.data[0]["z"] == [[1, 0], [0, -4], [0, 2]]
    assert way.data[1]["x"] == [0, 40] and way.data[1]["y"] == [9, 1] and len(path.data[0]["x"]) == 41
    assert [image.title for image in episode.images] == ["step 0, decision 0", "step 40, decision 1"]
    assert episode.images[1].description == "The scene at step 40, decision 1 (1.0 from the goal; done: kettle)"
    (film,) = episode.films
    assert film.title == "the whole episode, 3.2 times as fast" and film.source == "data:image/webp;base64,UklGRg=="
    assert film.description == (
        "Film of the episode of qdos, seed 1, from step 0 (9.0 from the goal; done: nothing) to step 40 (1.0 from the "
        "goal; done: kettle)"
    )
    write_page(study, analyses, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text().count('<img src="data:image/jpeg;base64,') == 2 + 1


def test_pictures_of_one_decision_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The episode of 41 states has decisions at 0 and 20; the last one's beginning and end are both shown."""
    shown: list[str] = []
    monkeypatch.setattr(
        static_figures,
        "save_figure",
        lambda figure, out: shown.extend(axes.get_xlabel() for axes in figure.axes) if out.stem == "trajectory" else 0,
    )
    run = write_run(tmp_path / "run", success=[0.5, 0.7])
    write_inside(run)
    study = read_study([run])
    (analysis,), _ = read_analyses(study)
    own = analysis.own | {"frames": np.zeros((3, 6, 8, 3), np.uint8), "frame_steps": np.asarray([0, 20, 40])}
    static_figures.draw_static_figures(study, [analysis._replace(own=own)], tmp_path)
    assert shown[1:4] == ["step 0, decision 0", "step 20, decision 1", "step 40, decision 1"]
    plt.close("all")


def test_what_was_not_found_is_left_out(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", success=[0.5, 0.7])
    assert read_analyses(read_study([run])) == ([], [])
    write_inside(run, "quality", "gain", "1/weight", "1/tsne", "1/grid", "1/between", "1/frames", "1/frame_steps")
    (section,) = analysis_sections(read_analyses(read_study([run]))[0])
    assert section.title == TITLES[3] and not section.subsections[0].images
    for figure in section.subsections[0].figures:
        go.Figure({"data": figure.data, "layout": figure.layout})


# Each array is missing once, together with arrays of other charts; then all that a task, or a whole file, may lack.
MISSING = [
    ["goal", "quality"],
    ["walls", "gain"],
    ["return", "1/grid", "1/latents"],
    ["quality_names", "1/between", "1/left", "1/film"],
    ["1/weight", "1/path", "1/film_speed"],
    ["1/tsne", "1/frames"],
    ["1/latent", "1/frame_steps", "part"],
    ["1/tsne_episode", "part_names"],
    ["1/parts"],
    OF_MAZES,
    ["return", *OF_MAZES],
    NAMES,
]


def test_every_array_is_missing_once() -> None:
    assert sorted(itertools.chain(*MISSING[:9])) == sorted(NAMES)


@pytest.mark.parametrize("missing", MISSING, ids=" ".join)
def test_any_array_may_be_missing(tmp_path: Path, missing: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A task may have no walls, goal, positions or progress, a method no weights or skills, a machine no OpenGL."""
    monkeypatch.setattr(static_figures, "save_figure", lambda figure, out: plt.close(figure))  # which takes long
    run = write_run(tmp_path / "run", success=[0.5, 0.7])
    write_inside(run, *missing)
    study = read_study([run])
    analyses, notes = read_analyses(study)
    assert len(analyses) == 1 and not notes
    for section in analysis_sections(analyses):
        for figure in [*section.figures, *(figure for part in section.subsections for figure in part.figures)]:
            go.Figure({"data": figure.data, "layout": figure.layout})
            for choice in figure.choices.values():
                go.Scatter(marker=choice["marker"])
    static_figures.draw_static_figures(study, analyses, tmp_path)
    write_page(study, analyses, tmp_path / "report.html")


def test_a_task_without_places_has_a_page_of_the_rest(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", success=[0.5, 0.7], env="cube-single-task1")
    write_inside(run, *OF_MAZES)
    (latents, episodes) = analysis_sections(read_analyses(read_study([run]))[0])
    assert (latents.title, episodes.title) == (TITLES[1], TITLES[3])
    assert list(latents.choices) == ["quality", "subtask", "return", "weight"]
    titles = [figure.title for figure in episodes.subsections[0].figures]
    assert titles == ["skills over time", "the episode in latent space (t-SNE)"]
    assert episodes.subsections[0].images[1].description == "The scene at step 40, decision 1 (done: kettle)"
    written = {file.name for file in write_report([run], tmp_path / "out").files}
    assert {"latents.png", "subtasks.png", "trajectory.png", "episodes.png"} <= written and written.isdisjoint(
        ("weights.png", "skills.png")
    )
    page = (tmp_path / "out" / "report.html").read_text()
    assert TITLES[1] in page and TITLES[0] not in page and TITLES[2] not in page


def test_without_walls_a_map_shows_what_there_is(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", success=[0.5, 0.7])
    write_inside(run, "walls", "goal")
    sections = {section.title: section for section in analysis_sections(read_analyses(read_study([run]))[0])}
    grid, between = sections[TITLES[2]].figures
    assert (len(grid.data), len(between.data)) == (4, 3)  # no goal
    assert "shapes" not in grid.layout and "range" not in grid.layout["xaxis"]


def test_files_without_names_of_qualities_number_them(tmp_path: Path) -> None:
    """Files of before the names were stored with the codes; there may also be codes beyond the names."""
    run = write_run(tmp_path / "run", success=[0.5, 0.7])
    write_inside(run, "quality_names")
    (analysis,), _ = read_analyses(read_study([run]))
    assert quality_names(analysis) == ["quality 0", "quality 1", "quality 2", "quality 3"]
    named = analysis._replace(data=analysis.data | {"quality_names": np.asarray(["expert", "play"])})
    assert quality_names(named) == ["expert", "play", "quality 2", "quality 3"]
    assert [name for _, _, name in quality_groups(named, 8)] == ["expert", "quality 2", "quality 3"]
    assert len(set(quality_colours(named))) == 4


@pytest.mark.parametrize("damage", ["empty", "cut", "text", "foreign", "of more members"])
def test_damage_is_left_out_with_one_line(tmp_path: Path, damage: str) -> None:
    run = write_run(tmp_path / "run")
    contents = {"empty": b"", "cut": b"PK\x03\x04 cut", "text": b"members"}
    if damage in contents:
        (run / "inside.npz").write_bytes(contents[damage])
    else:
        np.savez(run / "inside.npz", **({"other": np.ones(1)} if damage == "foreign" else {"members": np.asarray([3])}))
    analyses, (note,) = read_analyses(read_study([run]))
    assert analyses == [] and "\n" not in note
    assert "inside.npz" in note and "delete it, and --resume" in note
    if damage == "cut":
        report = write_report([run], tmp_path / "out")
        assert f"note: {note}" in report.text and "delete it, and --resume" in report.page.read_text()
