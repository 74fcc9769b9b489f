"""One control step of physics: two engines behind one interface."""

from __future__ import annotations

import jax
import mujoco

from envs.maze import Maze
from envs.physics.base import Engine, PipelineState
from envs.physics.mujoco_engine import MujocoEngine

__all__ = ["Engine", "MujocoEngine", "PipelineState", "make_engine", "resolve_physics"]

ENGINES = ("mjx", "mujoco")


def resolve_physics(physics: str) -> str:
    """The engine's name; "auto" takes MuJoCo C where jax has only a CPU, MJX on an accelerator.

    Raises:
        ValueError: there is no such engine.
    """
    if physics == "auto":
        return "mujoco" if jax.default_backend() == "cpu" else "mjx"
    if physics not in ENGINES:
        raise ValueError(f"there is no physics engine {physics!r}; choose auto, {' or '.join(ENGINES)}")
    return physics


def make_engine(physics: str, model: mujoco.MjModel, layout: Maze) -> Engine:
    """The engine called ``physics`` for the whole-maze ``model`` of ``layout``."""
    if resolve_physics(physics) == "mujoco":
        return MujocoEngine(model)
    from envs.physics.mjx_engine import MjxEngine  # imported here, for MJX takes seconds to load

    return MjxEngine(layout, ball=model.nq > 15)
