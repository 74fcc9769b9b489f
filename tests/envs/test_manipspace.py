"""Cubes and scene are OGBench's, bit for bit."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import envs
import envs.gym_api
from envs import render
from envs.manipulation import ogbench_model
from tests.envs.broken_state import assert_reset_alone
from tests.envs.manipspace_reference import oracle_actions, place, reference, rollout, start_of
from tests.envs.saved_state import saved_and_restored

BUTTON, DRAWER, WINDOW = 21, 23, 24  # places in qpos of the scene
TINY = np.finfo(np.float32).tiny  # XLA takes smaller numbers for 0
# Its threads take float64 numbers below 2e-308 for 0 too, such as speeds of what is locked; this bounds what follows.
NOTHING = 1e-200


@cache
def task(name: str) -> Any:
    return envs.make(name, physics="mujoco")


@cache
def theirs(name: str) -> Any:
    return reference(task(name))


@cache
def programs(name: str) -> Any:
    env = task(name)
    auto = envs.AutoReset(env)
    return SimpleNamespace(
        reset=jax.jit(env.reset),
        play=jax.jit(lambda first, actions: jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, first, actions)[1]),
        many=jax.jit(jax.vmap(auto.reset)),
        step_many=jax.jit(jax.vmap(auto.step)),
    )


def random_actions(steps: int, seed: int) -> np.ndarray:
    """Random moves that last for a while and go down more than up."""
    held = np.random.default_rng(seed).uniform(-1.0, 1.0, (-(-steps // 6), 5))
    held[:, 2] -= 0.3
    return np.repeat(np.clip(held, -1, 1), 6, axis=0)[:steps].astype(np.float32)


def assert_the_same(name: str, first: Any, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Compare an episode with the reference's; return the reference's."""
    env = task(name)
    start = place(theirs(name), *start_of(first))
    expected = rollout(theirs(name), actions)
    states = programs(name).play(first, actions)
    np.testing.assert_array_equal(first.obs, start.astype(np.float32))
    exact = np.concatenate(env.engine.exact_state(states.pipeline_state), axis=-1)
    np.testing.assert_allclose(exact, expected["state"], rtol=0, atol=NOTHING)
    seen = expected["observation"].astype(np.float32)
    np.testing.assert_array_equal(states.obs, np.where(np.abs(seen) < TINY, 0, seen))
    np.testing.assert_array_equal(states.reward, expected["reward"])
    np.testing.assert_array_equal(states.metrics["success"], expected["success"])
    np.testing.assert_array_equal(states.done * (1 - states.info["truncation"]), expected["terminated"])
    np.testing.assert_array_equal(states.pipeline_state.extra, expected["extra"])
    objects = {"cube-single": 1, "cube-double": 2, "scene": 5}[env.spec.name]
    np.testing.assert_allclose(states.metrics["score"], 1 + expected["reward"] / objects, atol=1e-6)
    capped = np.arange(1, len(actions) + 1) >= env.episode_length
    np.testing.assert_array_equal(states.info["truncation"], capped * (1 - expected["terminated"]))
    return expected


def oracle_episode(name: str, seed: int, steps: int) -> dict[str, np.ndarray]:
    first = programs(name).reset(jax.random.key(seed))
    return assert_the_same(name, first, oracle_actions(theirs(name), steps, *start_of(first), seed=seed))


@pytest.mark.parametrize("name", ["cube-single", "scene-task2"])
def test_random_steps_equal_the_reference_bit_for_bit(name: str) -> None:
    first = programs(name).reset(jax.random.key(1))
    expected = assert_the_same(name, first, random_actions(200, 1))
    assert (expected["observation"][:, 18] > 0.1).any()  # the gripper met something


def test_a_cube_in_the_gripper_equals_the_reference_bit_for_bit() -> None:
    expected = oracle_episode("cube-double", seed=3, steps=120)
    assert expected["state"][:, [16, 23]].max() > 0.1  # lifted


def test_buttons_and_what_they_unlock_equal_the_reference_bit_for_bit() -> None:
    expected = oracle_episode("scene-task2", seed=8, steps=400)
    assert len(np.unique(expected["extra"], axis=0)) > 1
    assert len(np.unique(expected["reward"])) > 1


