"""Rollouts of skills from logged simulator states, on the real bodies."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import to_device
from qdos_brax.skills.information import PhysicsRollout
from tests.envs.ogbench_reference import ogbench_env, ogbench_rollout

HORIZON = 3


def constant_skills(action_size: int) -> Any:
    """A skill is an action."""
    return SimpleNamespace(
        act=lambda params, observation, skill: jnp.resize(skill, action_size),
        begin=lambda params, latent, observation: latent,
    )


def rollouts(env: envs.Task, qpos: np.ndarray, qvel: np.ndarray, latent: np.ndarray) -> np.ndarray:
    """Observations [N - HORIZON + 1, HORIZON + 1, obs], raw, from one logged episode with these states [N]."""
    n = len(qpos)
    rows = {"observations": np.zeros((n, env.observation_size)), "actions": np.zeros((n, env.action_size))}
    ends = np.arange(n) == n - 1
    dataset = Dataset(
        **rows,
        rewards=np.zeros(n),
        masks=np.zeros(n),
        ends=ends,
        next_observations=rows["observations"],
        qpos=qpos,
        qvel=qvel,
    )
    data, _ = to_device(dataset, HORIZON)
    rollout = PhysicsRollout(env, constant_skills(env.action_size), lambda observation: observation, HORIZON)
    return np.asarray(jax.jit(lambda data, latent: rollout({}, data, data.starts, latent))(data, latent))


def test_humanoid_rollouts_see_what_ogbench_sees() -> None:
    env = envs.make("humanoidmaze-medium", physics="mujoco")
    start = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4)).pipeline_state
    qpos, qvel = np.array(start.qpos), np.array(start.qvel)
    latent = np.random.default_rng(0).uniform(-1, 1, (2, 7)).astype(np.float32)
    seen = rollouts(env, qpos, qvel, latent)
    assert seen.shape == (2, HORIZON + 1, 69)
    reference = ogbench_env("humanoidmaze-medium-task1")
    for n in range(2):
        actions = np.tile(latent[n], (HORIZON, 3))
        expected = ogbench_rollout(reference, qpos[n], qvel[n], actions)["obs"]
        np.testing.assert_allclose(seen[n, 1:], expected, rtol=1e-6, atol=1e-5)
        np.testing.assert_array_equal(seen[n, 0], env.reset_to(qpos[n], qvel[n]).obs)


def test_every_logged_state_has_exits_of_its_own() -> None:
    env = envs.make("antmaze-teleport", physics="mujoco")
    qpos = np.tile(np.asarray(env.engine.model.qpos0, np.float32), (14, 1))
    qpos[:, :2] = env.layout.ij_to_xy(np.array(env.layout.teleporters.entrances[0]))
    seen = rollouts(env, qpos, np.zeros((14, 14), np.float32), np.zeros((12, 8), np.float32))
    came_out = {tuple(np.round(xy / 4).astype(int)) for xy in seen[:, 2, :2]}  # in cells, of the origin's
    assert came_out == {tuple((env.layout.ij_to_xy(cell) / 4).astype(int)) for cell in env.layout.teleporters.exits}
