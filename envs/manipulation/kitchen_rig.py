"""Connect the kitchen to MuJoCo C: position targets, sensors that err, subtasks that stay completed."""

from __future__ import annotations

import numpy as np
from mujoco.batch import Batch

from envs.manipulation.kitchen_model import ArmConfig
from envs.physics.mujoco.rig import Rig

FRAME_SKIP = 40
JOINTS = 9
"""The arm's: seven, and two fingers. They are the first of qpos and of qvel."""

# qpos of the start, subtasks and goals are those of gymnasium-robotics 1.4.2's FrankaKitchen-v1.
START_QPOS = np.array([
    0.148388023, -1.76848573, 1.84390296, -2.4768576, 0.260252026, 0.712533105, 1.59515394, 0.0479267505, 0.0371350919,
    -2.6627985e-4, -5.18043486e-5, 3.1287722e-5, -4.51199853e-5, -3.90842156e-6, -4.22629655e-5, 6.28065475e-5,
    4.04984708e-5, 4.62730939e-4, -2.26906415e-4, -4.65501369e-4, -6.44129196e-3, -1.77048263e-3, 1.08009684e-3,
    -0.26939744, 0.350383255, 1.61944683, 1.00618764, 4.0639512e-3, -6.62095997e-3, -2.68278933e-4,
])  # fmt: skip
GOALS: dict[str, dict[int, float]] = {
    "bottom burner": {11: -0.88, 12: -0.01},
    "top burner": {15: -0.92, 16: -0.01},
    "light switch": {17: -0.69, 18: -0.05},
    "slide cabinet": {19: 0.37},
    "hinge cabinet": {20: 0.0, 21: 1.45},
    "microwave": {22: -0.75},
    "kettle": {23: -0.23, 24: 0.75, 25: 1.62, 26: 0.99, 27: 0.0, 28: 0.0, 29: -0.06},
}
"""By subtask, numbers of qpos and what they have to be; their order is that of the discrete state."""
SUBTASKS = tuple(GOALS)
TOLERANCE = 0.3  # of the norm over a subtask's numbers, whatever their units

_SPEED = 2.0  # rad/s or m/s of an action of 1
_DT = 0.08  # s, of a control step
_ARM_ERROR, _OBJECT_ERROR = 0.01, 0.0005  # shares of the amplitudes in the arm's configuration


def complete(qpos: np.ndarray) -> np.ndarray:
    """Return bool[..., 7], which subtasks are complete at ``qpos[..., 30]`` itself, whatever was before."""
    gaps = [np.linalg.norm(qpos[..., list(goal)] - list(goal.values()), axis=-1) for goal in GOALS.values()]
    return np.stack(gaps, axis=-1) < TOLERANCE


class KitchenRig(Rig):
    """Send joint targets from where the arm last saw itself, sense the 59 numbers of the observation with their errors.

    The law is the reference's: an error of the sensors goes into the next target. The discrete state is int32[7], 1 for
    each of ``SUBTASKS`` that was complete after some control step.

    Args:
        arm: limits and errors.
    """

    memory_size = JOINTS  # the joint positions that were sensed last
    extra_size = len(SUBTASKS)
    sensed_size = noise_size = 59
    exact_qpos = START_QPOS

    def __init__(self, arm: ArmConfig) -> None:
        self._position_low, self._position_high = arm.position_bounds[:JOINTS].T
        self._velocity_low, self._velocity_high = arm.velocity_bounds[:JOINTS].T
        errors = (
            _ARM_ERROR * arm.position_noise[:JOINTS],
            _ARM_ERROR * arm.velocity_noise[:JOINTS],
            _OBJECT_ERROR * arm.position_noise[JOINTS - 1 :],  # one early: qpos has one number more than there are
            _OBJECT_ERROR * arm.velocity_noise[JOINTS:],
        )
        self._errors = np.concatenate(errors)

    def identity(self) -> bytes:
        """Return the class and all numbers."""
        numbers = (self._position_low, self._position_high, self._velocity_low, self._velocity_high, self._errors)
        return super().identity() + np.concatenate([*numbers, START_QPOS]).tobytes() + repr(GOALS).encode()

    def start(self, batch: Batch, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (joint positions, the observation), both still without errors."""
        return self._sense(batch)

    def ctrl(
        self, qpos: np.ndarray, qvel: np.ndarray, memory: np.ndarray, extra: np.ndarray, action: np.ndarray
    ) -> np.ndarray:
        """Return the targets float64[n, 9]: those sensed last, moved by the clipped action for one control step."""
        velocity = np.clip(action, -1.0, 1.0).astype(np.float64) * _SPEED
        velocity = np.clip(velocity, self._velocity_low, self._velocity_high)
        return np.clip(memory + velocity * _DT, self._position_low, self._position_high)

    def after(
        self, batch: Batch, qpos: np.ndarray, memory: np.ndarray, extra: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (joint positions, subtasks completed so far, the observation), without errors."""
        joints, sensed = self._sense(batch)
        return joints, extra | complete(batch.bind("qpos")), sensed

    def disturb(self, memory: np.ndarray, sensed: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (joint positions, the observation) with errors of ``noise`` in [-1, 1]."""
        sensed = sensed + self._errors * noise
        return sensed[:, :JOINTS], sensed

    def _sense(self, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        sensed = np.concatenate([qpos[:, :JOINTS], qvel[:, :JOINTS], qpos[:, JOINTS:], qvel[:, JOINTS:]], axis=1)
        return sensed[:, :JOINTS], sensed
