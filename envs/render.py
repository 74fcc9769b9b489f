"""Draw frames of any state offscreen, with MuJoCo's renderer.

MuJoCo for Python settles on a way to OpenGL when it is first imported, from ``MUJOCO_GL``, and on a Linux machine
without a display its default cannot work. So the contexts are opened here, when the first frame is wanted: the one that
``MUJOCO_GL`` names now, else EGL (a GPU's driver, or Mesa's in software), else OSMesa (software).
"""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
import warnings
import weakref
from types import TracebackType
from typing import Any

import mujoco
import numpy as np

from envs.task import Task

_HEADLESS = ("egl", "osmesa")  # ways to OpenGL that need no display
_BY_MUJOCO_GL = {"egl": "egl", "osmesa": "osmesa"} | dict.fromkeys(("glfw", "glx", "on", "true", "1", "enable"), "glfw")
_REMEDY = (
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


class NoOpenGL(RuntimeError):
    """Report that nothing draws on this machine; the message is one line with causes and remedy."""


class Renderer:
    """Draw states of a task; a context manager that gives its OpenGL context back.

    Args:
        env: the task, on any engine, wrapped or not.
        height: of the frames, in pixels.
        width: of the frames, in pixels; None takes the scene's own shape, to a multiple of 16, which films want.
        camera: one of the scene's, such as "top" or "follow" in a maze; None takes its first.

    Raises:
        ValueError: there is no such camera, or the frame has no pixels.
        NoOpenGL: this machine cannot draw.
    """

    def __init__(self, env: Task, height: int = 480, width: int | None = None, camera: str | None = None) -> None:
        scene = env.scene()
        camera = next(iter(scene.cameras)) if camera is None else camera
        if camera not in scene.cameras:
            raise ValueError(f"there is no camera {camera!r}; cameras: {', '.join(scene.cameras)}")
        if width is None:
            width = 16 * round(height * scene.aspect / 16)
        if height < 1 or width < 1:
            raise ValueError(f"a frame of {height} x {width} has no pixels; height and width start at 1")
        self._model = scene.model
        self._goal_marker, self._paint = scene.goal_marker, scene.paint
        if scene.goal_marker is not None:  # MuJoCo ignores the place of a geom that was compiled at its body's
            self._model.geom_sameframe[self._model.geom(scene.goal_marker).id] = 0
        self._model.vis.global_.offheight = height
        self._model.vis.global_.offwidth = width
        self._data = mujoco.MjData(self._model)
        self.height, self.width = height, width
        self._camera = scene.cameras[camera](self._model, width / height)
        self._scene = mujoco.MjvScene(self._model, _MAX_GEOMS)
        # The light comes from straight above, where its shadows tell little; in software they are 3/4 of the work.
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._options = mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._gl, self._context = _open_contexts(self._model, height, width)
        self._free = weakref.finalize(self, _free, self._gl, self._context)  # where close() was forgotten

    def frame(self, qpos: Any, goal: Any, extra: Any = None) -> np.ndarray:
        """Return uint8[height, width, 3], the state ``qpos[nq]`` with the mark of the goal, if any, at ``goal``.

        Args:
            qpos: float[nq].
            goal: of the task.
            extra: int[e], the discrete state; None shows the model's own colours.
        """
        if not self._free.alive:
            raise ValueError("this renderer is closed; make a new one")
        self._data.qpos[:] = np.asarray(qpos)
        if self._goal_marker is not None:
            self._model.geom(self._goal_marker).pos[: len(goal)] = np.asarray(goal)
        if self._paint is not None and extra is not None:
            self._paint(self._model, np.asarray(extra))
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
        """Give the OpenGL context back; a second time does nothing."""
        self._free()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def steps_per_second(env: Any) -> float:
    """Return the control steps per simulated second: the frame rate at which a film of every step runs in real time."""
    return 1.0 / (env.engine.frame_skip * env.engine.model.opt.timestep)


def check_drawing() -> str:
    """Return the way to OpenGL by which frames are drawn on this machine: "egl", "osmesa" or "glfw".

    Raises:
        NoOpenGL: this machine cannot draw.
    """
    _free(*_open_contexts(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16))
    return find_way()


def find_way() -> str:
    """Return the way to OpenGL that frames will be drawn by, without drawing: "egl", "osmesa" or "glfw".

    The first call may take a second, for it tries the ways in processes of their own.

    Raises:
        NoOpenGL: ``MUJOCO_GL`` names no way, or is not set and none works.
    """
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked and asked not in _BY_MUJOCO_GL:
        raise NoOpenGL(f"cannot draw: MUJOCO_GL is {asked!r}; unset it, or set it to egl, osmesa or glfw")
    return _BY_MUJOCO_GL[asked] if asked else _headless_way()


def _open_contexts(model: mujoco.MjModel, height: int, width: int) -> tuple[Any, mujoco.MjrContext]:
    """Return an OpenGL context, and in it the renderer's.

    Raises:
        NoOpenGL: no way works.
    """
    way = find_way()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns, and then fails
            gl = importlib.import_module(f"mujoco.{way}").GLContext(width, height)
            gl.make_current()
            context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # each library fails in its own way: ImportError, AttributeError, GLError ..
        raise NoOpenGL(f"cannot draw with {way} ({_one_line(str(error))}); {_REMEDY}") from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return gl, context


@functools.cache
def _headless_way() -> str:
    """Return the first of EGL and OSMesa that works on this machine.

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
    raise NoOpenGL(f"cannot draw without OpenGL ({'; '.join(causes)}); {_REMEDY}")


def _one_line(message: str) -> str:
    """Return the last line of an error's text."""
    return next(reversed(message.strip().splitlines()), "")


def _free(gl: Any, context: mujoco.MjrContext) -> None:
    with gl.as_current():
        context.free()
    gl.free()
