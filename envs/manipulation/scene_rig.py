"""Connect OGBench's scene to MuJoCo C: buttons that flip, and lock and unlock the drawer and the window."""

from __future__ import annotations

import numpy as np
from mujoco.batch import Batch

from envs.manipulation.manipspace_rig import ManipSpaceRig
from envs.manipulation.ogbench_model import ManipSpace

BUTTONS = ("buttonbox_joint_0", "buttonbox_joint_1")
SLIDES = ("drawer_slide", "window_slide")
"""Joints of what the buttons, in this order, lock."""

# Numbers are those of OGBench 1.2.2's ``SceneEnv``.
_PRESSED = -0.02  # m, how deep a button is when it flips
_LOCKED, _FREE = 1e6, 2.0  # damping, in N s/m
_BUTTON_SCALE, _DRAWER_SCALE, _WINDOW_SCALE = 120.0, 18.0, 15.0
_BOUNDS = np.array([[0.05, -0.55, -0.18], [0.8, 0.55, 0.55]])  # m, beyond which a cube was shot out by an instability


class SceneRig(ManipSpaceRig):
    """Lock the drawer and the window as the buttons say, and observe all that is on the table.

    The discrete state is int32[2], the buttons: 1 unlocks. What the rig knows of the hand is of the very state, as in
    the reference, which makes a forward pass after each control step. A cube that is out of all bounds is put back on
    the table, at random as there, drawn from the bits of the state.

    Args:
        space: model and kinematics.
    """

    extra_size = len(BUTTONS)

    def __init__(self, space: ManipSpace) -> None:
        super().__init__(space)
        self.sensed_size += 12
        self._object_bounds = space.object_bounds
        model = space.stepped
        self._buttons = [int(model.joint(name).qposadr[0]) for name in BUTTONS]
        self._button_speeds = [int(model.joint(name).dofadr[0]) for name in BUTTONS]
        self._slides = [int(model.joint(name).qposadr[0]) for name in SLIDES]
        self._slide_speeds = [int(model.joint(name).dofadr[0]) for name in SLIDES]
        first = int(model.joint("object_joint_0").dofadr[0])
        self._cube_speeds = slice(first, first + 6)

    def before(self, batch: Batch, extra: np.ndarray) -> None:
        """Lock or unlock the drawer and the window."""
        batch.expand("dof_damping")[:, self._slide_speeds] = np.where(extra == 0, _LOCKED, _FREE)

    def after(
        self, batch: Batch, qpos: np.ndarray, memory: np.ndarray, extra: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (pose of the hand, the buttons, the observation)."""
        contact = self._contact(batch)  # before the forward pass: of the last sub-step
        now = batch.bind("qpos")
        self._put_back(batch, now)
        pressed = (qpos[:, self._buttons] > _PRESSED) & (now[:, self._buttons] <= _PRESSED)
        extra = np.where(pressed, (extra + 1) % 2, extra).astype(np.int32)
        self.before(batch, extra)
        sound = np.isfinite(batch.state).all(axis=1)
        batch.forward(ids=None if sound.all() else np.flatnonzero(sound))
        memory, sensed = self._sense(batch, contact, extra)
        return memory, extra, sensed

    def _put_back(self, batch: Batch, qpos: np.ndarray) -> None:
        first = self._cubes[0]
        place = qpos[:, first : first + 3]
        out = ((place <= _BOUNDS[0]) | (place >= _BOUNDS[1])).any(axis=1)
        for sim in np.flatnonzero(out):
            rng = np.random.default_rng(np.frombuffer(batch.state[sim].tobytes(), np.uint32))
            half = rng.uniform(0, np.pi)
            qpos[sim, first : first + 7] = (
                *rng.uniform(*self._object_bounds),
                0.02,
                np.cos(half),
                0.0,
                0.0,
                np.sin(half),
            )
            batch.bind("qvel")[sim, self._cube_speeds] = 0.0

    def _objects(self, qpos: np.ndarray, qvel: np.ndarray, extra: np.ndarray) -> list[np.ndarray]:
        columns = super()._objects(qpos, qvel, extra)
        for index, (place, speed) in enumerate(zip(self._buttons, self._button_speeds, strict=True)):
            button = extra[:, index, None]
            columns += [button == 0, button == 1, qpos[:, [place]] * _BUTTON_SCALE, qvel[:, [speed]]]
        for place, speed, scale in zip(self._slides, self._slide_speeds, (_DRAWER_SCALE, _WINDOW_SCALE), strict=True):
            columns += [qpos[:, [place]] * scale, qvel[:, [speed]]]
        return columns