@pytest.mark.slow
@pytest.mark.parametrize("task_id", range(1, 6))
@pytest.mark.parametrize("variant", ["cube-single", "cube-double", "scene"])
def test_two_thousand_random_and_two_thousand_oracle_steps_equal_the_reference(variant: str, task_id: int) -> None:
    name, steps = f"{variant}-task{task_id}", 400
    for seed in range(5):
        first = programs(name).reset(jax.random.key(100 + seed))
        assert_the_same(name, first, random_actions(steps, 100 + seed))
    found = [oracle_episode(name, 200 + seed, steps) for seed in range(5)]
    state = np.concatenate([episode["state"] for episode in found])
    assert state[:, 16].max() > 0.1 and (state[:, 6] > 0.2).any()
    if variant == "scene":
        assert len(np.unique(np.concatenate([episode["extra"] for episode in found]), axis=0)) > 2
        assert np.ptp(state[:, DRAWER]) > 0.1 and np.ptp(state[:, WINDOW]) > 0.1


def test_the_last_step_credits_what_was_in_place_before_it() -> None:
    """At the goal: reward 0, success and the end, as OGBench's "pre"; a step before its cap nothing is cut off."""
    for name in ("cube-double", "scene-task2"):
        env = task(name)
        first = programs(name).reset(jax.random.key(0))
        qpos, qvel, extra = (np.array(part) if part is not None else None for part in start_of(first))
        goal = env.description["goal_xyzs"] if extra is None else env.description["goal"]["block_xyzs"]
        for index, xyz in enumerate(goal):
            qpos[14 + 7 * index : 21 + 7 * index] = (*xyz, 1, 0, 0, 0)
        if extra is not None:
            qpos[[DRAWER, WINDOW]] = env.description["goal"]["drawer_pos"], env.description["goal"]["window_pos"]
            extra = np.array(env.description["goal"]["button_states"], np.int32)
        assert env.distance_left(qpos, extra) == 0
        expected = assert_the_same(name, env.reset_to(qpos, qvel, extra=extra), random_actions(1, 0))
        assert expected["terminated"].all() and expected["reward"].tolist() == [0]


def test_rewards_of_data_are_those_of_steps() -> None:
    env = task("scene-task2")
    states = programs("scene-task2").play(programs("scene-task2").reset(jax.random.key(2)), random_actions(30, 2))
    held = jax.device_get(states.pipeline_state)
    rows = SimpleNamespace(qpos=held.qpos[:-1], qvel=held.qvel[:-1], extra=held.extra[:-1])
    np.testing.assert_array_equal(env.labels(rows)[0], states.reward[1:])
    np.testing.assert_array_equal(-env.distance_left(rows.qpos, rows.extra), states.reward[1:])
    parts = env.parts(rows)
    assert list(parts) == ["cube", "button 0", "button 1", "drawer", "window"]
    np.testing.assert_array_equal(sum(np.asarray(part, int) for part in parts.values()) - 5, states.reward[1:])
    flipped = SimpleNamespace(qpos=rows.qpos, qvel=rows.qvel, extra=1 - rows.extra)
    np.testing.assert_array_equal(env.labels(flipped)[0], states.reward[1:] - 2)
    on_device = SimpleNamespace(qpos=jnp.asarray(rows.qpos), qvel=None, extra=jnp.asarray(flipped.extra))
    np.testing.assert_array_equal(env.labels(on_device), env.labels(flipped))


@pytest.mark.parametrize("name", ["cube-single", "cube-double", "scene-task2"])
def test_starts_are_drawn_as_the_reference_draws_them(name: str) -> None:
    their = reference(task(name))  # one that no test has stepped: contacts after a reset depend on what came before
    ours = jax.device_get(programs(name).many(jax.random.split(jax.random.key(0), 60)))
    expected = [(their.reset(seed=seed)[0], their._data.qpos.copy()) for seed in range(60)]
    low, high = their._arm_sampling_bounds[:, None]
    hands = ours.obs[:, 12:15] / 10 + [0.425, 0, 0]
    assert (hands > low - 1e-3).all() and (hands < high + 1e-3).all()
    for mine, other in zip(
        (ours.obs, ours.pipeline_state.qpos), map(np.stack, zip(*expected, strict=True)), strict=True
    ):
        spread = np.maximum(other.std(axis=0), 1e-6)
        assert (np.abs(mine.mean(axis=0) - other.mean(axis=0)) < 0.5 * spread + 1e-6).all()
        fluctuates = spread > 1e-3
        ratio = mine.std(axis=0)[fluctuates] / spread[fluctuates]
        assert ratio.min() > 0.75 and ratio.max() < 1.33
    buttons = getattr(their, "_cur_button_states", np.zeros(0))
    np.testing.assert_array_equal(ours.pipeline_state.extra, [buttons] * 60)


