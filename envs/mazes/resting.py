"""How far the lowest point of a body is above the floor, from which data tells what MuJoCo it was recorded with."""

from __future__ import annotations

import mujoco
import numpy as np


def lowest_points(model: mujoco.MjModel, qpos: np.ndarray, root: int) -> np.ndarray:
    """Return float64[N], the height of the lowest point of a body at ``qpos[N, nq]``.

    Args:
        model: with the body, whose geoms are spheres and capsules.
        qpos: states.
        root: number of the body; what hangs on it belongs to it.
    """
    data = mujoco.MjData(model)
    geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == root)
    radius, half = model.geom_size[geoms, 0], model.geom_size[geoms, 1]
    half = np.where(model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_CAPSULE, half, 0.0)
    lowest = np.empty(len(qpos))
    for row, state in enumerate(qpos):
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        upright = np.abs(data.geom_xmat[geoms, 8])  # of each capsule's axis
        lowest[row] = (data.geom_xpos[geoms, 2] - upright * half - radius).min()
    return lowest
