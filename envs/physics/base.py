"""What an engine is to the tasks: one control step of one body, batched by ``jax.vmap``."""

from __future__ import annotations

from typing import Any, Protocol

import jax
from flax import struct


class PipelineState(struct.PyTreeNode):
    """The simulator's state between two control steps.

    Attributes:
        qpos: float32[nq], generalised positions (units: metres, radians, unit quaternions).
        qvel: float32[nv], generalised velocities.
        carry: whatever the engine needs to go on exactly as if it had never stopped (warm start, float64 bits).
    """

    qpos: jax.Array
    qvel: jax.Array
    carry: Any


class Engine(Protocol):
    """One control step behind one interface; MJX and MuJoCo C implement it."""

    name: str
    nq: int
    nv: int
    nu: int

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PipelineState:
        """The state at rest in (qpos[nq], qvel[nv]), with no warm start."""
        ...

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        """One control step (``frame_skip`` sub-steps) under a constant ``action[nu]``."""
        ...
