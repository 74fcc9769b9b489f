"""Describe tasks as plain data: families, variants, caps, engines. Loads no jax, so that listing is quick."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Variant:
    """Describe the tasks of a family that share one scene, such as one maze.

    Attributes:
        observation_size: numbers per observation.
        action_size: numbers per action, each in [-1, 1].
        episode_length: cap in control steps.
        num_tasks: how many tasks there are, numbered from 1.
    """

    observation_size: int
    action_size: int
    episode_length: int
    num_tasks: int = 1


@dataclass(frozen=True)
class Family:
    """Describe tasks that have much in common, such as the body.

    Attributes:
        make: the environment's class, or any function of (``TaskSpec``, engine name) that returns a ``Task``; as
            "module:name" it is imported on first use.
        engines: the engines it runs on: "mujoco" (MuJoCo C), "mjx", "mjx-warp" (MuJoCo Warp, on CUDA).
        variants: by name, as "large"; "" where the family's own name is the task's.
        default_variant: the one that the family's name alone stands for.
        default_task: the task of a variant's name without "-taskN" (as OGBench's single-task mode).
        alias_task: the task that the family's name alone stands for; None for ``default_task``.
    """

    make: str | Callable[[TaskSpec, str], Any]
    engines: tuple[str, ...]
    variants: Mapping[str, Variant]
    default_variant: str
    default_task: int = 1
    alias_task: int | None = None


@dataclass(frozen=True)
class TaskSpec:
    """Identify a task.

    Attributes:
        family: a key of ``envs.FAMILIES``.
        variant: one of the family's variants.
        task_id: counts from 1.
        episode_length: cap in control steps.
    """

    family: str
    variant: str
    task_id: int
    episode_length: int

    @property
    def name(self) -> str:
        """Return family and variant, as "antmaze-large"."""
        return f"{self.family}-{self.variant}" if self.variant else self.family

    @property
    def full_name(self) -> str:
        """Return the name with its task, as "antmaze-large-task1"."""
        return f"{self.name}-task{self.task_id}"
