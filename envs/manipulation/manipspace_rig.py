"""Connect OGBench's arm to MuJoCo C: relative moves of the hand, inverse kinematics, what the arm senses."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch

from envs.manipulation import poses
from envs.manipulation.arm_kinematics import ArmKinematics
from envs.manipulation.ogbench_model import PINCH, ManipSpace
from envs.physics.mujoco.rig import Rig

FRAME_SKIP = 25
ARM_JOINTS, GRIPPER_JOINT, ROBOT_JOINTS = slice(0, 6), 6, 14
"""Places in qpos and in qvel: the arm's, the driver of the gripper's right finger; how many the robot has in all."""
CENTRE = np.array([0.425, 0.0, 0.0])
"""Place that positions in observations are relative to, in m; they are in units of 0.1 m."""
PLACE_SCALE, GRIPPER_SCALE = 10.0, 3.0
HAND_COLUMN, ROBOT_COLUMNS, CUBE_COLUMNS = 12, 19, 9
"""In an observation: where the hand's place begins, how many numbers the robot has and, behind them, each cube."""
WORKSPACE = np.array([[0.25, -0.35, 0.02], [0.6, 0.35, 0.35]])
"""Between which places the hand is sent, in m."""

# Numbers of the control law and of the observation are those of OGBench 1.2.2's ``ManipSpaceEnv``.
_MOVE = np.array([0.05, 0.05, 0.05, 0.3, 1.0])  # m, m, m, rad and share of the gripper, of an action of 1
_CLOSED = 0.8  # rad, of the gripper's driver
_FULL_GRIP = 255.0  # control of the gripper that shuts it
_FIRM_CONTACT = 50.0  # N, of the force on the right pad that is sensed as 1
_PAD = "ur5e/robotiq/right_pad"


class ManipSpaceRig(Rig):
    """Move the hand relative to where it is, hold the joints' targets for a control step, sense the observation.

    The observation holds the cubes too; subclasses sense what else there is. As in the reference, what the rig knows of
    the hand is one sub-step old, unless a forward pass follows the step.

    Args:
        space: model and kinematics.
    """

    action_size = 5
    memory_size = 12  # place and orientation matrix of the hand
    fields = ("site_xpos", "site_xmat", "cfrc_ext")

    def __init__(self, space: ManipSpace) -> None:
        model = space.stepped
        self._kinematics = ArmKinematics(space.arm)
        self._pinch_to_flange = space.pinch_to_flange
        self._arm_home = space.arm_home
        self._pinch = model.site(PINCH).id
        self._pad = model.body(_PAD).id
        self._identity = np.concatenate([_MOVE, WORKSPACE.ravel(), space.pinch_to_flange]).tobytes()
        self._cubes = [
            int(model.jnt_qposadr[i]) for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_FREE
        ]
        self.sensed_size = ROBOT_COLUMNS + CUBE_COLUMNS * len(self._cubes)

    def identity(self) -> bytes:
        """Return the class and all numbers."""
        return super().identity() + self._identity

    def arm_start(self, place: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """Return the joints float64[n, 6] with the hand at ``place[n, 3]`` (m), turned by ``yaw[n]`` (rad)."""
        turn = poses.multiply(poses.from_yaw(np.asarray(yaw, np.float64)), poses.DOWN)
        return self._joints(np.asarray(place, np.float64), turn, np.tile(self._arm_home, (len(place), 1)))

    def start(self, batch: Batch, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (pose of the hand, the observation), both of the very state."""
        self.before(batch, extra)
        batch.forward()
        return self._sense(batch, self._contact(batch), extra)

    def ctrl(
        self, qpos: np.ndarray, qvel: np.ndarray, memory: np.ndarray, extra: np.ndarray, action: np.ndarray
    ) -> np.ndarray:
        """Return the targets of the joints and the gripper's control, float64[n, 7], for the clipped action."""
        # In float32 up to the product, as the reference computes it for actions of that type.
        move = 0.5 * (np.clip(action, -1.0, 1.0) + 1) * (2.0 * _MOVE) - _MOVE
        place = np.clip(memory[:, :3] + move[:, :3], *WORKSPACE)
        yaw = poses.yaw(poses.from_matrices(memory[:, 3:]))
        turn = poses.multiply(poses.from_yaw(move[:, 3]), poses.from_yaw(yaw))
        yaw = np.clip(poses.yaw(poses.multiply(turn, poses.inverse(poses.DOWN))), -np.pi, np.pi)
        joints = self._joints(place, poses.multiply(poses.from_yaw(yaw), poses.DOWN), qpos[:, ARM_JOINTS])
        grip = np.clip(_opening(qpos) + move[:, 4:], 0.0, 1.0)
        return np.concatenate([joints, _FULL_GRIP * grip], axis=1)

    def after(
        self, batch: Batch, qpos: np.ndarray, memory: np.ndarray, extra: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (pose of the hand, the discrete state, the observation)."""
        memory, sensed = self._sense(batch, self._contact(batch), extra)
        return memory, extra, sensed

    def _joints(self, place: np.ndarray, turn: np.ndarray, qpos: np.ndarray) -> np.ndarray:
        """Return the joints float64[n, 6] that bring the hand to a pose, found from ``qpos[n, 6]``."""
        rotation, offset = self._pinch_to_flange[:4], self._pinch_to_flange[4:]
        flange = poses.rotate(turn, offset) + place
        return self._kinematics.solve(flange, poses.multiply(turn, rotation), qpos)

    def _contact(self, batch: Batch) -> np.ndarray:
        """Return float64[n, 1], how hard the right pad is touched, in [0, 1]."""
        force = batch.bind("cfrc_ext")[:, self._pad]
        return np.clip(np.sqrt((force**2).sum(axis=1, keepdims=True)) / _FIRM_CONTACT, 0, 1)

    def _sense(self, batch: Batch, contact: np.ndarray, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (memory, observation) of what the batch holds; NaN where a state is not finite."""
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        place = batch.bind("site_xpos")[:, self._pinch]
        memory = np.concatenate([place, batch.bind("site_xmat")[:, self._pinch].reshape(-1, 9)], axis=1)
        if not np.isfinite(batch.state).all():  # such a simulation is not stepped: these are of another one
            memory = np.where(np.isfinite(batch.state).all(axis=1, keepdims=True), memory, np.nan)
        yaw = poses.yaw(poses.from_matrices(memory[:, 3:]))[:, None]
        parts = [
            qpos[:, ARM_JOINTS],
            qvel[:, ARM_JOINTS],
            (memory[:, :3] - CENTRE) * PLACE_SCALE,
            np.cos(yaw),
            np.sin(yaw),
            _opening(qpos) * GRIPPER_SCALE,
            contact,
            *self._objects(qpos, qvel, extra),
        ]
        return memory, np.concatenate(parts, axis=1).astype(np.float32)

    def _objects(self, qpos: np.ndarray, qvel: np.ndarray, extra: np.ndarray) -> list[np.ndarray]:
        """Return the columns of the observation that are of the table; here the cubes."""
        columns = []
        for first in self._cubes:
            place, turn = qpos[:, first : first + 3], qpos[:, first + 3 : first + 7]
            yaw = poses.yaw(turn)[:, None]
            columns += [(place - CENTRE) * PLACE_SCALE, turn, np.cos(yaw), np.sin(yaw)]
        return columns


def _opening(qpos: np.ndarray) -> np.ndarray:
    """Return float64[n, 1], how far the gripper is shut, in [0, 1]; OGBench calls it its opening."""
    return np.clip(qpos[:, GRIPPER_JOINT, None] / _CLOSED, 0, 1)
