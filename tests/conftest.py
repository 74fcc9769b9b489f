"""Fixtures that several folders share."""

from __future__ import annotations

import pytest

import envs
from envs import render


@pytest.fixture
def opengl() -> None:
    """Skips where there is no OpenGL, with the line that a user would see."""
    try:
        render.Renderer(envs.make("antmaze-medium", physics="mujoco"), 16, 16).close()
    except render.NoOpenGL as error:
        pytest.skip(str(error))
