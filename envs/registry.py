"""Names of tasks: listing, aliases, making."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping, Sequence

from envs import locomotion, soccer
from envs.physics import resolve_physics
from envs.task import TaskEnv, TaskSpec

ALIASES = {"antmaze": "antmaze-large", "antsoccer": "antsoccer-arena"}

_Family = tuple[Callable[[TaskSpec, str], TaskEnv], Mapping[str, Sequence[object]]]  # class, cells of the tasks

_FAMILIES: dict[str, _Family] = {
    "antmaze": (locomotion.AntMaze, locomotion.TASKS),
    "antsoccer": (soccer.AntSoccer, soccer.TASKS),
}
_DEFAULT_TASK = {"antmaze": 1, "antsoccer": 4}  # as OGBench's single-task mode
_EPISODE_LENGTH = 1000


def list_tasks() -> list[TaskSpec]:
    """Every task, family by family."""
    return [
        TaskSpec(f"{family}-{maze}", family, maze, task_id, _EPISODE_LENGTH)
        for family, (_, tasks) in _FAMILIES.items()
        for maze, cells in tasks.items()
        for task_id in range(1, len(cells) + 1)
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
    task_id = _DEFAULT_TASK.get(base.split("-")[0]) if task is None else int(task)
    full_name = f"{base}-task{task_id}"
    if full_name in specs:
        return specs[full_name]
    known = [*ALIASES, *dict.fromkeys(spec.name for spec in specs.values()), *specs]
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
    raise ValueError(f"there is no task {name!r}; did you mean {near!r}? (tasks: {', '.join(known[: -len(specs)])})")


def make(name: str, physics: str = "auto") -> TaskEnv:
    """The environment called ``name``.

    Args:
        name: as "antmaze-large", "antmaze-large-task2" or an alias.
        physics: "mjx", "mujoco", or "auto": MuJoCo C where jax has only a CPU, MJX on an accelerator.

    Raises:
        ValueError: unknown task or engine; the message names the choices.
    """
    spec = get_spec(name)
    env_class, _ = _FAMILIES[spec.family]
    return env_class(spec, resolve_physics(physics))
