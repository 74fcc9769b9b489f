"""Define what plays the episodes of a collected set, and find it by the family of the task."""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple, Protocol

import numpy as np

from envs.task import Task
from qdos_brax.errors import UserError


class SimStates(NamedTuple):
    """Hold n simulations before a control step, in NumPy.

    Attributes:
        qpos: float64[n, nq].
        qvel: float64[n, nv].
        extra: int32[n, e], the discrete state.
        sensed: float32[n, k], what the rig senses.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    extra: np.ndarray
    sensed: np.ndarray


class Demonstrator(Protocol):
    """Play episodes in n simulations at once, in NumPy."""

    def begin(self, kinds: np.ndarray, rng: np.random.Generator) -> SimStates:
        """Return the starts of n episodes; the caller fills in ``sensed``.

        Args:
            kinds: int8[n], the behaviour in each, codes of ``qdos_brax.data.quality.QUALITY``.
            rng: what all chances are drawn from.
        """
        ...

    def act(self, states: SimStates, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return (actions float32[n, act] within [-1, 1], noise included; quality int8[n] of this very step)."""
        ...


_DEMONSTRATORS: dict[str, str] = {
    "cube": "qdos_brax.collection.scripted.tabletop:TabletopDemonstrator",
    "kitchen": "qdos_brax.collection.scripted.kitchen:KitchenDemonstrator",
    "scene": "qdos_brax.collection.scripted.tabletop:TabletopDemonstrator",
}
"""By family, the class as "module:name", called with (task, noise); imported on first use."""


def has_demonstrator(family: str) -> bool:
    """Return whether ``family`` is collected by a script."""
    return family in _DEMONSTRATORS


def demonstrator_of(env: Task, noise: float) -> Demonstrator:
    """Return what plays the task's episodes.

    Args:
        env: the task.
        noise: standard deviation of the action noise of episodes that are not degraded.

    Raises:
        UserError: there is none for the task's family.
    """
    if env.spec.family not in _DEMONSTRATORS:
        raise UserError(f"no demonstrator is shipped for {env.spec.family}; train with --dataset FILE")
    module, _, name = _DEMONSTRATORS[env.spec.family].partition(":")
    make: Any = getattr(importlib.import_module(module), name)
    made: Demonstrator = make(env, noise)
    return made
