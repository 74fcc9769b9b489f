"""Register families of tasks, list their tasks and make them by name."""

from __future__ import annotations

import difflib
import importlib
import re
from typing import TYPE_CHECKING, Any

from envs.families import Family, TaskSpec
from envs.manipulation.families import MANIPULATION_FAMILIES
from envs.mazes.families import MAZE_FAMILIES

if TYPE_CHECKING:
    from envs.task import Task

FAMILIES: dict[str, Family] = {}
ALIASES: dict[str, str] = {}
"""What the name of a family alone stands for."""


def register_family(name: str, family: Family) -> None:
    """Make the tasks of ``family`` known under ``name``, the first word of their names.

    Raises:
        ValueError: another family has that name, the name is no single word, or the default variant is unknown.
    """
    if not re.fullmatch(r"[a-z0-9]+", name):
        raise ValueError(f"a family's name is one word of a-z and 0-9, not {name!r}")
    if name in FAMILIES:
        raise ValueError(f"there is already a family {name!r}")
    if family.default_variant not in family.variants:
        raise ValueError(f"family {name!r} has no variant {family.default_variant!r} to take by default")
    FAMILIES[name] = family
    variant = f"-{family.default_variant}" if family.default_variant else ""
    task = "" if family.alias_task is None else f"-task{family.alias_task}"
    if variant or task:
        ALIASES[name] = f"{name}{variant}{task}"


def list_tasks() -> list[TaskSpec]:
    """Return every task, family by family."""
    return [
        TaskSpec(name, key, task_id, variant.episode_length)
        for name, family in FAMILIES.items()
        for key, variant in family.variants.items()
        for task_id in range(1, variant.num_tasks + 1)
    ]


def get_spec(name: str) -> TaskSpec:
    """Return the task called ``name``: an alias or a name, with or without "-taskN".

    Raises:
        ValueError: there is no such task; the message proposes the nearest.
    """
    base, task = _split(ALIASES.get(name, name))
    base = _split(ALIASES.get(base, base))[0]
    specs = {spec.full_name: spec for spec in list_tasks()}
    family = FAMILIES.get(base.split("-")[0])
    task_id = int(task) if task else family and family.default_task
    full_name = f"{base}-task{task_id}"
    if full_name in specs:
        return specs[full_name]
    known = [*dict.fromkeys([*ALIASES, *(spec.name for spec in specs.values())]), *specs]
    near = max(known, key=lambda other: difflib.SequenceMatcher(None, other, name).ratio())
    raise ValueError(f"there is no task {name!r}; did you mean {near!r}? (tasks: {', '.join(known[: -len(specs)])})")


def _split(name: str) -> tuple[str, str | None]:
    """Return the name without "-taskN", and N."""
    base, _, task = name.rpartition("-task")
    return (base, task) if base and task.isdecimal() else (name, None)


def make(name: str, physics: str = "auto") -> Task:
    """Return the environment called ``name``.

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
    return _load(family.make)(spec, engine)


def _load(make: Any) -> Any:
    """Return what makes a family's environments, imported where it is given by name."""
    if not isinstance(make, str):
        return make
    module, _, name = make.partition(":")
    return getattr(importlib.import_module(module), name)


for _name, _family in (MAZE_FAMILIES | MANIPULATION_FAMILIES).items():
    register_family(_name, _family)
