"""The tasks, as Brax environments on exact physics. Knows nothing of learning.

Names that need jax are imported on first use, so that tasks can be listed at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from envs.families import Family, TaskSpec, Variant
from envs.registry import ALIASES, FAMILIES, get_spec, list_tasks, make, register_family

if TYPE_CHECKING:
    from envs.task import Task
    from envs.wrappers import AutoReset, BesideBody

__all__ = [
    "ALIASES",
    "FAMILIES",
    "AutoReset",
    "BesideBody",
    "Family",
    "Task",
    "TaskSpec",
    "Variant",
    "get_spec",
    "list_tasks",
    "make",
    "register_family",
]

_LOADED_LATER = {"AutoReset": "envs.wrappers", "BesideBody": "envs.wrappers", "Task": "envs.task"}


def __getattr__(name: str) -> Any:
    if name not in _LOADED_LATER:
        raise AttributeError(f"module 'envs' has no attribute {name!r}")
    return getattr(importlib.import_module(_LOADED_LATER[name]), name)
