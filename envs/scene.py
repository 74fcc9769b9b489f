"""Describe how a task is drawn: its model, the cameras, the mark of the goal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np

View = Callable[[mujoco.MjModel, float], mujoco.MjvCamera]
"""From a model and the width of a frame divided by its height to a camera."""


@dataclass(frozen=True)
class Scene:
    """Hold what a renderer needs of a task.

    Attributes:
        model: a fresh model with everything that is to be seen; the renderer changes it.
        cameras: views by name, the default one first.
        aspect: width of a frame divided by its height, where the user asks for none.
        goal_marker: name of the geom that is moved to the goal (its x and y, or x, y and z); None draws no goal.
        paint: colours the model as a discrete state ``extra[e]`` says; None for a task that does not show it.
    """

    model: mujoco.MjModel
    cameras: Mapping[str, View]
    aspect: float = 4 / 3
    goal_marker: str | None = None
    paint: Callable[[mujoco.MjModel, np.ndarray], None] | None = None


def free_view(model: mujoco.MjModel, aspect: float) -> mujoco.MjvCamera:
    """Return MuJoCo's own camera, which shows the whole model."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    return camera


def top_view(centre: Sequence[float], half_size: Sequence[float], height: float) -> View:
    """Return a view from straight above, x to the right and y up, as high as it takes to see all.

    Args:
        centre: (x, y) of what is to be seen.
        half_size: (x, y), how far that reaches from its centre.
        height: z of the highest thing.
    """
    return partial(_top_camera, tuple(centre), tuple(half_size), height)


def following_view(body: int, azimuth: float = 90.0, elevation: float = -72.0, distance: float = 10.0) -> View:
    """Return a view that follows the body with the id ``body``; angles in degrees, distance in m.

    It is steep by default, so that a maze's walls, half a cell high, hide little of what walks between them.
    """
    return partial(_following_camera, body, azimuth, elevation, distance)


def fixed_view(lookat: Sequence[float], azimuth: float, elevation: float, distance: float) -> View:
    """Return a view of the point ``lookat`` (x, y, z) from a place of its own; angles in degrees, distance in m."""
    return partial(_fixed_camera, tuple(lookat), azimuth, elevation, distance)


def _top_camera(
    centre: tuple[float, ...], half_size: tuple[float, ...], height: float, model: mujoco.MjModel, aspect: float
) -> mujoco.MjvCamera:
    (half_x, half_y), fovy = half_size, model.vis.global_.fovy
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (*centre, 0.0)
    camera.azimuth, camera.elevation = 90.0, -90.0
    camera.distance = max(half_y, half_x / aspect) / math.tan(math.radians(fovy) / 2) + height
    return camera


def _fixed_camera(
    lookat: tuple[float, ...],
    azimuth: float,
    elevation: float,
    distance: float,
    model: mujoco.MjModel,
    aspect: float,
) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.lookat[:] = lookat
    camera.azimuth, camera.elevation, camera.distance = azimuth, elevation, distance
    return camera


def _following_camera(
    body: int, azimuth: float, elevation: float, distance: float, model: mujoco.MjModel, aspect: float
) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    camera.trackbodyid = body
    camera.azimuth, camera.elevation, camera.distance = azimuth, elevation, distance
    return camera
