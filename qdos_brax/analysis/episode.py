"""An episode of a finished run for its page: what it measured, and its pictures."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qdos_brax.analysis.film import EpisodeRunner
from qdos_brax.analysis.finished import TrainedRun
from qdos_brax.analysis.pictures import draw_episode, picture_steps
from qdos_brax.data.quality import States
from qdos_brax.methods.low_level_kinds import make_low_level


class Episode(NamedTuple):
    """Hold an episode.

    Attributes:
        states: the simulator's, T of them, from the start to the end.
        goals: float[T, ..], the goal in each of them.
        latents: float[K, z], the latent of each decision.
    """

    states: States
    goals: np.ndarray
    latents: np.ndarray


def play_episode(trained: TrainedRun, runner: EpisodeRunner, member: int) -> Episode:
    """Return the episode that the evaluation of a member begins with."""
    moments = list(runner.episode(member))
    width = make_low_level(trained.config, trained.env).width  # a skill's first numbers are its latent
    decisions = [moment.decision for moment in moments[1 :: trained.config.skills.horizon]]
    columns = (np.stack([getattr(moment, name) for moment in moments]) for name in States._fields)
    goals = np.stack([moment.goal for moment in moments])
    return Episode(States(*columns), goals, np.stack(decisions)[:, :width])


def measure_episode(env: Any, episode: Episode, horizon: int) -> dict[str, np.ndarray]:
    """Return what is known of an episode, and its pictures.

    Args:
        env: its task.
        episode: the episode.
        horizon: control steps between two decisions.

    Returns:
        latents: float[K, z].
        left: float32[T], the distance left to the goal.
        path: float32[T, 2], the positions of what acts.
        parts: bool[T, P], which parts of the task are done.
        What ``draw_episode`` returns. Arrays that the task cannot give are left out.
    """
    found = {"latents": episode.latents}
    left = env.distance_left(episode.states.qpos, episode.states.extra)
    if left is not None:
        found["left"] = np.asarray(left, np.float32)
    if env.floor_map() is not None:
        found["path"] = place_of_body(env, episode.states.qpos).astype(np.float32)
    parts = env.parts(episode.states)
    if parts is not None:
        found["parts"] = np.stack([np.asarray(done) for done in parts.values()], axis=-1)
    shown = picture_steps(len(episode.goals), None if parts is None else horizon)
    return found | draw_episode(env, episode.states, episode.goals, shown)


def place_of_body(env: Any, qpos: Any) -> Any:
    """Return [..., 2], where what acts is, of a task that has positions."""
    return next(iter(env.position(qpos).values()))
