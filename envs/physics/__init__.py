"""Choose an engine: each makes control steps of physics behind one interface."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence

import jax

from envs.physics.base import Engine, PipelineState, Sensors
from envs.physics.mujoco.engine import MujocoEngine

__all__ = ["ENGINES", "Engine", "MujocoEngine", "PipelineState", "Sensors", "resolve_physics", "why_not"]

ENGINES = ("mjx", "mjx-warp", "mujoco")


def resolve_physics(physics: str, supported: Sequence[str] = ENGINES) -> str:
    """Return the engine's name; "auto" takes MuJoCo C, beside an accelerator too.

    With 64 environments 16 cores make 15 times the steps of MJX on an H200; MJX passes them near 2,000 (interpolated),
    more than a run here steps at a time (results/physics-gpu.json).

    Args:
        physics: what the user asked for.
        supported: the engines that the task runs on; "auto" takes one of them.

    Raises:
        ValueError: there is no such engine, the task does not run on it, or this machine cannot; the message says what
            to install or to choose.
    """
    if physics == "auto":
        return "mujoco" if "mujoco" in supported else supported[0]
    if physics not in ENGINES:
        raise ValueError(f"there is no physics engine {physics!r}; choose auto, {_either(ENGINES)}")
    if physics not in supported:
        raise ValueError(f"this task does not run on {physics!r}; choose auto or {_either(supported)}")
    obstacle = why_not(physics)
    if obstacle:
        raise ValueError(f"physics {physics!r} cannot run here: {obstacle}")
    return physics


def why_not(physics: str) -> str:
    """Return why this machine cannot run the engine, and the remedy; empty where it can."""
    if physics != "mjx-warp":
        return ""
    if importlib.util.find_spec("warp") is None:
        return "the package warp-lang is not installed; run: pip install -c constraints.txt -e '.[warp]'"
    try:
        jax.devices("cuda")
    except RuntimeError:
        found = jax.default_backend()
        return f"it needs a CUDA device, and jax has only {found!r}; install jax[cuda13], or choose mjx or mujoco"
    return ""


def _either(names: Sequence[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last
