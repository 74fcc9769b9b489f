"""Define what an engine is to the tasks: one control step of one simulation, batched by ``jax.vmap``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct


class PipelineState(struct.PyTreeNode):
    """Hold the simulator's state between two control steps.

    Attributes:
        qpos: float32[nq], generalised positions (units: metres, radians, unit quaternions).
        qvel: float32[nv], generalised velocities.
        sensed: float32[k], what the task observes besides qpos and qvel, of this very state; k is 0 for most tasks.
        extra: int32[e], discrete state that the physics does not know, such as buttons; e is 0 for most tasks.
        carry: whatever the engine needs to go on exactly as if it had never stopped (warm start, float64 bits).
        steps: int32, control steps since ``init``. They are counted here and not in ``State.info``, where Brax's own
            wrappers keep a count of theirs, and a wrapper that puts an earlier state back puts its count back too.
    """

    qpos: jax.Array
    qvel: jax.Array
    sensed: jax.Array
    extra: jax.Array
    carry: Any
    steps: jax.Array


@dataclass(frozen=True)
class Sensors:
    """Read what a body senses of its own posture, as DeepMind Control's humanoid does.

    Attributes:
        root: the body in whose frame the limbs are seen.
        heights: bodies whose height above the floor is sensed.
        limbs: bodies whose position relative to the root is sensed.
        velocity: name of the model's sensor (size 3) of the centre of mass' velocity.
    """

    root: str
    heights: tuple[str, ...]
    limbs: tuple[str, ...]
    velocity: str

    @property
    def size(self) -> int:
        """Return the numbers per state: heights, limbs, the root's uprightness, the velocity."""
        return len(self.heights) + 3 * len(self.limbs) + 6

    def read(self, model: mujoco.MjModel, xpos: Any, xmat: Any, sensordata: Any) -> Any:
        """Return the numbers [..., size] of states after a forward pass; NumPy in, NumPy out, jax likewise.

        Args:
            model: names bodies and sensors.
            xpos: [..., nbody, 3], positions of the bodies.
            xmat: [..., nbody, 3, 3], their orientations; the root's last row is the vertical as the root sees it.
            sensordata: [..., nsensordata].
        """
        xp = jnp if isinstance(xpos, jax.Array) else np
        root = model.body(self.root).id
        heights = xpos[..., [model.body(name).id for name in self.heights], 2]
        limbs = xpos[..., [model.body(name).id for name in self.limbs], :] - xpos[..., root, None, :]
        in_root_frame = (limbs @ xmat[..., root, :, :]).reshape(*heights.shape[:-1], -1)
        first = model.sensor(self.velocity).adr[0]
        velocity = sensordata[..., first : first + 3]
        return xp.concatenate([heights, in_root_frame, xmat[..., root, 2, :], velocity], axis=-1)


class Engine(Protocol):
    """Make control steps; MJX and MuJoCo C implement it.

    Attributes:
        name: "mujoco", "mjx" or "mjx-warp".
        model: what is stepped.
        frame_skip: sub-steps per control step.
        nq: size of qpos.
        nv: size of qvel.
        action_size: numbers per action.
        extra_size: size of the discrete state.
    """

    name: str
    model: mujoco.MjModel
    frame_skip: int
    nq: int
    nv: int
    action_size: int
    extra_size: int

    def init(
        self, qpos: jax.Array, qvel: jax.Array, extra: jax.Array | None = None, key: jax.Array | None = None
    ) -> PipelineState:
        """Return the state at (qpos[nq], qvel[nv], extra[e]), with no warm start; None takes zeros as ``extra``.

        Sensors that err draw their errors from ``key``; None takes a fixed one.
        """
        ...

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        """Return the state after one control step (``frame_skip`` sub-steps) under ``action[act]``.

        Starts from ``state.qpos``, ``state.qvel`` and ``state.extra``, also where they were changed since the last
        step.
        """
        ...

    def idle(self, state: PipelineState, over: jax.Array) -> PipelineState:
        """Return what to step in place of ``state`` if nobody reads the result where ``over`` (bool) is True.

        The engine may leave such simulations out. The others step as they would have.
        """
        ...