def test_the_arm_starts_as_the_reference_places_it() -> None:
    from ogbench.manipspace import lie

    rig, their = task("cube-single").rig, theirs("cube-single")
    rng = np.random.default_rng(0)
    places, yaws = rng.uniform(*their._arm_sampling_bounds, size=(7, 3)), rng.uniform(-np.pi, np.pi, 7)
    for joints, place_, yaw in zip(rig.arm_start(places, yaws), places, yaws, strict=True):
        turn = lie.SO3.from_z_radians(yaw) @ their._effector_down_rotation
        flange = lie.SE3.from_rotation_and_translation(turn, place_) @ their._T_pa
        expected = their._ik.solve(flange.translation(), flange.rotation().wxyz, their._home_qpos)
        np.testing.assert_array_equal(joints, expected)


@pytest.mark.parametrize("name", ["cube-double", "scene-task2"])
def test_a_batch_equals_single_steps_and_a_saved_state_goes_on_where_it_was(name: str, tmp_path: Path) -> None:
    batch, actions = programs(name), random_actions(6, 2)
    keys = jax.random.split(jax.random.key(5), 3)
    states = [batch.many(keys)]
    repeated = np.repeat(actions[:, None], 3, axis=1)
    for action in (*repeated, *repeated[3:]):
        last = saved_and_restored(tmp_path, states[3]) if len(states) == 7 else states[-1]
        states.append(batch.step_many(last, action))
    np.testing.assert_array_equal(states[6].obs, states[9].obs)
    single = batch.play(batch.reset(keys[1]), actions)
    np.testing.assert_array_equal(states[6].obs[1], single.obs[-1])


def test_actions_beyond_the_range_are_clipped() -> None:
    play = programs("scene-task2").play
    first = programs("scene-task2").reset(jax.random.key(0))
    far = np.full((2, 5), 3.0, np.float32)
    np.testing.assert_array_equal(play(first, far).obs, play(first, np.ones_like(far)).obs)


@pytest.mark.parametrize("name", ["cube-double", "scene-task2"])
def test_a_broken_state_is_reset_alone(name: str) -> None:
    batch = programs(name)
    assert_reset_alone(batch.many(jax.random.split(jax.random.key(0), 3)), batch.step_many, 5)


def test_a_cube_that_was_shot_out_is_put_back_on_the_table() -> None:
    first = programs("scene-task2").reset(jax.random.key(0))
    qpos, qvel, extra = start_of(first)
    qpos, qvel = np.array(qpos), np.array(qvel)
    qpos[14:17], qvel[14] = (0.9, 0.0, 0.3), 20.0
    env = task("scene-task2")
    after = programs("scene-task2").play(env.reset_to(qpos, qvel, extra=extra), random_actions(1, 0))
    cube = np.asarray(after.pipeline_state.qpos)[0, 14:21]
    assert (cube[:2] > [0.3, -0.07]).all() and (cube[:2] < [0.45, 0.18]).all() and cube[2] == np.float32(0.02)
    assert abs((cube[3:] ** 2).sum() - 1) < 1e-6 and (cube[4:6] == 0).all()
    assert (np.asarray(after.pipeline_state.qvel)[0, 14:20] == 0).all()
    np.testing.assert_allclose(after.obs[0, 19:22], (cube[:3] - [0.425, 0, 0]) * 10, rtol=1e-6)


def test_names_stand_for_the_tasks_of_ogbench_and_of_the_paper() -> None:
    assert [envs.get_spec(name).full_name for name in ("cube", "cube-double", "scene", "scene-task3")] == [
        "cube-single-task2",
        "cube-double-task2",
        "scene-task1",
        "scene-task3",
    ]
    assert sum(spec.family in ("cube", "scene") for spec in envs.list_tasks()) == 15


