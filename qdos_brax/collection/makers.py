"""Who collects a task's data, and by which recipes: trained experts in mazes, scripted demonstrators elsewhere."""

from __future__ import annotations

from typing import Protocol

from envs.mazes.maze_task import MazeTask
from envs.task import Task
from qdos_brax.collection import recipes, scripted
from qdos_brax.collection.collect import EpisodeCollector
from qdos_brax.collection.collector import Collector
from qdos_brax.collection.profiles import profile_of
from qdos_brax.collection.recipes import CollectionRecipe
from qdos_brax.collection.scripted.collector import ScriptedCollector
from qdos_brax.errors import UserError


class CollectorMaker(Protocol):
    """Make recipes and collectors for one task."""

    @property
    def heavy_noise(self) -> float:
        """Return the standard deviation of the action noise in noisy episodes."""

    def named(self, name: str, noise: float | None) -> CollectionRecipe:
        """Return OGBench's recipe "navigate", "stitch" or "explore"; see ``recipes.named``."""

    def collector(self, recipe: CollectionRecipe) -> EpisodeCollector:
        """Return what collects by a recipe."""


def maker_of(env: Task) -> CollectorMaker:
    """Return who collects the data of a task.

    Raises:
        UserError: nobody does.
    """
    return _Scripted(env) if env.spec.family in scripted.DEMONSTRATORS else _Experts(env)


class _Experts:
    def __init__(self, env: MazeTask) -> None:
        self._env, self._profile = env, profile_of(env)
        self.heavy_noise = self._profile.heavy_noise

    def named(self, name: str, noise: float | None) -> CollectionRecipe:
        return recipes.named(name, self._profile, noise)

    def collector(self, recipe: CollectionRecipe) -> EpisodeCollector:
        return Collector(self._env, recipe)


class _Scripted:
    def __init__(self, env: Task) -> None:
        self._env = env
        self.heavy_noise = scripted.demonstrator_class(env.spec).heavy_noise

    def named(self, name: str, noise: float | None) -> CollectionRecipe:
        raise UserError(
            f"--recipe {name} is for mazes; {self._env.spec.family}'s demonstrations are mixed: leave --recipe out, "
            "and set --mix or --degraded-share"
        )

    def collector(self, recipe: CollectionRecipe) -> EpisodeCollector:
        return ScriptedCollector(self._env, recipe)
