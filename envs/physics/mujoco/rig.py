"""Connect a task to MuJoCo C: what turns actions into controls, and what happens before and after the steps."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch


class Rig:
    """Connect a task to the batches of simulations that MuJoCo C steps; this one passes actions on as controls.

    Subclasses replace what they need. All methods work on n simulations at once, in NumPy alone, since they run inside
    a callback of a compiled program; several threads may call them at once, each with a batch of its own.

    Attributes:
        action_size: numbers per action; None takes the model's number of controls.
        memory_size: float64 numbers that the rig carries from one control step to the next.
        extra_size: numbers of the discrete state ``PipelineState.extra``.
        sensed_size: float32 numbers that the task observes besides qpos and qvel.
        noise_size: numbers, uniform in [-1, 1), that jax draws for every state, for sensors that err.
        exact_qpos: float64[nq], where a task starts: a fresh state that is its rounding to float32 stands for it. None:
            there is no such place.
        fields: fields of MjData that ``start`` and ``after`` read with ``batch.bind``.
        stage: how far the forward pass after the last sub-step goes (``mujoco.mjtStage``), for these fields.
    """

    action_size: int | None = None
    memory_size: int = 0
    extra_size: int = 0
    sensed_size: int = 0
    noise_size: int = 0
    exact_qpos: np.ndarray | None = None
    fields: tuple[str, ...] = ()
    stage: mujoco.mjtStage = mujoco.mjtStage.mjSTAGE_NONE

    def identity(self) -> bytes:
        """Return all that decides what the rig computes: a compiled program in a cache finds its engine by it.

        Subclasses with arguments of their own add them.
        """
        return f"{type(self).__module__}.{type(self).__qualname__}".encode()

    def start(self, batch: Batch, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (memory float64[n, m], sensed float32[n, k]) of a start, after a forward pass of ``batch``.

        It is called only if the rig has one of the two.
        """
        return np.zeros((batch.nsim, self.memory_size)), np.zeros((batch.nsim, self.sensed_size), np.float32)

    def before(self, batch: Batch, extra: np.ndarray) -> None:
        """Change the simulations' models before a control step, by ``batch.expand`` of the model's fields."""

    def ctrl(
        self, qpos: np.ndarray, qvel: np.ndarray, memory: np.ndarray, extra: np.ndarray, action: np.ndarray
    ) -> np.ndarray:
        """Return the controls float64[n, nu], constant over the sub-steps; they may be NaN where the state is.

        Args:
            qpos: float64[n, nq], before the control step.
            qvel: float64[n, nv].
            memory: float64[n, m].
            extra: int32[n, e].
            action: float32[n, act].
        """
        return action

    def after(
        self, batch: Batch, qpos: np.ndarray, memory: np.ndarray, extra: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (memory, extra, sensed float32[n, k]) after a control step.

        Args:
            batch: holds the new states, after a forward pass up to ``stage``.
            qpos: float64[n, nq], before the control step.
            memory: float64[n, m], before it.
            extra: int32[n, e], before it.
        """
        return memory, extra, np.zeros((batch.nsim, self.sensed_size), np.float32)

    def disturb(self, memory: np.ndarray, sensed: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (memory, sensed) of ``start`` and ``after`` with the errors of the sensors.

        It is called only if ``noise_size`` is not 0, and may be given ``sensed`` in float64, as those returned it.

        Args:
            memory: float64[n, m].
            sensed: [n, k].
            noise: float32[n, noise_size].
        """
        return memory, sensed
