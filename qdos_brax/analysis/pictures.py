"""Pictures of an episode for the report: frames from near what moves, and the whole of it as a small film."""

from __future__ import annotations

import numpy as np

from envs.render import NoOpenGL, Renderer, steps_per_second
from envs.task import Task
from qdos_brax.report.video import webp

_FRAMES = 6
_HEIGHT, _WIDTH = 240, 320
_FILM_FRAMES = 48  # at most: drawing them is a part of every run's end
_FILM_RATE = 8.0  # frames per second
_NEAR = "follow"


def near_camera(env: Task) -> str | None:
    """Return the name of the camera that stays near what moves; None, the scene's first, where there is none."""
    return _NEAR if _NEAR in env.scene().cameras else None


def draw_episode(env: Task, qpos: np.ndarray, goals: np.ndarray) -> dict[str, np.ndarray]:
    """Draw an episode.

    Args:
        env: its task.
        qpos: float[T, nq], its states.
        goals: float[T, ..], the goal in each of them.

    Returns:
        frames: uint8[F, height, width, 3], the first state, the last, and some evenly spaced between them.
        frame_steps: int[F], their steps.
        film: uint8[bytes], a WebP from the first state to the last.
        film_speed: float[], how many times as fast as the simulated time it plays.
        Nothing of these on a machine that cannot draw: a page without pictures is better than none.
    """
    steps = evenly_spaced(_FILM_FRAMES, len(qpos))
    try:
        with Renderer(env, _HEIGHT, _WIDTH, near_camera(env)) as renderer:
            frames = np.stack([renderer.frame(qpos[step], goals[step]) for step in steps])
    except NoOpenGL:
        return {}
    shown = evenly_spaced(_FRAMES, len(steps))
    seconds = (len(qpos) - 1) / steps_per_second(env)
    return {
        "frames": frames[shown],
        "frame_steps": steps[shown],
        "film": np.frombuffer(webp(frames, _FILM_RATE), np.uint8),
        "film_speed": np.asarray(seconds * _FILM_RATE / len(frames), np.float32),
    }


def evenly_spaced(count: int, total: int) -> np.ndarray:
    """Return int[<= count], different places among ``total``, the first and the last one included."""
    return np.unique(np.linspace(0, total - 1, count).round().astype(int))
