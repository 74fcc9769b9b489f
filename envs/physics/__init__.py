"""One control step of physics: two engines behind one interface."""

from __future__ import annotations

from collections.abc import Sequence

import jax

from envs.physics.base import Engine, PipelineState, Sensors
from envs.physics.mujoco_engine import MujocoEngine

__all__ = ["Engine", "MujocoEngine", "PipelineState", "Sensors", "resolve_physics"]

ENGINES = ("mjx", "mujoco")


def resolve_physics(physics: str, supported: Sequence[str] = ENGINES) -> str:
    """The engine's name; "auto" takes MuJoCo C where jax has only a CPU, MJX on an accelerator.

    Args:
        physics: what the user asked for.
        supported: the engines that the task runs on; "auto" takes one of them.

    Raises:
        ValueError: there is no such engine, or the task does not run on it.
    """
    if physics == "auto":
        best = "mujoco" if jax.default_backend() == "cpu" else "mjx"
        return best if best in supported else supported[0]
    if physics not in ENGINES:
        raise ValueError(f"there is no physics engine {physics!r}; choose auto, {' or '.join(ENGINES)}")
    if physics not in supported:
        raise ValueError(f"this task does not run on {physics!r}; choose auto or {' or '.join(supported)}")
    return physics
