"""Step n simulations in a plain NumPy loop, for programs that act in NumPy too."""

from __future__ import annotations

import numpy as np

from envs.physics.mujoco.rig import Rig
from envs.physics.mujoco.stepper import BatchStepper


class Simulations:
    """Step simulations outside jax: the same bits as ``MujocoEngine`` makes of the same starts, actions and errors.

    Args:
        stepper: steps them.
        rig: what the stepper connects the model with.
        rng: what the errors of the sensors are drawn from, if there are.

    Attributes:
        qpos: float64[n, nq], exact; at a start the float32 number that was given.
        qvel: float64[n, nv], likewise.
        extra: int32[n, e], the discrete state.
        sensed: float32[n, k], what the rig senses, errors included.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    extra: np.ndarray
    sensed: np.ndarray

    def __init__(self, stepper: BatchStepper, rig: Rig, rng: np.random.Generator) -> None:
        self._stepper, self._rig, self._rng = stepper, rig, rng
        self._exact = np.zeros((0, 0))
        self._fresh = np.zeros(0, bool)

    def start(self, qpos: np.ndarray, qvel: np.ndarray, extra: np.ndarray) -> None:
        """Put n simulations at (qpos[n, nq], qvel[n, nv], extra[n, e]), rounded to float32, without a warm start."""
        qpos, qvel = np.asarray(qpos, np.float32), np.asarray(qvel, np.float32)
        n = len(qpos)
        self.extra = np.array(extra, np.int32)
        memory, self.sensed = np.zeros((n, 0)), np.zeros((n, 0), np.float32)
        if self._rig.memory_size or self._rig.sensed_size:
            memory, self.sensed = self._stepper.start(qpos, qvel, self.extra, self._errors(n))
        self.qpos, self.qvel = qpos.astype(np.float64), qvel.astype(np.float64)
        self._exact = np.concatenate([np.zeros((n, self._stepper.nstate)), memory], axis=1)
        self._fresh = np.ones(n, bool)

    def step(self, action: np.ndarray) -> None:
        """Make one control step under ``action[n, act]``."""
        n = len(self._exact)
        after = self._stepper.step(
            self._exact,
            self._fresh,
            self.qpos.astype(np.float32),
            self.qvel.astype(np.float32),
            self.extra,
            np.asarray(action, np.float32),
            self._errors(n),
        )
        self._exact, self.extra, self.sensed = after
        self.qpos, self.qvel = self._stepper.positions(after.exact)
        self._fresh = np.zeros(n, bool)

    def _errors(self, n: int) -> np.ndarray:
        return self._rng.uniform(-1.0, 1.0, (n, self._rig.noise_size)).astype(np.float32)
