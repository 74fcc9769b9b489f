"""Scripted demonstrators, by the family of tasks that they play; imported on first use, since they need packages."""

from __future__ import annotations

import importlib

from envs.families import TaskSpec
from envs.task import Task
from qdos_brax.collection.scripted.demonstrator import Demonstrator
from qdos_brax.errors import UserError

_DEMONSTRATORS: dict[str, str | type[Demonstrator]] = {
    "kitchen": "qdos_brax.collection.scripted.kitchen:KitchenDemonstrator",
    "cube": "qdos_brax.collection.scripted.manipspace:CubeDemonstrator",
    "scene": "qdos_brax.collection.scripted.manipspace:SceneDemonstrator",
}


def register_demonstrator(family: str, demonstrator: str | type[Demonstrator]) -> None:
    """Have the tasks of ``family`` played by a class, or by "module:class", which is imported on first use.

    Raises:
        ValueError: the family already has one.
    """
    if family in _DEMONSTRATORS:
        raise ValueError(f"{family} already has a demonstrator")
    _DEMONSTRATORS[family] = demonstrator


def is_scripted(spec: TaskSpec) -> bool:
    """Return whether a demonstrator plays the task."""
    return spec.family in _DEMONSTRATORS


def demonstrator_class(spec: TaskSpec) -> type[Demonstrator]:
    """Return the class that plays the task.

    Raises:
        UserError: no demonstrator plays it.
    """
    if spec.family not in _DEMONSTRATORS:
        raise UserError(f"no demonstrator plays {spec.family}, so no data can be collected; train with --dataset FILE")
    found = _DEMONSTRATORS[spec.family]
    if not isinstance(found, str):
        return found
    module, _, name = found.partition(":")
    loaded: type[Demonstrator] = getattr(importlib.import_module(module), name)
    return loaded


def make(env: Task, n: int, noise: float) -> Demonstrator:
    """Return the demonstrator that plays n simulations of a task at once.

    Args:
        env: the task.
        n: simulations.
        noise: standard deviation of the action noise, but for noisy episodes.

    Raises:
        UserError: no demonstrator plays the task.
    """
    return demonstrator_class(env.spec)(env, n, noise)
