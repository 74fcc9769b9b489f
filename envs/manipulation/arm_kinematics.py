"""Solve the inverse kinematics of many arms at once, as OGBench's ``DiffIKController`` does for one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np
from mujoco.batch import Batch

from envs.manipulation.ogbench_model import FLANGE

_ROUNDS = 20
_TOLERANCE = 1e-4  # of place (m) and of turn (rad)
_LARGEST_TURN = np.radians(45)  # of a joint per round
_DAMPING = 1e-12 * np.eye(6)
_POS = int(mujoco.mjtStage.mjSTAGE_POS)


class ArmKinematics:
    """Find joint angles that bring the flange to a pose, by damped least squares; threads may call it at once.

    The numbers are the reference's, bit for bit.

    Args:
        arm: the model of the arm alone.
    """

    def __init__(self, arm: mujoco.MjModel) -> None:
        self._model = _without_contacts(arm)
        self._site = self._model.site(FLANGE).id
        self._body = int(self._model.site_bodyid[self._site])
        self._idle: dict[int, list[Batch]] = defaultdict(list)

    def solve(self, pos: np.ndarray, quat: np.ndarray, qpos: np.ndarray) -> np.ndarray:
        """Return the joints float64[n, 6] after at most 20 rounds; NaN where the start or the pose is not finite.

        Args:
            pos: float64[n, 3], where the flange shall be.
            quat: float64[n, 4], how it shall be turned.
            qpos: float64[n, 6], joints to start from.
        """
        joints = np.array(qpos, np.float64)
        sound = np.isfinite(np.concatenate([pos, quat, qpos], axis=1)).all(axis=1)
        joints[~sound] = np.nan
        with self._batch(len(joints)) as batch:
            self._approach(batch, pos, quat, joints, np.flatnonzero(sound))
        return joints

    def _approach(self, batch: Batch, pos: np.ndarray, quat: np.ndarray, joints: np.ndarray, left: np.ndarray) -> None:
        """Change ``joints`` until those ``left`` (int[k]) are there."""
        for _ in range(_ROUNDS):
            batch.bind("qpos")[left] = joints[left]
            batch.forward(ids=left, stage=_POS)
            place = batch.bind("site_xpos")[left, self._site]
            turn = _turns(batch.bind("site_xmat")[left, self._site].reshape(-1, 9), quat[left])
            gap = np.concatenate([pos[left] - place, turn], axis=1)
            far = (_norms(gap[:, :3]) > _TOLERANCE) | (_norms(gap[:, 3:]) > _TOLERANCE)
            left, place, gap = left[far], place[far], gap[far]
            if not len(left):
                return
            jacobian = np.concatenate(batch.jac(self._body, place, ids=left), axis=1)
            joints[left] += _update(jacobian, gap)

    @contextmanager
    def _batch(self, n: int) -> Iterator[Batch]:
        """Yield a batch of n that no other thread uses."""
        try:
            batch = self._idle[n].pop()
        except IndexError:
            batch = Batch(self._model, nsim=n, nthread=1)
            for name in ("site_xpos", "site_xmat"):
                batch.bind(name)
        yield batch
        self._idle[n].append(batch)


def _without_contacts(arm: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy for kinematics alone."""
    model: mujoco.MjModel = arm.__copy__()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return model


def _turns(mats: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Return the rotation vectors float64[n, 3] from the orientations ``mats[n, 9]`` to ``quats[n, 4]``."""
    turns, now, left = np.empty((len(mats), 3)), np.empty(4), np.empty(4)
    for turn, mat, quat in zip(turns, mats, quats, strict=True):
        mujoco.mju_mat2Quat(now, mat)
        mujoco.mju_negQuat(now, now)
        mujoco.mju_mulQuat(left, quat, now)
        mujoco.mju_quat2Vel(turn, left, 1.0)
    return turns


def _norms(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt((vectors**2).sum(axis=1))


def _update(jacobian: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Return the changes float64[n, 6] of the joints, scaled down to the largest turn, for ``jacobian[n, 6, 6]``."""
    transposed = jacobian.transpose(0, 2, 1)
    changes: np.ndarray = (transposed @ np.linalg.solve(jacobian @ transposed + _DAMPING, gap[:, :, None]))[:, :, 0]
    largest = np.abs(changes).max(axis=1, keepdims=True)
    return np.where(largest > _LARGEST_TURN, changes * (_LARGEST_TURN / largest), changes)
