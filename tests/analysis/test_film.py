"""Films and pictures: of a finished run with untrained networks, which is as good as any for a film."""

from __future__ import annotations

import io
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import PIL.Image
import pytest

import envs
from envs import brax_base, render
from envs.physics.base import PipelineState
from qdos_brax.analysis import film, pictures, strip
from qdos_brax.analysis import finished as finished_runs
from qdos_brax.commands import main as commands
from qdos_brax.errors import UserError
from qdos_brax.high_level.evaluation import Episodes
from qdos_brax.report import picture
from qdos_brax.report.video import mp4, webp
from tests.report.folders import write_run

CAP = 25


def main(command: str) -> int:
    try:
        return commands.main(shlex.split(command))
    except SystemExit as stop:
        return int(stop.code or 0)


def read(path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[dict, np.ndarray]:
    """Return ffmpeg's description of a film, and its frames uint8[T, height, width, 3]."""
    # Without this it runs Python between fork and exec, where JAX's threads can hang it.
    monkeypatch.setenv("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    reader = imageio_ffmpeg.read_frames(path)
    about = next(reader)
    width, height = about["size"]
    return about, np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])


@pytest.mark.usefixtures("opengl")
def test_evaluate_films_the_first_episode(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    frame = render.Renderer.frame
    monkeypatch.setattr(render.Renderer, "frame", lambda self, *state: drawn.append(state) or frame(self, *state))
    out = tmp_path / "film.mp4"
    assert main(f"evaluate {finished} --episodes 2 --video {out}") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{out}: success 0, return -{CAP}, length {CAP}"
    assert len(lines) == 3 and f"return -{CAP}, length {CAP}, episodes 2" in lines[1]
    about, frames = read(out, monkeypatch)
    assert about["codec"] == "h264" and about["fps"] == 10.0  # 0.1 s per control step
    assert frames.shape == (CAP + 1, 480, 480, 3)
    assert (frames[:, :20, :20] > 200).all()  # the wall in the corner
    assert (frames[0] != frames[-1]).any()
    assert sorted(tmp_path.iterdir()) == [out, finished]

    # The states drawn are an episode of the first member's agent, played here as macro steps play it.
    trained = finished_runs.load_run(finished)
    agent = trained.agent(*jax.tree.map(lambda x: x[0], (trained.artifacts, trained.hyper)))
    state = trained.env.reset(jax.random.split(finished_runs.evaluation_key(), 2)[0])
    step = jax.jit(lambda state, latent: trained.env.step(state, agent.play(state.obs, latent, 0)))
    for t in range(11):
        np.testing.assert_allclose(drawn[t][0], state.pipeline_state.qpos, atol=1e-3)
        np.testing.assert_array_equal(drawn[t][1], trained.env.goal_xy)
        if t % 10 == 0:
            latent = agent.choose(state.obs)
        state = step(state, latent)


class Counter:
    """A task whose state counts its steps, adds up its actions and is done at ``end``."""

    def __init__(self, end: int) -> None:
        self.end = end

    def reset(self, key: jax.Array) -> brax_base.State:
        zeros = jnp.zeros(1)
        physics = PipelineState(zeros, zeros, zeros[:0], jnp.zeros(0, jnp.int32), (), jnp.zeros((), jnp.int32))
        done = jnp.zeros(())
        return brax_base.State(physics, zeros, done, done, {"success": done}, {"goal": zeros})

    def step(self, state: brax_base.State, action: jax.Array) -> brax_base.State:
        physics = state.pipeline_state
        physics = physics.replace(qpos=physics.qpos + 1, qvel=physics.qvel + action)
        done = (physics.qpos[0] >= self.end).astype(jnp.float32)
        return state.replace(
            pipeline_state=physics, obs=physics.qpos, reward=physics.qpos[0], done=done, metrics={"success": done}
        )


@pytest.mark.parametrize("horizon", [1, 5, 60])
@pytest.mark.parametrize("end", [7, 120])
def test_an_episode_ends_where_it_is_done_and_decides_every_horizon(horizon: int, end: int) -> None:
    agent = SimpleNamespace(choose=lambda obs: obs, play=lambda obs, decision, step: 1000 * decision + step)
    trained: Any = SimpleNamespace(
        env=Counter(end),
        artifacts=(),
        hyper={"a": jnp.zeros(1)},
        agent=lambda *learned: agent,
        config=SimpleNamespace(skills=SimpleNamespace(horizon=horizon)),
    )
    start, *moments = film.EpisodeRunner(trained).episode(0)
    assert start.decision is None and start.qpos == 0
    assert [moment.qpos[0] for moment in moments] == list(range(1, end + 1))
    assert [moment.reward for moment in moments] == list(range(1, end + 1))
    decided = [step - step % horizon for step in range(end)]  # each decision is the count it was made at
    assert [moment.decision[0] for moment in moments] == decided
    actions = np.diff([moment.qvel[0] for moment in (start, *moments)])
    np.testing.assert_array_equal(actions, [1000 * at + step - at for step, at in enumerate(decided)])
    assert [moment.success for moment in moments] == [0.0] * (end - 1) + [1.0]


def test_the_evaluation_is_the_same_without_a_film(finished: Path) -> None:
    members = finished_runs.evaluate_run(finished, 2)
    assert [member["seed"] for member in members] == [0, 1]
    assert all((member["return"], member["length"], member["success"]) == (-CAP, CAP, 0) for member in members)
    assert not [name for name in members[0] if name.endswith(" done")]  # a maze has no parts


def test_the_evaluation_says_which_parts_of_a_task_are_done(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two episodes: a share per part."""
    zeros, parts = jnp.zeros(2), {"kettle": jnp.array([True, False]), "microwave": jnp.array([False, False])}
    episodes = Episodes(zeros, zeros, zeros, zeros, parts)
    monkeypatch.setattr(finished_runs, "evaluate", lambda *_: episodes)
    for member in finished_runs.evaluate_run(finished, 2):
        assert (member["kettle done"], member["microwave done"]) == (0.5, 0)


@pytest.mark.parametrize("height", [48, 51])
def test_frames_are_what_was_written(tmp_path: Path, height: int, monkeypatch: pytest.MonkeyPatch) -> None:
    with mp4(tmp_path / "a.mp4", height, 64, 25) as write:
        for level in (0, 120, 250):
            write(np.full((height, 64, 3), level, np.uint8))
    about, frames = read(tmp_path / "a.mp4", monkeypatch)
    assert about["fps"] == 25 and len(frames) == 3
    assert frames.shape[1:] == (height - height % 2, 64, 3)
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)), [0, 120, 250], atol=4)


def test_a_small_film_is_what_was_drawn() -> None:
    """Frames of one colour each, at ten per second; they play again and again."""
    levels = (0, 120, 250)
    content = webp(np.stack([np.full((24, 32, 3), level, np.uint8) for level in levels]), fps=10)
    with PIL.Image.open(io.BytesIO(content)) as image:
        assert image.n_frames == 3 and image.size == (32, 24) and image.info["loop"] == 0
        for i, level in enumerate(levels):
            image.seek(i)
            np.testing.assert_allclose(np.asarray(image.convert("RGB")), level, atol=4)
            assert image.info["duration"] == 100


@pytest.mark.usefixtures("opengl")
def test_an_episode_in_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 201 states, 20 s: 48 frames that play for 6 s, six of which are pictures; the camera goes along."""
    monkeypatch.setattr(pictures, "_HEIGHT", 48)
    monkeypatch.setattr(pictures, "_WIDTH", 64)
    env = envs.make("antmaze-medium", physics="mujoco")
    qpos = np.tile(np.asarray(env.engine.model.qpos0), (201, 1))
    qpos[:, 0] = np.linspace(0, 4, 201)  # along the first corridor
    goals, shown = np.tile(np.asarray(env.goal_xy), (201, 1)), pictures.picture_steps(201, None)
    states = SimpleNamespace(qpos=qpos, qvel=None, extra=None)
    found = pictures.draw_episode(env, states, goals, shown)
    assert found["film_speed"] == pytest.approx(20 / 6)
    assert found["frame_steps"].tolist() == [0, 40, 80, 120, 160, 200]
    with PIL.Image.open(io.BytesIO(found["film"].tobytes())) as film:
        assert film.n_frames == 48 and film.size == (64, 48)
    for frame in found["frames"].astype(int):  # the ant's brown in the middle
        assert frame[24, 32, 0] > 130 and frame[24, 32, 0] > frame[24, 32, 2] + 50
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert pictures.draw_episode(env, states, goals, shown) == {}


def test_which_states_become_pictures() -> None:
    """Those of the decisions 0, 7, 14 and 22, or of evenly spread ones if there are fewer, and the end."""
    assert pictures.picture_steps(281, 10).tolist() == [0, 70, 140, 220, 280]
    assert pictures.picture_steps(232, 10).tolist() == [0, 70, 140, 220, 231]  # decisions 0 to 23
    assert pictures.picture_steps(231, 10).tolist() == [0, 70, 140, 210, 230]  # of 0 to 21; the end is that of 22
    assert pictures.picture_steps(281, 20).tolist() == [0, 80, 160, 240, 280]  # of 0 to 12: 0, 4, 8, 12
    assert pictures.picture_steps(281, None).tolist() == [0, 56, 112, 168, 224, 280]
    assert pictures.picture_steps(3, 10).tolist() == [0, 2] and pictures.picture_steps(3, None).tolist() == [0, 1, 2]


@pytest.mark.parametrize("states", range(12, 260, 7))
def test_no_two_pictures_are_of_one_decision(states: int) -> None:
    decisions = -(-(states - 1) // 10)
    shown = np.minimum(pictures.picture_steps(states, 10) // 10, decisions - 1)
    assert len(set(shown.tolist())) == len(shown) == min(5, decisions)


def test_a_film_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    out = tmp_path / "a.mp4"
    out.write_text("earlier")
    with pytest.raises(ZeroDivisionError), mp4(out, 16, 16, 10) as write:
        write(np.zeros((16, 16, 3), np.uint8))
        raise ZeroDivisionError
    assert out.read_text() == "earlier" and list(tmp_path.iterdir()) == [out]


def test_what_is_wrong_with_a_film_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(UserError, match=r"written as \.mp4, not as a\.gif"), mp4(tmp_path / "a.gif", 16, 16, 10):
        pass
    with pytest.raises(UserError, match=r"cannot write .*No such file"), mp4(tmp_path / "no" / "a.mp4", 16, 16, 10):
        pass
    with (
        pytest.raises(UserError, match=r"cannot write .*a\.mp4: ffmpeg says"),
        mp4(tmp_path / "a.mp4", 0, 0, 10) as write,
    ):
        for _ in range(9):
            write(np.zeros((200, 200, 3), np.uint8))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match=r"pip install -c constraints.txt -e \"\.\[video\]\""):
        mp4(tmp_path / "a.mp4", 16, 16, 10).__enter__()
    assert main("evaluate a b --video c.mp4") == 2
    assert capsys.readouterr().err == "error: --video films one run, and 2 were given; name one RUN\n"
    assert not list(tmp_path.iterdir())


def test_without_opengl_a_film_is_one_line(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(UserError, match="cannot draw: MUJOCO_GL is 'off'"):
        film.film_run(finished, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.usefixtures("opengl")
def test_picture_of_a_task(tmp_path: Path) -> None:
    out = tmp_path / "maze.png"
    assert main(f"picture antmaze-large --out {out}") == 0
    image = matplotlib.image.imread(out)
    assert image.shape[:2] == (720, 960)
    red = (image[..., 0] > 0.8) & (image[..., 2] < 0.65) & (image[..., 1] < 0.65)
    row, column = np.argwhere(red).mean(axis=0)
    assert row < 240 and column > 720  # task 1's goal lies in the upper right corner


@pytest.mark.usefixtures("opengl")
def test_picture_of_a_run(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    widths = []
    for latents in (None, (np.random.default_rng(0).normal(size=(50, 2)), None)):
        monkeypatch.setattr(strip, "_latents", lambda run, latents=latents: latents)
        assert main(f"picture {finished} --out {tmp_path}/run.png") == 0
        widths.append(matplotlib.image.imread(tmp_path / "run.png").shape[1])
    assert widths[1] == widths[0] * 5 // 4  # four frames, and the map of latents beside them


def test_a_folder_called_like_a_task_is_drawn_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn: list[tuple[str, str]] = []
    monkeypatch.setattr(strip, "draw_run", lambda run, out: drawn.append(("run", str(run))))
    monkeypatch.setattr(picture, "draw_task", lambda name, out: drawn.append(("task", name)))
    (tmp_path / "antsoccer").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main("picture antsoccer --out a.png") == 0
    out, err = capsys.readouterr()
    assert out == "a.png\n" and err == "note: drew the task; for the folder of that name write ./antsoccer\n"
    assert main("picture ./antsoccer --out a.png") == 0 and main("picture antmaze --out a.png") == 0
    assert drawn == [("task", "antsoccer"), ("run", "antsoccer"), ("task", "antmaze")]
    assert capsys.readouterr().err == ""


def test_latents_of_a_run_are_those_of_its_analysis(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", success=[0.5])
    assert strip._latents(run) is None
    places, gain = np.ones((3, 2), np.float32), np.arange(3.0)
    np.savez(run / "inside.npz", **{"members": np.array([0]), "gain": gain, "0/tsne": places})
    found = strip._latents(run)
    np.testing.assert_array_equal(found[0], places)
    np.testing.assert_array_equal(found[1], gain)


def test_wrong_pictures_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for command, message in (
        ("picture antmaze-larg --out a.png", "did you mean 'antmaze-large'"),
        ("picture antmaze --out a.jpg", "written as .png"),
        ("picture antmaze", "--out"),
        ("picture tests --out a.png", "tests"),  # a folder, but no run
        ("picture tests --out a.jpg", "written as .png"),
    ):
        assert main(command) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and message in lines[0]
