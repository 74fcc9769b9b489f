"""Names, sizes, reset, success, distance to go."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.mazes import locomotion
from envs.mazes.families import MAZE_FAMILIES
from envs.physics import resolve_physics

# nq, nv, observation, action (OGBench 1.2.2)
SIZES = {"antmaze": (15, 14, 29, 8), "antsoccer": (22, 20, 42, 8), "humanoidmaze": (28, 27, 69, 21)}
CAPS = {"humanoidmaze-medium": 2000, "humanoidmaze-large": 2000, "humanoidmaze-giant": 4000}  # all others 1000


MAZES = [spec for spec in envs.list_tasks() if spec.family in MAZE_FAMILIES]


@pytest.mark.parametrize("spec", MAZES, ids=lambda spec: spec.full_name)
def test_every_maze_resets_and_steps(spec: envs.TaskSpec) -> None:
    env = envs.make(spec.full_name, physics="mujoco")
    nq, nv, obs_size, action_size = SIZES[spec.family]
    assert (env.observation_size, env.action_size) == (obs_size, action_size)
    assert env.episode_length == CAPS.get(spec.name, 1000)
    variant = envs.FAMILIES[spec.family].variants[spec.variant]
    assert (variant.observation_size, variant.action_size) == (obs_size, action_size)
    assert variant.episode_length == env.episode_length
    assert env.spec == spec and env.backend == "mujoco"
    before = jax.vmap(env.reset)(jax.random.split(jax.random.key(spec.task_id), 2))
    after = jax.vmap(env.step)(before, jnp.ones((2, action_size)))
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(before)] == [(x.shape, x.dtype) for x in jax.tree.leaves(after)]
    assert after.pipeline_state.qpos.shape == (2, nq) and after.pipeline_state.qvel.shape == (2, nv)
    assert after.obs.shape == (2, obs_size) and bool(jnp.isfinite(after.obs).all())
    np.testing.assert_array_equal(after.reward, [-1, -1])
    np.testing.assert_array_equal(after.done, [0, 0])
    np.testing.assert_array_equal(after.pipeline_state.steps, [1, 1])
    distance = env.distance_left(np.asarray(before.pipeline_state.qpos))
    assert (distance > 1.5).all() and np.isfinite(distance).all()
    same = np.flatnonzero(before.pipeline_state.qpos[0] == before.pipeline_state.qpos[1])
    assert same.tolist() == ([2] if spec.family == "humanoidmaze" else [])  # it starts at a height of 1.5


def test_names() -> None:
    assert envs.get_spec("antmaze").full_name == "antmaze-large-task1"
    assert envs.get_spec("antsoccer").full_name == "antsoccer-arena-task1"  # the paper's
    assert envs.get_spec("antsoccer-arena").full_name == "antsoccer-arena-task4"  # OGBench's
    assert envs.get_spec("antsoccer-task2").full_name == "antsoccer-arena-task2"
    assert envs.get_spec("humanoidmaze").full_name == "humanoidmaze-medium-task1"
    assert envs.get_spec("antmaze-teleport").full_name == "antmaze-teleport-task1"
    assert len(MAZES) == 45
    for wrong, near in [
        ("antmaze-larg", "'antmaze-large'"),
        ("antmaze-medium-task7", "'antmaze-medium-task"),
        ("antsocer", "'antsoccer'"),
        ("", "'ant"),
    ]:
        with pytest.raises(ValueError, match=f"did you mean {near}"):
            envs.make(wrong)
    with pytest.raises(ValueError, match="auto, mjx, mjx-warp or mujoco"):
        envs.make("antmaze", physics="bullet")
    assert resolve_physics("auto", ("mjx",)) == "mjx"  # the only one it has, whatever the hardware
    with pytest.raises(ValueError, match="does not run on 'mjx'; choose auto or mujoco"):
        resolve_physics("mjx", ("mujoco",))


def test_listing_loads_no_jax() -> None:
    code = (
        "import envs, sys; assert len(envs.list_tasks()) > 45; assert not {'jax', 'mujoco', 'brax'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


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
    np.testing.assert_array_equal(states.info["goal"][0], env.goal_xy)
    np.testing.assert_array_equal(env.goal_xy, [0, 20])


def test_humanoid_starts_as_ogbench_lets_it() -> None:
    env = envs.make("humanoidmaze-medium", physics="mujoco")
    model, data = env.engine.model, mujoco.MjData(env.engine.model)
    poses = locomotion.dropped_poses()
    low, high = model.jnt_range[1:].T
    assert poses.shape == (4096, 21) and (poses >= low - 1e-6).all() and (poses <= high + 1e-6).all()
    # the rejected quarter folds arms into the body; the ankles know nothing of that and stay uniform
    ankles = [model.joint(name).qposadr[0] - 7 for name in ("left_ankle_x", "right_ankle_y")]
    spread = (high - low)[ankles] / np.sqrt(12)
    np.testing.assert_allclose(poses[:, ankles].std(axis=0), spread, rtol=0.05)
    qpos, qvel = jax.vmap(env._start_pose)(*jax.random.split(jax.random.key(0), (2, 300)))
    assert (qpos[:, 3:7] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(np.std(qvel), 0.1, rtol=0.05)
    for row in np.asarray(qpos, np.float64):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        assert data.ncon == 0


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
    assert int(state.pipeline_state.steps) == 0
    after = env.step(state, jnp.zeros(8))
    assert (float(after.metrics["success"]), float(after.reward), float(after.done)) == (1.0, 0.0, 1.0)
    assert float(after.info["truncation"]) == 0.0
    fresh = env.reset(jax.random.key(0))
    assert jax.tree.structure(fresh) == jax.tree.structure(state)


def test_reset_takes_cells() -> None:
    env = envs.AutoReset(envs.make("antsoccer-arena", physics="mujoco"))
    keys = jax.random.split(jax.random.key(0), 50)
    cells = {"start_ij": (2, 5), "goal_ij": (3, 1), "ball_ij": (6, 6)}
    state = jax.jit(jax.vmap(lambda key: env.reset(key, **cells)))(keys)
    for index, xy in ((0, (16, 4)), (15, (20, 20))):
        shifts = np.asarray(state.pipeline_state.qpos[:, index : index + 2]) - xy
        assert np.abs(shifts).max() <= 1.0 and shifts.std() > 0.5
    np.testing.assert_array_equal(state.info["goal"], np.tile([0.0, 8.0], (50, 1)))
    own = jax.jit(jax.vmap(env.reset))(keys)  # the same but for the cells
    np.testing.assert_array_equal(own.pipeline_state.qpos[:, 2:15], state.pipeline_state.qpos[:, 2:15])
    np.testing.assert_array_equal(own.info["goal"][0], env.goal_xy)
    inside = jax.jit(lambda key, cell: env.reset(key, start_ij=cell).pipeline_state.qpos)(keys[0], jnp.array([2, 5]))
    np.testing.assert_allclose(inside[:2], state.pipeline_state.qpos[0, :2], atol=1e-6)

    maze = envs.make("antmaze-medium", physics="mujoco")
    for wrong, says in [
        ({"start_ij": (1, 3)}, r"cell \(1, 3\) of the maze 'medium' is a wall"),
        ({"goal_ij": (8, 1)}, r"cell \(8, 1\) is outside the maze 'medium', which has 8 x 8 cells"),
        ({"goal_ij": jnp.array([-1, 1])}, "outside"),
        ({"start_ij": (1.5, 1)}, "two whole numbers"),
        ({"start_ij": 3}, "two whole numbers"),
    ]:
        with pytest.raises(ValueError, match=says):
            maze.reset(keys[0], **wrong)
    with pytest.raises(ValueError, match="wall"):
        env.reset(keys[0], ball_ij=(0, 0))


def test_teleporters_of_episodes_and_of_autoreset_draw_anew() -> None:
    env = envs.AutoReset(envs.make("antmaze-teleport", physics="mujoco"))
    entrance = env.layout.ij_to_xy(np.array(env.layout.teleporters.entrances[0]))
    qpos = np.asarray(env.engine.model.qpos0, np.float32)
    qpos[:2] = entrance
    keys = jax.random.split(jax.random.key(0), 60)
    state = jax.jit(jax.vmap(lambda key: env.reset_to(qpos, np.zeros(14), env.goal_xy, key)))(keys)
    physics = state.pipeline_state
    state = state.replace(pipeline_state=physics.replace(steps=physics.steps.at[:30].set(999)))
    after = jax.jit(jax.vmap(env.step))(state, jnp.zeros((60, 8)))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    used = [jax.random.key_data(s.info["teleport_key"]) for s in (state, after)]
    assert len(np.unique(np.concatenate(used), axis=0)) == 120
    np.testing.assert_array_equal(after.pipeline_state.steps, [0] * 30 + [1] * 30)
    np.testing.assert_allclose(after.info["final_obs"][:, :2], np.tile(entrance, (60, 1)), atol=0.2)
    exits = env.layout.ij_to_xy(np.array(env.layout.teleporters.exits))
    out = np.asarray(after.pipeline_state.qpos[30:, :2])
    assert {tuple(xy) for xy in out} == {tuple(xy) for xy in exits}
    start = np.asarray(after.pipeline_state.qpos[:30, :2]) - env.layout.ij_to_xy((1, 10))
    assert np.abs(start).max() <= 1.0


def test_true_distance_known_values() -> None:
    soccer = envs.make("antsoccer-arena", physics="mujoco")  # open: straight lines
    qpos = np.zeros((1, 22))
    qpos[0, :2], qpos[0, 15:17] = (3.0, 4.0), (0.0, 0.0)
    np.testing.assert_allclose(soccer.distance_left(qpos), [5.0 + 20.0])
    maze = envs.make("antmaze-medium-task5", physics="mujoco")  # goal in (1, 1)
    ant = np.zeros((2, 15))
    ant[0, :2], ant[1, :2] = (1.0, 1.0), (4.0, 4.0)
    np.testing.assert_allclose(maze.distance_left(ant), np.hypot([1, 4], [1, 4]))
