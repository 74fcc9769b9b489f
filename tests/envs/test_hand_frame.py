"""The kitchen seen from the finger tips, against MuJoCo's own kinematics."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.manipulation.hand_frame import HAND, HANDLES, TIP
from envs.manipulation.kitchen_rig import START_QPOS

pytest.importorskip("gymnasium_robotics")
OBSERVED = np.array([*range(9), *range(18, 39)])


def seen_at(qpos: np.ndarray, env: envs.Kitchen) -> jax.Array:
    """An observation without errors, and with velocities that nothing may read."""
    observation = np.full(env.observation_size, np.nan)
    observation[OBSERVED] = qpos
    return jnp.asarray(observation)


@pytest.fixture(scope="module")
def env() -> envs.Kitchen:
    return envs.make("kitchen-mixed")


@pytest.mark.parametrize("seed", range(3))
def test_places_are_mujocos(env: envs.Kitchen, seed: int) -> None:
    rng, model = np.random.default_rng(seed), env.engine.model
    qpos = START_QPOS + rng.uniform(-0.5, 0.5, 30)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    hand = data.xmat[model.body(HAND).id].reshape(3, 3)
    tips = data.xpos[model.body(HAND).id] + TIP * hand[:, 2]
    handles = [data.site_xpos[model.site(name).id] - tips for name in HANDLES.values()]

    observation, begun = seen_at(qpos, env), jnp.array([0.1, 0.2, 0.3])
    frame = env.body_frame
    np.testing.assert_allclose(frame.pose(observation), tips, atol=1e-5)
    seen = jax.jit(frame.see)(observation, begun)
    assert seen.shape == (frame.size(env.observation_size),)
    np.testing.assert_array_equal(seen[: env.observation_size], observation)
    expected = np.concatenate([tips - begun, hand.ravel(), *handles])
    np.testing.assert_allclose(seen[env.observation_size :], expected, atol=1e-5)


def test_a_batch_is_seen_row_by_row(env: envs.Kitchen) -> None:
    rows = jnp.stack([seen_at(START_QPOS + 0.1 * i, env) for i in range(6)]).reshape(2, 3, -1)
    poses = env.body_frame.pose(rows[:, :1])
    together = env.body_frame.see(rows, poses)
    each = [[env.body_frame.see(row, pose[0]) for row in of] for of, pose in zip(rows, poses, strict=True)]
    np.testing.assert_allclose(together, np.asarray(each), atol=1e-6)
    np.testing.assert_allclose(together[:, 0, env.observation_size :][:, :3], 0, atol=1e-6)
