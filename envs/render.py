"""Frames of any state, drawn offscreen by MuJoCo's renderer.

MuJoCo for Python settles on a way to OpenGL when it is first imported, from ``MUJOCO_GL``, and on a Linux machine
without a display its default cannot work. So the contexts are opened here, when the first frame is wanted: the one that
``MUJOCO_GL`` names now, else EGL (a GPU's driver, or Mesa's in software), else OSMesa (software).
"""

from __future__ import annotations

import functools
import importlib
import math
import os
import subprocess
import sys
import warnings
import weakref
from types import TracebackType
from typing import Any

import mujoco
import numpy as np

from envs.mazes.locomotion import BodyEnv
from envs.mazes.maze import UNIT, WALL_HALF_SIZE, Maze

CAMERAS = ("top", "follow")

_HEADLESS = ("egl", "osmesa")  # ways to OpenGL that need no display
_BY_MUJOCO_GL = {"egl": "egl", "osmesa": "osmesa"} | dict.fromkeys(("glfw", "glx", "on", "true", "1", "enable"), "glfw")
_MEND = (
    "install EGL (Debian, Ubuntu: apt-get install libegl1 libgl1) or OSMesa (libosmesa6), "
    "or name a way that works with MUJOCO_GL=egl, osmesa or glfw"
)
_PROBE = """
import importlib, sys, mujoco
gl = importlib.import_module("mujoco." + sys.argv[1]).GLContext(16, 16)
gl.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100).free()
"""
_PROBE_SECONDS = 60
_MAX_GEOMS = 2000  # the largest maze has 124 walls; MuJoCo adds a few of its own
_BODY = 1  # the first body after the world: the one that walks


class NoOpenGL(RuntimeError):
    """No way to OpenGL on this machine; the message is one line with causes and mend."""


class Renderer:
    """Draws states of a task; a context manager that gives its OpenGL context back.

    Args:
        env: the task, on either engine, wrapped or not; always the whole maze is drawn.
        height: of the frames, in pixels.
        width: of the frames, in pixels; None takes the maze's own shape, to a multiple of 16, which films want.
        camera: "top": the whole maze from above, x to the right and y up; "follow": the body from near by.

    Raises:
        ValueError: there is no such camera, or the frame has no pixels.
        NoOpenGL: this machine cannot draw.
    """

    def __init__(self, env: BodyEnv, height: int = 480, width: int | None = None, camera: str = "top") -> None:
        if camera not in CAMERAS:
            raise ValueError(f"there is no camera {camera!r}; cameras: {', '.join(CAMERAS)}")
        if width is None:
            rows, columns = env.layout.grid.shape
            width = 16 * round(height * columns / rows / 16)
        if height < 1 or width < 1:
            raise ValueError(f"a frame of {height} x {width} has no pixels; height and width start at 1")
        self._model = env.whole_model()  # of its own, for it is changed below and in every frame
        self._model.vis.global_.offheight = height
        self._model.vis.global_.offwidth = width
        self._data = mujoco.MjData(self._model)
        self.height, self.width = height, width
        fovy = self._model.vis.global_.fovy
        self._camera = _top_camera(env.layout, fovy, width / height) if camera == "top" else _follow_camera()
        self._scene = mujoco.MjvScene(self._model, _MAX_GEOMS)
        # The light comes from straight above, where its shadows tell little; in software they are 3/4 of the work.
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._options = mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._gl, self._context = _open_contexts(self._model, height, width)
        self._free = weakref.finalize(self, _free, self._gl, self._context)  # for who forgets to close it

    def frame(self, qpos: Any, goal_xy: Any) -> np.ndarray:
        """uint8[height, width, 3], the state ``qpos[nq]`` with the target at ``goal_xy[2]``."""
        if not self._free.alive:
            raise ValueError("this renderer is closed; make a new one")
        self._data.qpos[:] = np.asarray(qpos)
        self._model.geom("target").pos[:2] = np.asarray(goal_xy)
        mujoco.mj_forward(self._model, self._data)
        mujoco.mjv_updateScene(
            self._model, self._data, self._options, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        self._gl.make_current()  # another renderer may have been at work in this thread
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        image = np.empty((self.height, self.width, 3), np.uint8)
        mujoco.mjr_readPixels(image, None, self._viewport, self._context)
        return image[::-1].copy()  # OpenGL counts rows from below

    def close(self) -> None:
        """Gives the OpenGL context back; a second time does nothing."""
        self._free()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def steps_per_second(env: Any) -> float:
    """Control steps per simulated second: the frame rate at which a film of every step runs in real time."""
    return 1.0 / (env.engine.frame_skip * env.engine.model.opt.timestep)


def _top_camera(layout: Maze, fovy: float, aspect: float) -> mujoco.MjvCamera:
    """Straight above the middle, as high as it takes to see every wall.

    Args:
        layout: the maze.
        fovy: vertical field of view in degrees.
        aspect: width / height of the picture.
    """
    rows, columns = layout.grid.shape
    half_y, half_x = rows * UNIT / 2, columns * UNIT / 2
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (*layout.ij_to_xy(((rows - 1) / 2, (columns - 1) / 2)), 0.0)
    camera.azimuth, camera.elevation = 90.0, -90.0
    camera.distance = max(half_y, half_x / aspect) / math.tan(math.radians(fovy) / 2) + 2 * WALL_HALF_SIZE[2]
    return camera


def _follow_camera() -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    camera.trackbodyid = _BODY
    camera.azimuth, camera.elevation, camera.distance = 90.0, -50.0, 10.0
    return camera


def _open_contexts(model: mujoco.MjModel, height: int, width: int) -> tuple[Any, mujoco.MjrContext]:
    """An OpenGL context, and in it the renderer's.

    Raises:
        NoOpenGL: no way works.
    """
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked and asked not in _BY_MUJOCO_GL:
        raise NoOpenGL(f"cannot draw: MUJOCO_GL is {asked!r}; unset it, or set it to egl, osmesa or glfw")
    way = _BY_MUJOCO_GL[asked] if asked else _headless_way()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns, and then fails
            gl = importlib.import_module(f"mujoco.{way}").GLContext(width, height)
            gl.make_current()
            context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # each library fails in its own way: ImportError, AttributeError, GLError ..
        raise NoOpenGL(f"cannot draw with {way} ({_one_line(str(error))}); {_MEND}") from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return gl, context


@functools.cache
def _headless_way() -> str:
    """The first of EGL and OSMesa that works on this machine.

    Each is tried in a process of its own, for a library that failed stays loaded, and MuJoCo would ask it for the
    functions of the next one's context.

    Raises:
        NoOpenGL: neither does.
    """
    causes = []
    for way in _HEADLESS:
        command = [sys.executable, "-c", _PROBE, way]
        try:
            done = subprocess.run(command, timeout=_PROBE_SECONDS, capture_output=True, text=True, check=False)
        except subprocess.TimeoutExpired:
            causes.append(f"{way}: no answer in {_PROBE_SECONDS} s")
            continue
        if done.returncode == 0:
            return way
        causes.append(f"{way}: {_one_line(done.stderr) or f'exit code {done.returncode}'}")
    raise NoOpenGL(f"cannot draw without OpenGL ({'; '.join(causes)}); {_MEND}")


def _one_line(message: str) -> str:
    """The last line of an error's text."""
    return next(reversed(message.strip().splitlines()), "")


def _free(gl: Any, context: mujoco.MjrContext) -> None:
    with gl.as_current():
        context.free()
    gl.free()
