"""Names, sizes, reset, success, distance to go."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs

SIZES = {"antmaze": (15, 14, 29), "antsoccer": (22, 20, 42)}


@pytest.mark.parametrize("spec", envs.list_tasks(), ids=lambda spec: spec.full_name)
def test_every_task_resets_and_steps(spec: envs.TaskSpec) -> None:
    env = envs.make(spec.full_name, physics="mujoco")
    nq, nv, obs_size = SIZES[spec.family]
    assert (env.observation_size, env.action_size, env.episode_length) == (obs_size, 8, 1000)
    assert env.spec == spec and env.backend == "mujoco"
    before = jax.vmap(env.reset)(jax.random.split(jax.random.key(spec.task_id), 2))
    after = jax.vmap(env.step)(before, jnp.ones((2, 8)))
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(before)] == [(x.shape, x.dtype) for x in jax.tree.leaves(after)]
    assert after.pipeline_state.qpos.shape == (2, nq) and after.pipeline_state.qvel.shape == (2, nv)
    assert after.obs.shape == (2, obs_size) and bool(jnp.isfinite(after.obs).all())
    np.testing.assert_array_equal(after.reward, [-1, -1])
    np.testing.assert_array_equal(after.done, [0, 0])
    np.testing.assert_array_equal(after.info["steps"], [1, 1])
    assert (env.true_distance(np.asarray(before.pipeline_state.qpos)) > 1.5).all()
    assert (jnp.abs(before.pipeline_state.qpos[0] - before.pipeline_state.qpos[1]) > 0).all()


def test_names() -> None:
    assert envs.get_spec("antmaze").full_name == "antmaze-large-task1"
    assert envs.get_spec("antsoccer").full_name == "antsoccer-arena-task4"
    assert envs.get_spec("antsoccer-task2").full_name == "antsoccer-arena-task2"
    assert len(envs.list_tasks()) == 25
    for wrong, near in [
        ("antmaze-larg", "'antmaze-large'"),
        ("antmaze-medium-task7", "'antmaze-medium-task"),
        ("antsocer", "'antsoccer'"),
        ("", "'ant"),
    ]:
        with pytest.raises(ValueError, match=f"did you mean {near}"):
            envs.make(wrong)
    with pytest.raises(ValueError, match="auto, mjx or mujoco"):
        envs.make("antmaze", physics="bullet")


def test_reset_noise_is_ogbenchs() -> None:
    env = envs.make("antsoccer-arena", physics="mujoco")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4000))
    qpos, qvel = np.asarray(states.pipeline_state.qpos), np.asarray(states.pipeline_state.qvel)
    for index, centre in ((0, (20, 20)), (15, (0, 0))):  # task4: ant in (6, 6), ball in (1, 1)
        shifts = qpos[:, index : index + 2] - centre
        assert np.abs(shifts).max() <= 1.0 and np.abs(shifts).max() > 0.99
        assert shifts.std() == pytest.approx(2 / np.sqrt(12), rel=0.03)
    rest = np.delete(qpos - np.asarray(env.engine.model.qpos0), [0, 1, 15, 16], axis=1)
    assert np.abs(rest).max() <= 0.1 + 1e-6
    np.testing.assert_allclose(rest.std(axis=0), 0.2 / np.sqrt(12), rtol=0.1)
    np.testing.assert_allclose(qvel.std(axis=0), 0.1, rtol=0.1)
    np.testing.assert_array_equal(states.info["goal_xy"][0], env.goal_xy)
    np.testing.assert_array_equal(env.goal_xy, [0, 20])


def test_success_is_pure_and_works_on_both_array_kinds() -> None:
    soccer = envs.make("antsoccer-arena", physics="mujoco")
    qpos = np.zeros((3, 22), np.float32)
    qpos[:, 15:17] = soccer.goal_xy + np.array([[0.0, 0.49], [0.36, 0.36], [0.0, 0.5]])
    np.testing.assert_array_equal(soccer.success(qpos, soccer.goal_xy), [True, False, True])
    np.testing.assert_array_equal(jax.jit(soccer.success)(qpos, soccer.goal_xy), [True, False, True])
    assert isinstance(soccer.success(qpos, soccer.goal_xy), np.ndarray)
    maze = envs.make("antmaze-medium", physics="mujoco")
    ant = np.zeros((2, 15))
    ant[1, :2] = maze.goal_xy
    np.testing.assert_array_equal(maze.success(ant, maze.goal_xy), [False, True])


def test_reset_to_takes_any_state_and_goal() -> None:
    env = envs.make("antmaze-medium", physics="mujoco")
    qpos = np.asarray(env.engine.model.qpos0, np.float32)
    qvel = np.arange(14, dtype=np.float32) / 100
    state = env.reset_to(qpos, qvel, np.array([0.1, 0.0]))
    np.testing.assert_array_equal(state.obs, np.concatenate([qpos, qvel]))
    assert int(state.info["steps"]) == 0
    after = env.step(state, jnp.zeros(8))
    assert (float(after.metrics["success"]), float(after.reward), float(after.done)) == (1.0, 0.0, 1.0)
    assert float(after.info["truncation"]) == 0.0
    fresh = env.reset(jax.random.key(0))
    assert jax.tree.structure(fresh) == jax.tree.structure(state)


def test_true_distance_known_values() -> None:
    soccer = envs.make("antsoccer-arena", physics="mujoco")  # open: straight lines
    qpos = np.zeros((1, 22))
    qpos[0, :2], qpos[0, 15:17] = (3.0, 4.0), (0.0, 0.0)
    np.testing.assert_allclose(soccer.true_distance(qpos), [5.0 + 20.0])
    maze = envs.make("antmaze-medium-task5", physics="mujoco")  # goal in (1, 1)
    ant = np.zeros((2, 15))
    ant[0, :2], ant[1, :2] = (1.0, 1.0), (4.0, 4.0)
    np.testing.assert_allclose(maze.true_distance(ant), np.hypot([1, 4], [1, 4]))
