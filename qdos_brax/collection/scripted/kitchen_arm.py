"""Move the kitchen's arm: where things are in n simulations, and the actions that bring the finger tips to targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from envs.manipulation.hand_frame import HAND, TIP
from envs.manipulation.kitchen import Kitchen
from envs.manipulation.kitchen_rig import START_QPOS

JOINTS = 7  # without the fingers

_POSTURE = np.array([START_QPOS[0], -1.4, *START_QPOS[2:JOINTS]])  # what the arm's spare freedom tends to
_SPARE_GAIN = 0.1
_DAMPING = 1e-3
_LARGEST_TURN = 0.15  # rad per control step, of the hand
_LARGEST_MOVE = 0.075  # rad per control step, of a joint
_MARGIN = 0.03  # rad that targets keep from a joint's limits
_TRIES = 4
_SECONDS = 0.08  # of a control step
_SPEED = 2.0  # rad/s of an action of 1


class HandTarget(NamedTuple):
    """Hold what one hand shall do in a control step.

    Attributes:
        position: float64[3], of the finger tips, in m.
        rotation: float64[3, 3], of link 7.
        grip: whether the fingers shut.
        speed: m that the tips move at most.
    """

    position: np.ndarray
    rotation: np.ndarray
    grip: bool
    speed: float


def frame(approach: Sequence[float], opening: Sequence[float]) -> np.ndarray:
    """Return link 7's rotation float64[3, 3] with its z along ``approach`` and fingers that open along ``opening``."""
    z = np.asarray(approach, np.float64) / np.linalg.norm(approach)
    across = np.asarray(opening, np.float64)
    across = across - z * (z @ across)
    across /= np.linalg.norm(across)
    half = np.sqrt(0.5)  # the fingers sit at -45 degrees
    turn = np.array([[half, half, 0.0], [-half, half, 0.0], [0.0, 0.0, 1.0]])
    return np.stack([np.cross(across, z), across, z], axis=1) @ turn.T


class Poses:
    """Hold where everything is in n simulations; every array is overwritten by ``look``.

    Args:
        env: the task.
        n: how many.

    Attributes:
        model: what is simulated.
        qpos: float64[n, 30].
        tips: float64[n, 3], between the finger tips.
        hands: float64[n, 3, 3], rotation of link 7.
        sites: float64[n, sites, 3].
        geoms: float64[n, geoms, 3].
        geom_frames: float64[n, geoms, 3, 3].
        anchors: float64[n, joints, 3].
        axes: float64[n, joints, 3].
        bias: float64[n, 29], forces that hold against gravity.
        extra: int32[n, 7], subtasks completed so far.
    """

    def __init__(self, env: Kitchen, n: int) -> None:
        self.model = env.engine.model
        self._batch = Batch(self.model, nsim=n, nthread=min(n, 2))
        self._hand = self.model.body(HAND).id
        fields = ("qpos", "qvel", "xpos", "xmat", "site_xpos", "geom_xpos", "geom_xmat", "xanchor", "xaxis")
        bound = {name: self._batch.bind(name) for name in (*fields, "qfrc_bias")}
        self.qpos, self._qvel, self._xpos, self._xmat = (bound[name] for name in fields[:4])
        self.sites, self.geoms = bound["site_xpos"], bound["geom_xpos"]
        self.geom_frames = bound["geom_xmat"].reshape(n, -1, 3, 3)
        self.anchors, self.axes, self.bias = bound["xanchor"], bound["xaxis"], bound["qfrc_bias"]
        self.tips, self.hands = np.zeros((n, 3)), np.zeros((n, 3, 3))
        self.extra = np.zeros((n, env.extra_size), np.int32)

    def look(self, qpos: np.ndarray, qvel: np.ndarray, extra: np.ndarray) -> None:
        """Take over the states (qpos[n, 30], qvel[n, 29], extra[n, 7])."""
        self.qpos[:], self._qvel[:], self.extra[:] = qpos, qvel, extra
        self._batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
        self.hands[:] = self._xmat[:, self._hand].reshape(-1, 3, 3)
        self.tips[:] = self._xpos[:, self._hand] + TIP * self.hands[:, :, 2]


class Arm:
    """Turn targets into actions, by damped least squares at the finger tips.

    The joints' servos cover only part of a step's way, and sag under gravity; both are undone.

    Args:
        env: the task.
    """

    def __init__(self, env: Kitchen) -> None:
        model, bounds = env.engine.model, env.arm.position_bounds[:JOINTS]
        self._stiffness = model.actuator_gainprm[:JOINTS, 0].copy()
        self._covered = 1 - np.exp(-_SECONDS * self._stiffness / model.dof_damping[:JOINTS])
        self._low = np.maximum(model.jnt_range[:JOINTS, 0], bounds[:, 0]) + _MARGIN
        self._high = np.minimum(model.jnt_range[:JOINTS, 1], bounds[:, 1]) - _MARGIN

    def actions(self, poses: Poses, targets: Sequence[HandTarget]) -> np.ndarray:
        """Return float64[n, 9] in [-1, 1], which move the hands towards ``targets[n]``."""
        positions, rotations, grips, speeds = (np.array(part) for part in zip(*targets, strict=True))
        error = np.concatenate(
            [
                _shortened(positions - poses.tips, speeds),
                _shortened(0.5 * np.cross(poses.hands, rotations, axis=1).sum(axis=2), _LARGEST_TURN),
            ],
            axis=1,
        )
        moves = np.clip(self._moves(poses, error), -_LARGEST_MOVE, _LARGEST_MOVE)
        offsets = moves / self._covered + poses.bias[:, :JOINTS] / self._stiffness
        fingers = np.where(grips, -1.0, 1.0)[:, None]
        return np.clip(np.concatenate([offsets / (_SPEED * _SECONDS), fingers, fingers], axis=1), -1.0, 1.0)

    def _moves(self, poses: Poses, error: np.ndarray) -> np.ndarray:
        """Return the joints' moves float64[n, 7] that undo ``error`` (position, rotation: float64[n, 6])."""
        axes, anchors = poses.axes[:, :JOINTS], poses.anchors[:, :JOINTS]
        jacobian = np.concatenate([np.cross(axes, poses.tips[:, None] - anchors), axes], axis=2).swapaxes(1, 2)
        joints = poses.qpos[:, :JOINTS]
        spare = _SPARE_GAIN * (_POSTURE - joints)
        free = np.ones_like(joints)
        for _ in range(_TRIES):  # joints that would leave their range stay, and the others make up for it
            reach = jacobian * free[:, None]
            square = reach @ reach.swapaxes(1, 2) + _DAMPING * np.eye(6)
            wanted = error - (jacobian @ (free * spare)[:, :, None])[:, :, 0]
            moves = (reach.swapaxes(1, 2) @ np.linalg.solve(square, wanted[:, :, None]))[:, :, 0] + free * spare
            beyond = ((joints + moves < self._low) & (moves < 0)) | ((joints + moves > self._high) & (moves > 0))
            beyond &= free > 0
            if not beyond.any():
                break
            free[beyond] = 0.0
        return moves


def _shortened(vectors: np.ndarray, length: np.ndarray | float) -> np.ndarray:
    """Return ``vectors[n, 3]``, no longer than ``length``."""
    norms = np.linalg.norm(vectors, axis=1)
    return vectors * np.minimum(1.0, length / np.maximum(norms, 1e-9))[:, None]
