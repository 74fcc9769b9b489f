"""Search a skill space for a way to success, further ahead than one skill: a part of ``benchmarks/skills.py``.

``CROWD`` episodes that begin in one state play random skills. Every ``PERIOD`` skills those that are most behind go on
from copies of those that are most ahead, as in multilevel splitting (Kahn and Harris 1951, "Estimation of particle
transmission by random sampling"). Nothing is learned, and the task's own state says who is ahead, so that this is no
method but a lower bound: what a search finds, the skills can do, if with luck in the choice and in the noise. An agent
may do more: it chooses among skills where a search draws from the prior.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from envs.brax_base import State

CROWD = 64
PERIOD = 4  # skills between two selections
BEHIND = 0.25  # share of the crowd that a selection replaces


class Plays(Protocol):
    """Define what plays draws from a skill prior (``skills.Skills``)."""

    env: Any
    horizon: int

    def play(self, states: State, key: jax.Array) -> dict[str, Any]:
        """Return what each draw leads to from states[S], [draws, S] each: end, success, score, steps."""
        ...


class Found(NamedTuple):
    """Hold what one search found: whether an episode succeeds, the best score, and the steps to the first success."""

    success: bool
    score: float
    steps: float


def selection(score: np.ndarray, left: np.ndarray, behind: float) -> np.ndarray:
    """Return int[S], the episode whose state each of S goes on from.

    The share ``behind`` of least score, and of those of one score the ones with most left, take over the states of as
    many that are most ahead; all others keep their own.

    Args:
        score: [S], what is done now.
        left: [S], how far it is from success.
        behind: share of S that is replaced, at most one half.
    """
    order, source = np.lexsort((left, -score)), np.arange(len(score))
    replaced = int(behind * len(score))
    source[order[len(order) - replaced :]] = order[:replaced]
    return source


def search(skills: Plays, left: Callable[[State], np.ndarray], seed: int) -> Found:
    """Return what a crowd finds from one start.

    Args:
        skills: what plays them, with one draw in each state.
        left: states[S] -> float[S], how far they are from success.
        seed: of the start and of the skills.
    """
    env, key = skills.env, jax.random.key(seed)
    states = jax.vmap(env.reset)(jax.numpy.stack([key] * CROWD))
    best = 0.0
    for decision in range(env.episode_length // skills.horizon):
        found = jax.tree.map(lambda leaf: leaf[0], skills.play(states, jax.random.fold_in(key, decision)))
        states, best = found["end"], max(best, float(np.max(found["score"])))
        if np.any(found["success"]):
            steps = np.asarray(found["steps"])[np.asarray(found["success"])].min()
            return Found(True, 1.0, float(decision * skills.horizon + steps))
        if decision % PERIOD == PERIOD - 1:
            now = np.asarray(states.metrics.get("score", np.zeros(CROWD)))
            source = selection(now, left(states), BEHIND)
            states = jax.tree.map(lambda leaf, source=source: leaf[source], states)
    return Found(False, best, float("nan"))


def searches(skills: Plays, left: Callable[[State], np.ndarray], number: int) -> dict[str, float]:
    """Return columns of several searches: share with a success, mean score, mean steps of those with a success."""
    found = [search(skills, left, seed) for seed in range(number)]
    steps = [each.steps for each in found if each.success]
    return {
        "search_success": float(np.mean([each.success for each in found])),
        "search_score": float(np.mean([each.score for each in found])),
        "search_steps": float(np.mean(steps)) if steps else float("nan"),
    }
