"""The table seen from the gripper: gaps are those of the simulation, and small ones count."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.manipulation.manipspace import ManipSpaceTask
from envs.manipulation.manipspace_rig import CENTRE, PLACE_SCALE, ROBOT_JOINTS
from envs.manipulation.table_frame import TableFrame

pytest.importorskip("ogbench")


@pytest.mark.parametrize("name", ["cube-single", "cube-double", "scene"])
def test_gaps_are_the_simulations(name: str) -> None:
    env = envs.make(name)
    assert isinstance(env, ManipSpaceTask)
    state = jax.jit(env.reset)(jax.random.key(0))
    observation, frame = state.obs, env.body_frame
    hand = np.asarray(state.pipeline_state.sensed[12:15]) / PLACE_SCALE + CENTRE
    cubes = np.asarray(state.pipeline_state.qpos)[ROBOT_JOINTS:][: 7 * env.cubes].reshape(-1, 7)[:, :3]

    np.testing.assert_allclose(np.asarray(frame.pose(observation)) / PLACE_SCALE + CENTRE, hand, atol=1e-6)
    seen = jax.jit(frame.see)(observation, frame.pose(observation) - 1.0)
    assert seen.shape == (frame.size(env.observation_size),)
    np.testing.assert_array_equal(seen[: env.observation_size], observation)
    way, gaps, fine = jnp.split(seen[env.observation_size :], [3, 3 + 3 * env.cubes])
    np.testing.assert_allclose(way, 1.0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(gaps).reshape(-1, 3) / PLACE_SCALE, cubes - hand, atol=1e-6)
    np.testing.assert_allclose(np.asarray(fine).reshape(-1, 3), np.tanh((cubes - hand) * 100), atol=1e-4)


@pytest.mark.quick
def test_by_hand() -> None:
    """One cube, 3 mm in front of the fingers and 20 cm below them; units of 0.1 m."""
    hand, cube = [1.0, 2.0, 2.2], [1.03, 2.0, 0.2]
    observation = jnp.array([*[7.0] * 12, *hand, *[7.0] * 4, *cube, *[7.0] * 6])
    seen = TableFrame(cubes=1).see(observation, jnp.array([1.0, 1.5, 2.2]))
    np.testing.assert_allclose(seen[28:31], [0.0, 0.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(seen[31:34], [0.03, 0.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(seen[34:], [np.tanh(0.3), 0.0, -1.0], atol=1e-6)


@pytest.mark.quick
def test_a_batch_is_seen_row_by_row() -> None:
    frame, rows = TableFrame(cubes=2), jax.random.normal(jax.random.key(0), (2, 3, 37))
    poses = frame.pose(rows[:, :1])
    each = [[frame.see(row, pose[0]) for row in of] for of, pose in zip(rows, poses, strict=True)]
    np.testing.assert_allclose(frame.see(rows, poses), np.asarray(each), atol=1e-6)
