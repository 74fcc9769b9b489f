"""The rows of limits and contacts against those that MuJoCo C makes of the same state."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from envs.mazes.bodies import ANT_AND_BALL, HUMANOID, Body
from envs.physics.mjx.constraints import Constraints

BODIES = [pytest.param(ANT_AND_BALL, id="ant"), pytest.param(HUMANOID, id="humanoid", marks=pytest.mark.slow)]


@pytest.mark.parametrize("body", BODIES)
def test_rows_equal_those_of_c(body: Body) -> None:
    """Along a fall under random controls, beside a wall and with the ball under the ant."""
    model = body.near(True)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    mjx_model, start = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
    constraints = Constraints(model, mjx_model, body.most_contacts)

    @jax.jit
    def ours(qpos: jax.Array, qvel: jax.Array, walls: jax.Array) -> tuple[jax.Array, ...]:
        data = start.replace(qpos=qpos, qvel=qvel, mocap_pos=walls)
        return constraints.rows(mjx.com_pos(mjx_model, mjx.kinematics(mjx_model, data)))

    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    data.mocap_pos[:] = 0.0, 0.0, -10.0
    data.mocap_pos[::3] = 2.5, 0.0, 1.0  # its face is half a metre away from the body's middle
    for place in body.places[1:]:
        data.qpos[place : place + 2] = 0.5, 0.3
    compared = 0
    for _ in range(60):
        data.ctrl[:] = rng.uniform(-1, 1, model.nu)
        mujoco.mj_step(model, data, nstep=10)
        data.qpos[:], data.qvel[:] = data.qpos.astype(np.float32), data.qvel.astype(np.float32)
        mujoco.mj_forward(model, data)
        jacobian, stiffness, reference = (np.asarray(part) for part in ours(data.qpos, data.qvel, data.mocap_pos))
        in_force = stiffness > 0
        assert in_force.sum() == data.nefc
        assert (jacobian[~in_force] == 0).all() and (reference[~in_force] == 0).all()
        for row, d, r in zip(data.efc_J.reshape(-1, model.nv), data.efc_D, data.efc_aref, strict=True):
            distance = np.abs(jacobian[in_force] - row).max(axis=1) + 1e-3 * np.abs(reference[in_force] - r)
            match = np.flatnonzero(in_force)[distance.argmin()]
            np.testing.assert_allclose(jacobian[match], row, atol=1e-4)
            np.testing.assert_allclose(stiffness[match], d, rtol=1e-3)
            np.testing.assert_allclose(reference[match], r, rtol=2e-3, atol=2e-3)
        compared += data.nefc
    assert compared > 500
