"""Scripted demonstrators, by the family of tasks that they play."""

from __future__ import annotations

import importlib

from envs.families import TaskSpec
from envs.task import Task
from qdos_brax.collection.scripted.demonstrator import Demonstrator

DEMONSTRATORS: dict[str, str | type[Demonstrator]] = {
    "kitchen": "qdos_brax.collection.scripted.kitchen:KitchenDemonstrator",
    "cube": "qdos_brax.collection.scripted.manipspace:CubeDemonstrator",
    "scene": "qdos_brax.collection.scripted.manipspace:SceneDemonstrator",
}
"""The class that plays a family; as "module:class" it is imported on first use, since some need packages."""


def register_demonstrator(family: str, demonstrator: str | type[Demonstrator]) -> None:
    """Register the class, or "module:class", that plays the tasks of ``family``.

    Raises:
        ValueError: the family already has one.
    """
    if family in DEMONSTRATORS:
        raise ValueError(f"there is already a demonstrator of {family!r}")
    DEMONSTRATORS[family] = demonstrator


def demonstrator_class(spec: TaskSpec) -> type[Demonstrator]:
    """Return the class that plays a task whose family is among ``DEMONSTRATORS``."""
    found = DEMONSTRATORS[spec.family]
    if not isinstance(found, str):
        return found
    module, _, name = found.partition(":")
    loaded: type[Demonstrator] = getattr(importlib.import_module(module), name)
    return loaded


def make(env: Task, n: int, noise: float) -> Demonstrator:
    """Return a demonstrator that plays n simulations of a task at once.

    Args:
        env: the task, of a family among ``DEMONSTRATORS``.
        n: simulations.
        noise: standard deviation of the action noise, but for noisy episodes.
    """
    return demonstrator_class(env.spec)(env, n, noise)
