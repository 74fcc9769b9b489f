"""Names of tasks: listing, aliases, making."""

from __future__ import annotations

import difflib
import importlib
import re
from typing import TYPE_CHECKING

from envs.families import FAMILIES, TaskSpec

if TYPE_CHECKING:
    from envs.task import TaskEnv

ALIASES = {
    "antmaze": "antmaze-large",
    "antsoccer": "antsoccer-arena",
    "humanoidmaze": "humanoidmaze-medium",
}


def list_tasks() -> list[TaskSpec]:
    """Every task, family by family."""
    return [
        TaskSpec(f"{name}-{maze}", name, maze, task_id, family.episode_lengths[maze])
        for name, family in FAMILIES.items()
        for maze, tasks in family.tasks.items()
        for task_id in range(1, len(tasks) + 1)
    ]


def get_spec(name: str) -> TaskSpec:
    """The task called ``name``: an alias or a name, with or without "-taskN".

    Raises:
        ValueError: there is no such task; the message proposes the nearest.
    """
    match = re.fullmatch(r"(.*?)(?:-task(\d+))?", name)
    base, task = match.group(1, 2) if match else (name, None)
    base = ALIASES.get(base, base)
    specs = {spec.full_name: spec for spec in list_tasks()}
    family = FAMILIES.get(base.split("-")[0])
    task_id = int(task) if task else family and family.default_task
    full_name = f"{base}-task{task_id}"
    if full_name in specs:
        return specs[full_name]
    known = [*ALIASES, *dict.fromkeys(spec.name for spec in specs.values()), *specs]
    near = max(known, key=lambda other: difflib.SequenceMatcher(None, other, name).ratio())
    raise ValueError(f"there is no task {name!r}; did you mean {near!r}? (tasks: {', '.join(known[: -len(specs)])})")


def make(name: str, physics: str = "auto") -> TaskEnv:
    """The environment called ``name``.

    Args:
        name: as "antmaze-large", "antmaze-large-task2" or an alias.
        physics: "mjx", "mjx-warp", "mujoco", or "auto" (MuJoCo C, for the tasks that run on it).

    Raises:
        ValueError: unknown task or engine, or one that the task or this machine does not run on; the message names the
            choices, or what to install.
    """
    spec = get_spec(name)
    family = FAMILIES[spec.family]
    from envs.physics import resolve_physics  # here and below, for physics loads jax and MuJoCo, and listing does not

    engine = resolve_physics(physics, family.engines)
    module, _, class_name = family.env_class.partition(":")
    return getattr(importlib.import_module(module), class_name)(spec, engine)
