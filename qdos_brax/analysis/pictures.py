"""Pictures of an episode for the report: frames from near what moves, and the whole of it as a small film."""

from __future__ import annotations

import numpy as np

from envs.render import NoOpenGL, Renderer, steps_per_second
from envs.task import SimulatorStates, Task
from qdos_brax.report.video import webp

_FRAMES = 6
_DECISIONS = (0, 7, 14, 22)  # of an episode of a task of parts; those that the paper shows (figure 7)
_HEIGHT, _WIDTH = 240, 320
_FILM_FRAMES = 48  # at most: drawing them is a part of every run's end
_FILM_RATE = 8.0  # frames per second
_NEAR = "follow"


def near_camera(env: Task) -> str | None:
    """Return the name of the camera that stays near what moves; None, the scene's first, where there is none."""
    return _NEAR if _NEAR in env.scene().cameras else None


def picture_steps(states: int, horizon: int | None) -> np.ndarray:
    """Return int[F], the steps of the states that are shown as pictures, the first and the last one among them.

    Args:
        states: of the episode, its start included.
        horizon: control steps between two decisions, to show the states of the paper's decisions and the end, of
            evenly spread decisions if the episode has fewer; None for states that are evenly spaced. The end is the
            picture of the last decision, which has no other unless it is the only one.
    """
    if horizon is None:
        return evenly_spaced(_FRAMES, states)
    before_last = max(1, -(-(states - 1) // horizon) - 1)
    chosen = np.asarray(_DECISIONS)
    if chosen[-1] >= before_last:
        chosen = evenly_spaced(len(chosen), before_last)
    return np.append(chosen * horizon, states - 1)


def draw_episode(env: Task, states: SimulatorStates, goals: np.ndarray, shown: np.ndarray) -> dict[str, np.ndarray]:
    """Draw an episode.

    Args:
        env: its task.
        states: its T states.
        goals: float[T, ..], the goal in each of them.
        shown: int[F], the steps of its pictures.

    Returns:
        frames: uint8[F, height, width, 3], its pictures.
        frame_steps: int[F], their steps.
        film: uint8[bytes], a WebP from the first state to the last.
        film_speed: float[], how many times as fast as the simulated time it plays.
        Nothing of these on a machine that cannot draw: a page without pictures is better than none.
    """
    filmed = evenly_spaced(_FILM_FRAMES, len(goals))
    extra = [None] * len(goals) if states.extra is None else states.extra
    try:
        with Renderer(env, _HEIGHT, _WIDTH, near_camera(env)) as renderer:
            frames = {
                step: renderer.frame(states.qpos[step], goals[step], extra[step])
                for step in np.union1d(filmed, shown).tolist()
            }
    except NoOpenGL:
        return {}
    film = np.stack([frames[step] for step in filmed.tolist()])
    seconds = (len(goals) - 1) / steps_per_second(env)
    return {
        "frames": np.stack([frames[step] for step in shown.tolist()]),
        "frame_steps": shown,
        "film": np.frombuffer(webp(film, _FILM_RATE), np.uint8),
        "film_speed": np.asarray(seconds * _FILM_RATE / len(film), np.float32),
    }


def evenly_spaced(count: int, total: int) -> np.ndarray:
    """Return int[<= count], different places among ``total``, the first and the last one included."""
    return np.unique(np.linspace(0, total - 1, count).round().astype(int))
