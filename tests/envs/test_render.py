"""Frames: everything where it belongs, on both engines; and one clear line where a machine cannot draw."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator

import numpy as np
import pytest

import envs
from envs import render
from qdos_brax.commands import doctor

LARGE = envs.make("antmaze-large", physics="mujoco")
QPOS = np.asarray(LARGE.engine.model.qpos0)


@pytest.fixture
def fresh_probe() -> Iterator[None]:
    """Forgets what was found before and after the test."""
    render._headless_way.cache_clear()
    yield
    render._headless_way.cache_clear()


def pixel(layout, xy, z, height, width):
    """Row and column where a camera straight above, with MuJoCo's 45 degrees, sees the point (x, y, z)."""
    rows, columns = layout.grid.shape
    slope = math.tan(math.radians(22.5))
    distance = max(rows * 2, columns * 2 / (width / height)) / slope + 2
    scale = height / 2 / slope / (distance - z)
    x, y = np.asarray(xy) - layout.ij_to_xy(((rows - 1) / 2, (columns - 1) / 2))
    return round(height / 2 - y * scale), round(width / 2 + x * scale)


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize(("height", "width"), [(480, None), (256, 256)])
def test_the_whole_maze_is_seen_from_above(height, width) -> None:
    layout, goal = LARGE.layout, np.array([36.0, 24.0])
    with render.Renderer(LARGE, height, width) as renderer:
        image = renderer.frame(QPOS, goal)
    width = width or 640
    assert image.shape == (height, width, 3) and image.dtype == np.uint8
    for i, j in np.ndindex(layout.grid.shape):
        wall = layout.grid[i, j] == 1
        row, column = pixel(layout, layout.ij_to_xy((i, j)), 2.0 if wall else 0.0, height, width)
        if (i, j) in [(1, 1), (7, 10)]:  # the ant and the target
            continue
        assert (image[row, column].min() > 200) if wall else (image[row, column].max() < 130), (i, j)
    red, green, blue = image[pixel(layout, goal, 0.1, height, width)].astype(int)
    assert red > 200 and red > green + 50 and red > blue + 50
    red, green, blue = image[pixel(layout, (0, 0), 1.0, height, width)].astype(int)
    assert red > 130 and red > blue + 50  # the ant's brown


@pytest.mark.usefixtures("opengl")
def test_body_and_target_move() -> None:
    moved = QPOS.copy()
    moved[:2] = 12.0, 16.0
    place = pixel(LARGE.layout, moved[:2], 0.0, 480, 640)
    with render.Renderer(LARGE) as renderer:
        before = renderer.frame(QPOS, (36.0, 24.0))
        after = renderer.frame(moved, (36.0, 24.0))
        elsewhere = renderer.frame(QPOS, moved[:2])
        np.testing.assert_array_equal(renderer.frame(QPOS, (36.0, 24.0)), before)
    near = np.s_[place[0] - 20 : place[0] + 20, place[1] - 20 : place[1] + 20]
    for other in (after, elsewhere):
        assert (before[near] != other[near]).any()
    start = pixel(LARGE.layout, (0, 0), 0.0, 480, 640)
    for spot in np.argwhere((before != after).any(axis=-1)):
        assert min(math.dist(spot, place), math.dist(spot, start)) < 30


@pytest.mark.usefixtures("opengl")
def test_following_keeps_the_body_in_the_middle() -> None:
    with render.Renderer(LARGE, 240, 240, camera="follow") as renderer:
        for xy in ((0.0, 0.0), (12.0, 16.0)):
            qpos = QPOS.copy()
            qpos[:2] = xy
            red, _, blue = renderer.frame(qpos, (36.0, 24.0))[120, 120].astype(int)
            assert red > 130 and red > blue + 50


@pytest.mark.usefixtures("opengl")
def test_both_engines_show_the_whole_maze() -> None:
    images = []
    for physics in ("mujoco", "mjx"):
        env = envs.make("antsoccer-medium", physics=physics)
        qpos = np.asarray(env.engine.model.qpos0)
        with render.Renderer(envs.AutoReset(env), 96, 96) as renderer:
            images.append(renderer.frame(qpos, env.goal_xy))
    np.testing.assert_array_equal(*images)
    assert (images[0] > 200).all(axis=-1).mean() > 0.3  # walls


@pytest.mark.usefixtures("opengl")
def test_a_closed_renderer_says_so() -> None:
    with render.Renderer(LARGE, 16, 16) as renderer:
        pass
    renderer.close()
    with pytest.raises(ValueError, match="closed"):
        renderer.frame(QPOS, LARGE.goal_xy)


def test_drawing_leaves_the_engines_model_alone(opengl: None) -> None:
    before = LARGE.engine.model.geom_pos.copy()
    with render.Renderer(LARGE, 16, 16) as renderer:
        renderer.frame(QPOS, (4.0, 4.0))
    np.testing.assert_array_equal(LARGE.engine.model.geom_pos, before)
    assert LARGE.whole_model().geom("target").pos[0] == 0  # and the next whole one is as it should be


def test_wrong_frames() -> None:
    with pytest.raises(ValueError, match="cameras: top, follow"):
        render.Renderer(LARGE, camera="back")
    with pytest.raises(ValueError, match="no pixels"):
        render.Renderer(LARGE, 0, 10)


@pytest.mark.usefixtures("fresh_probe")
def test_without_opengl_one_line_names_causes_and_mend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(render, "_PROBE", "import sys; raise ImportError(f'no library for {sys.argv[1]}')")
    with pytest.raises(render.NoOpenGL) as caught:
        render.Renderer(LARGE, 16, 16)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    for part in ("egl: ImportError: no library for egl", "osmesa: ImportError: no library for osmesa"):
        assert part in message
    assert "apt-get install libegl1" in message and "libosmesa6" in message and "MUJOCO_GL" in message


@pytest.mark.usefixtures("fresh_probe")
def test_doctor_says_that_nothing_draws_and_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(render, "_PROBE", "raise ImportError('no library')")
    passed, line = doctor._drawing()  # reports do without frames
    assert passed and line.startswith("drawing: no frames in reports, no films: cannot draw without OpenGL (egl: ")


@pytest.mark.usefixtures("opengl")
def test_doctor_says_what_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert doctor._drawing() == (True, f"drawing: by {render._headless_way()}")


@pytest.mark.usefixtures("fresh_probe")
def test_osmesa_is_taken_where_egl_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "_PROBE", "import sys; sys.exit(sys.argv[1] == 'egl')")
    assert render._headless_way() == "osmesa"


def test_what_mujoco_gl_says_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "_headless_way", lambda: pytest.fail("nothing is to be looked for"))
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(render.NoOpenGL, match="MUJOCO_GL is 'off'; unset it"):
        render.Renderer(LARGE, 16, 16)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(render.NoOpenGL, match=r"cannot draw with egl \(.*mujoco.egl.*\); install EGL"):
        render.Renderer(LARGE, 16, 16)
