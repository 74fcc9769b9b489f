"""The analysis of a finished run: numbers of a data set made by hand, skills from one start, and the page."""

from __future__ import annotations

import json
import math
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import render
from qdos_brax.analysis import conclusion, inside, pictures
from qdos_brax.analysis import finished as finished_runs
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError
from qdos_brax.report.analysis_sections import analysis_sections
from qdos_brax.report.member_analysis import read_analyses
from qdos_brax.report.page import write_page
from qdos_brax.report.reading import read_study
from qdos_brax.runs.folder import RunFolder

CAP, HORIZON, SIZE = 25, 10, 60


@pytest.fixture
def data() -> Dataset:
    """Three episodes of 20 steps; in each the body goes a tenth of a unit per step along the first corridor."""
    rng = np.random.default_rng(0)
    qpos = np.zeros((SIZE, 15), np.float32)
    qpos[:, 0] = np.tile(np.arange(20) / 10, 3)
    qpos[:, 3] = 1.0
    ends = np.arange(SIZE) % 20 == 19
    observations = rng.normal(size=(SIZE, 29)).astype(np.float32)
    return Dataset(
        observations=observations,
        actions=rng.uniform(-1, 1, (SIZE, 8)).astype(np.float32),
        rewards=-np.ones(SIZE, np.float32),
        masks=np.ones(SIZE, np.float32),
        ends=ends,
        next_observations=observations,
        qpos=qpos,
        qvel=np.zeros((SIZE, 14), np.float32),
        quality=(np.arange(SIZE) // 20).astype(np.int8),
    )


@pytest.fixture
def analysed(finished: Path, data: Dataset, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An analysed run; its second segment is worth ten times as much as the others."""
    monkeypatch.setattr(pictures, "_HEIGHT", 48)
    monkeypatch.setattr(pictures, "_WIDTH", 64)
    trained = finished_runs.load_run(finished)
    advantage = jnp.zeros((2, 33)).at[:, 1].set(math.log(10))
    trained = trained._replace(artifacts=trained.artifacts | {"advantage": advantage})
    inside.look_inside(trained, data, finished / "inside.npz")
    return finished


def test_segments_are_of_the_data_that_was_learned_from(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights of exchanged episodes stand beside the returns of these, not of the logged ones."""
    exchange, env = SimpleNamespace(share=0.5, seed=3), SimpleNamespace()

    def exchanged(*given: Any) -> Dataset:
        assert given == (data, env, 0.5, 3)
        return replace(data, rewards=np.zeros(SIZE, np.float32))

    monkeypatch.setattr(inside, "exchanged", exchanged)
    config = SimpleNamespace(skills=SimpleNamespace(horizon=HORIZON), exchange=exchange)
    sample = inside._sample(SimpleNamespace(env=env, config=config), data)  # type: ignore[arg-type]
    assert len(sample.chosen) == 3 * (20 - HORIZON + 1) and not sample.dataset.rewards.any()


@pytest.mark.slow
def test_inside_and_its_page(analysed: Path, opengl_or_not: bool) -> None:
    with np.load(analysed / "inside.npz", allow_pickle=False) as file:
        found = dict(file)
    assert found["members"].tolist() == [0]  # the other has the same setting and another seed
    segments = 3 * (20 - HORIZON + 1)
    np.testing.assert_array_equal(found["return"], np.full(segments, -HORIZON))
    # Segment 0 goes from x = 0 to 1; the last of each episode from 1 to 1.9, where the log ends.
    places = np.zeros((3, 15))
    places[:, 0] = 0, 1, 1.9
    left = envs.make("antmaze-medium", physics="mujoco").distance_left(places)
    expected = [left[0] - left[1], *[left[1] - left[2]] * 3]
    np.testing.assert_allclose(found["gain"][[0, 10, 21, 32]], expected, atol=1e-4)
    assert found["quality"].tolist() == [0] * 11 + [1] * 11 + [2] * 11
    assert {name: code for code, name in enumerate(found["quality_names"])} == QUALITY
    mean = (segments - 1 + 10) / segments
    np.testing.assert_allclose(found["0/weight"], [(10 if i == 1 else 1) / mean for i in range(segments)], rtol=1e-5)
    assert found["0/latent"].shape == (segments, 8) and found["0/tsne"].shape == (segments, 2)
    assert found["0/tsne_episode"].shape == (3, 2) and "part" not in found and "0/parts" not in found
    for name, count in (("grid", 25), ("between", 9)):
        paths = found[f"0/{name}"]
        assert paths.shape == (count, CAP + 1, 2) and np.ptp(paths[:, 0], axis=0).max() == 0
        assert np.ptp(paths[:, -1], axis=0).max() > 0  # not all skills lead to one place
    assert found["0/path"].shape == (CAP + 1, 2) and found["0/latents"].shape == (3, 8)
    env = envs.make("antmaze-medium", physics="mujoco")
    start = np.zeros(15)
    start[:2] = found["0/path"][0]
    assert found["0/left"][0] == pytest.approx(float(env.distance_left(start)), rel=1e-5)
    if opengl_or_not:
        assert found["0/frames"].shape == (6, 48, 64, 3) and found["0/frame_steps"].tolist() == [0, 5, 10, 15, 20, 25]
        assert found["0/film_speed"] == pytest.approx(2.5 / (26 / 8))  # 2.5 s of the simulation in 26 frames
        assert found["0/film"].tobytes()[8:12] == b"WEBP"

    written_as_finished(analysed)
    study = read_study([analysed])
    analyses, _ = read_analyses(study)
    sections = {section.title: section for section in analysis_sections(analyses)}
    titles = ["Weight against quality", "Latents of segments (t-SNE)", "Where skills lead", "Skills over an episode"]
    assert list(sections) == titles
    dots = sections["Weight against quality"].figures[0].data
    assert [trace["name"] for trace in dots] == ["navigate", "noisy", "wander"]
    assert dots[0]["y"][1] == pytest.approx(10 / mean, rel=1e-4)
    assert len(sections["Where skills lead"].figures[0].data) == 25 + 1
    assert len(sections["Skills over an episode"].subsections[0].images) == (6 if opengl_or_not else 0)
    write_page(study, analyses, analysed / "report.html")
    assert (analysed / "report.html").read_text().count("data:image/jpeg;base64,") == (6 + 1 if opengl_or_not else 0)

    (analysed / "inside.npz").write_bytes((analysed / "inside.npz").read_bytes()[:1000])
    assert read_analyses(study)[0] == [] and "delete it" in read_analyses(study)[1][0]


def test_one_members_map_is_laid_out_while_the_next_one_plays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    second_plays, overlapped = threading.Event(), []

    def play(trained: Any, runner: Any, member: int) -> Any:
        if member == 4:
            second_plays.set()
        return SimpleNamespace(latents=np.full((1, 2), member))

    def lay_out(latents: np.ndarray, decisions: np.ndarray) -> dict[str, np.ndarray]:
        overlapped.append(second_plays.wait(5))
        return {"tsne_episode": decisions}

    view = SimpleNamespace(of=lambda member: {"latent": np.zeros((1, 2))} if member else {})
    stand_ins = {
        "on_mujoco_c": lambda trained: trained,
        "_sample": lambda *_: None,
        "_first_seeds": lambda trained: [1, 4, 0],
        "_truth": lambda *_: {},
        "_weights": lambda trained, member, sample: {"weight": np.asarray([member])},
        "_LatentView": lambda *_: view,
        "EpisodeRunner": lambda trained: None,
        "play_episode": play,
        "measure_episode": lambda *_: {},
        "embedded": lay_out,
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(inside, name, stand_in)
    env = SimpleNamespace(floor_map=lambda: None)
    trained: Any = SimpleNamespace(env=env, config=SimpleNamespace(skills=SimpleNamespace(horizon=HORIZON)))
    inside.look_inside(trained, SimpleNamespace(), tmp_path / "inside.npz")  # type: ignore[arg-type]
    assert overlapped == [True, True]
    with np.load(tmp_path / "inside.npz") as found:
        assert [found[f"{member}/tsne_episode"].tolist() for member in (1, 4)] == [[[1, 1]], [[4, 4]]]
        assert found["4/weight"] == [4] and "0/tsne_episode" not in found


@pytest.fixture
def opengl_or_not() -> bool:
    try:
        render.Renderer(envs.make("antmaze-medium", physics="mujoco"), 16, 16).close()
    except render.NoOpenGL:
        return False
    return True


@pytest.mark.slow
def test_without_provenance_it_is_one_line(finished: Path) -> None:
    with pytest.raises(UserError, match="which data the run had"):
        conclusion.read_finished(RunFolder(finished))


def test_a_finished_run_names_its_data(finished: Path, data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    (finished / "run.json").write_text(json.dumps({"dataset": {"path": "data.hdf5", "sha256": "d" * 64}}))
    read: list[Path] = []
    monkeypatch.setattr(conclusion.formats, "read", lambda path, env: read.append(path) or data)
    trained, dataset = conclusion.read_finished(RunFolder(finished))
    assert read == [Path("data.hdf5")] and dataset is data and trained.config.seed == (0, 1)


def test_grid_and_way_between_by_hand() -> None:
    """Latents on a cross: three long along the second axis, one along the first."""
    latents = np.asarray([[1, 0, 0], [-1, 0, 0], [0, 3, 0], [0, -3, 0]], np.float32)
    grid = inside._grid(latents).reshape(5, 5, 3)
    np.testing.assert_allclose(grid[2, 2], 0, atol=1e-6)
    deviation = 3 / np.sqrt(2)  # of two at +-3 and two at 0
    np.testing.assert_allclose(np.abs(grid[2, 4]), [0, 2 * deviation, 0], atol=1e-5)
    np.testing.assert_allclose(np.abs(grid[4, 2]), [2 / np.sqrt(2), 0, 0], atol=1e-5)
    between = inside._between(latents)
    np.testing.assert_allclose(np.abs(between[[0, 4, -1]]), [[0, 3, 0], [0, 0, 0], [0, 3, 0]], atol=1e-5)
    np.testing.assert_allclose(between[0], -between[-1], atol=1e-5)


def written_as_finished(run: Path) -> None:
    """Gives the run what a report reads beside: a summary and a row per member."""
    entry = {"alpha": 0.2, "eval_success": 0.0, "first_goal_step": None, "status": "ok"}
    members = [{"seed": seed, **entry} for seed in (0, 1)]
    header = {"env": "antmaze-medium-task1", "method": "qdos", "wall_seconds": {"online": 1.0}}
    (run / "summary.json").write_text(json.dumps({**header, "members": members}))
    rows = [f"{i},{i},0.2,online,100,10,0.0" for i in (0, 1)]
    (run / "metrics.csv").write_text("\n".join(["member,seed,alpha,phase,env_steps,update,eval/success", *rows]) + "\n")