def test_gymnasium_makes_one_and_a_batch() -> None:
    single = gymnasium.make("qdos/cube-single-task2-v0", disable_env_checker=True)
    check_env(single.unwrapped, skip_render_check=True)
    batch = gymnasium.make_vec("qdos/cube-single-task2-v0", num_envs=3)
    assert batch.reset(seed=0)[0].shape == (3, 28)
    _, rewards, terminated, truncated, _ = batch.step(np.zeros((3, 5), np.float32))
    assert rewards.tolist() == [-1] * 3 and not (terminated | truncated).any()


def test_data_of_another_task_is_noticed() -> None:
    env = task("scene-task2")
    states = programs("scene-task2").play(programs("scene-task2").reset(jax.random.key(2)), random_actions(30, 2))
    physics = states.pipeline_state
    rows: Any = SimpleNamespace(
        observations=np.array(states.obs), qpos=np.array(physics.qpos), extra=np.array(physics.extra)
    )
    assert env.check_rows(rows) == [] and env.check_steps(rows) == []
    moved: Any = SimpleNamespace(observations=rows.observations.copy(), qpos=rows.qpos.copy(), extra=1 - rows.extra)
    moved.observations[3, 12] += 9
    moved.qpos[5, DRAWER], moved.qpos[6:8, WINDOW] = 0.1, -0.1
    assert env.check_steps(moved) == [
        "the hand is out of its workspace in 1 row (first 3)",
        "the drawer is beyond its range in 1 row (first 5)",
        "the window is beyond its range in 2 rows (first 6)",
        "extra and observations disagree on button 0 in 30 rows (first 0)",
        "extra and observations disagree on button 1 in 30 rows (first 0)",
    ]
    rows.qpos[4:6, 14] += 0.01
    rows.qpos[7, 17:21] = 0
    rows.qpos[8, 16] = 2
    assert env.check_rows(rows) == ["qpos and observations disagree on the first cube in 3 rows (first 4)"]
    assert env.check_steps(rows) == [
        "cube 0 is off the table in 1 row (first 8)",
        "the quaternion of cube 0 is not of length 1 in 1 row (first 7)",
    ]


def test_both_cubes_are_compared_with_the_observation() -> None:
    state = programs("cube-double").reset(jax.random.key(0))
    rows: Any = SimpleNamespace(
        observations=np.asarray(state.obs)[None], qpos=np.array(state.pipeline_state.qpos)[None], extra=None
    )
    assert task("cube-double").check_rows(rows) == []
    rows.qpos[0, 21] += 0.01
    assert task("cube-double").check_rows(rows) == [
        "qpos and observations disagree on the second cube in 1 row (first 0)"
    ]


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("name", ["cube-double", "scene-task2"])
def test_a_picture_shows_the_arm_and_what_lies_on_the_table(name: str) -> None:
    qpos = np.array(start_of(programs(name).reset(jax.random.key(0)))[0])
    with render.Renderer(task(name), 96) as renderer:
        frames = [renderer.frame(qpos, ())]
        for index in (1, 14):  # the arm, the cube
            qpos[index] += 0.1
            frames.append(renderer.frame(qpos, ()))
    assert frames[0].std() > 20
    assert (frames[0] != frames[1]).any() and (frames[1] != frames[2]).any()


@pytest.mark.usefixtures("opengl")
def test_a_picture_shows_what_is_locked() -> None:
    """Buttons and handles are red where they lock: more red in the picture, and no memory of the one before."""
    qpos = np.array(start_of(programs("scene-task2").reset(jax.random.key(0)))[0])
    with render.Renderer(task("scene-task2"), 96, camera="near") as renderer:
        locked, half, free, again = (
            renderer.frame(qpos, (), extra).astype(int) for extra in ([0, 0], [1, 0], [1, 1], [0, 0])
        )
    red = [np.sum(image[..., 0] - image[..., 1] > 60) for image in (locked, half, free)]
    assert red[0] > red[1] > red[2]
    np.testing.assert_array_equal(locked, again)


def test_without_the_package_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    ogbench_model.manip_space.cache_clear()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"ogbench, which is not installed; run: pip install .*manipulation"):
        envs.make("cube", physics="mujoco")
