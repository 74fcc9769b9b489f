"""The tasks through Gymnasium: its own checker, its own vector environments as the yardstick, OGBench's numbers."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import envs
from envs import gym_api, gym_programs
from tests.envs.ogbench_reference import ogbench_env, ogbench_rollout
from tests.envs.test_wrappers import sliding_task

MEDIUM = "qdos/antmaze-medium-task1-v0"


@pytest.fixture
def sliding(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A task to be reckoned by hand: a point that moves by its action, breaks above 8, and is cut off after 3 steps."""
    task = sliding_task()
    monkeypatch.setattr(gym_programs, "make", lambda name, physics: task)
    monkeypatch.setattr(gym_api, "steps_per_second", lambda task: 10.0)
    gym_programs.programs.cache_clear()
    yield task
    gym_programs.programs.cache_clear()


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Episodes of 30 steps."""
    monkeypatch.setattr(envs.Task, "episode_length", 30)
    gym_programs.programs.cache_clear()
    yield 30
    gym_programs.programs.cache_clear()


def put(env: Any, qpos: Any, qvel: Any) -> None:
    """Sets the states of all environments: qpos[N, nq], qvel[N, nv]."""
    keys = jax.random.split(jax.random.key(5), len(qpos))
    start = envs.AutoReset(env.task).reset_to
    env._state = jax.vmap(lambda q, v, key: start(q, v, None, key))(jnp.asarray(qpos), jnp.asarray(qvel), keys)


def same(one: Any, two: Any) -> None:
    """Equal in structure, dtype and value, object arrays and masks of nested infos included."""
    assert type(one) is type(two)
    if isinstance(one, dict):
        assert one.keys() == two.keys()
        for key in one:
            same(one[key], two[key])
    elif isinstance(one, np.ndarray):
        assert one.dtype == two.dtype and one.shape == two.shape
        if one.dtype == object:
            for a, b in zip(one, two, strict=True):
                same(a, b)
        else:
            np.testing.assert_array_equal(one, two)
    else:
        assert one == two


def test_every_task_is_registered() -> None:
    for spec in envs.list_tasks():
        for name in (spec.full_name, spec.name):
            entry = gymnasium.spec(f"qdos/{name}-v0")
            assert entry.kwargs == {"task": name} and entry.vector_entry_point is not None
    assert sum(name.startswith("qdos/") for name in gymnasium.registry) == len(envs.list_tasks()) + len(
        {spec.name for spec in envs.list_tasks()}
    )
    env = gymnasium.make("qdos/antsoccer-arena-v0", physics="mujoco")
    assert env.unwrapped.task.spec.full_name == "antsoccer-arena-task4"  # OGBench's default
    assert env.observation_space.shape == (42,) and env.observation_space.dtype == np.float32


def test_gymnasiums_checker_passes() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(MEDIUM, physics="mujoco").unwrapped, skip_render_check=True)
    told = [str(warning.message) for warning in caught if "WARN" in str(warning.message)]
    assert all("Box observation space" in message for message in told)  # infinite bounds, which are the truth


@pytest.mark.usefixtures("opengl")
def test_gymnasiums_checker_passes_with_frames() -> None:
    env = gymnasium.make(MEDIUM, physics="mujoco", render_mode="rgb_array", height=48)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env.unwrapped)
    batch = gymnasium.make_vec(MEDIUM, num_envs=2, physics="mujoco", render_mode="rgb_array", height=48)
    env.reset(seed=1), batch.reset(seed=1)
    frames = batch.render()
    assert len(frames) == 2 and frames[0].shape == (48, 48, 3) and frames[0].dtype == np.uint8
    np.testing.assert_array_equal(frames[0], env.render())
    assert (frames[0] != frames[1]).any()
    assert env.metadata["render_fps"] == batch.metadata["render_fps"] == 10.0
    env.close(), batch.close()
    assert not batch._renderer._free.alive and not env.unwrapped._renderer._free.alive


def test_single_and_batch_equal_ogbench() -> None:
    """Three states, one beside the goal, under the same actions: OGBench's environment is the truth."""
    single = gymnasium.make(MEDIUM, physics="mujoco").unwrapped
    batch = gymnasium.make_vec(MEDIUM, num_envs=3, physics="mujoco")
    reference = ogbench_env("antmaze-medium-task1")
    rng = np.random.default_rng(0)
    qpos = np.tile(np.asarray(single.task.engine.model.qpos0, np.float32), (3, 1))
    qpos[:, :2] = rng.uniform(-1, 1, (3, 2))
    qpos[2, :2] = single.task.goal_xy + 0.1
    qvel = 0.1 * rng.normal(size=(3, 14)).astype(np.float32)
    actions = rng.uniform(-1, 1, (4, 3, 8)).astype(np.float32)

    put(batch, qpos, qvel)
    obs, reward, terminated, truncated, infos = zip(*(batch.step(action) for action in actions), strict=True)
    for i in range(3):
        live = 1 if i == 2 else 4  # beside the goal the first step ends the episode
        truth = ogbench_rollout(reference, qpos[i], qvel[i], actions[:live, i])
        put(single, qpos[i : i + 1], qvel[i : i + 1])
        for t in range(live):
            alone = single.step(actions[t, i])
            expected = truth["obs"][t].astype(np.float32)
            np.testing.assert_array_equal(alone[0], expected)
            np.testing.assert_array_equal(infos[t]["final_obs"][i] if terminated[t][i] else obs[t][i], expected)
            assert alone[1] == reward[t][i] == truth["reward"][t]
            assert alone[2] == terminated[t][i] == truth["terminated"][t]
            assert alone[3] == truncated[t][i] == False  # noqa: E712
            assert alone[4]["success"] == bool(truth["success"][t])
    np.testing.assert_array_equal(np.stack(terminated)[:, 2], [True, False, False, False])


def test_seeds_repeat_and_the_first_of_a_batch_is_the_single_one() -> None:
    single = gymnasium.make(MEDIUM, physics="mujoco")
    batch = gymnasium.make_vec(MEDIUM, num_envs=3, physics="mujoco")
    one, _ = batch.reset(seed=7)
    onward, _ = batch.reset()
    assert one.shape == (3, 29) and one.dtype == np.float32 and one.flags.writeable
    np.testing.assert_array_equal(batch.reset(seed=7)[0], one)
    np.testing.assert_array_equal(batch.reset()[0], onward)
    np.testing.assert_array_equal(single.reset(seed=7)[0], one[0])
    np.testing.assert_array_equal(single.reset()[0], onward[0])
    starts = np.concatenate([one, onward, batch.reset(seed=8)[0]])
    assert len(np.unique(starts[:, 0])) == 9
    actions = np.random.default_rng(1).uniform(-1, 1, (5, 3, 8))
    batch.reset(seed=7), single.reset(seed=7)
    for action in actions:
        np.testing.assert_array_equal(batch.step(action)[0][0], single.step(action[0].astype(np.float32))[0])


def test_cap_truncates_and_the_next_episode_starts_in_the_same_step(sliding: Any) -> None:
    env = gym_api.TaskVectorEnv("antmaze", num_envs=2)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    start, _ = env.reset(seed=0)
    move = np.array([[0.0, -0.1], [0.1, 0.0]], np.float32)
    for _ in range(2):
        _, reward, terminated, truncated, infos = env.step(move)
        assert not terminated.any() and not truncated.any() and "final_obs" not in infos
    obs, reward, terminated, truncated, infos = env.step(move)
    np.testing.assert_array_equal(terminated, [False, False])
    np.testing.assert_array_equal(truncated, [True, True])
    np.testing.assert_array_equal(reward, [-1.0, -1.0])
    assert reward.dtype == np.float64 and terminated.dtype == truncated.dtype == bool and obs.dtype == np.float32
    for i in range(2):
        np.testing.assert_allclose(infos["final_obs"][i], [*(start[i, :2] + 3 * move[i]), *move[i]], atol=1e-6)
    assert (np.abs(obs[:, :2] - start[:, :2]) > 1e-3).all()  # a new start
    onward = env.step(move)
    np.testing.assert_allclose(onward[0][:, :2], obs[:, :2] + move, atol=1e-6)
    assert not onward[3].any()


def test_success_terminates(sliding: Any) -> None:
    env = gym_api.TaskVectorEnv("antmaze", num_envs=3)
    env.reset(seed=0)
    put(env, np.stack([sliding.goal_xy - 3, sliding.goal_xy + 0.1, sliding.goal_xy - 3]), np.zeros((3, 2)))
    obs, reward, terminated, truncated, infos = env.step(np.full((3, 2), 0.5, np.float32))
    np.testing.assert_array_equal(terminated, [False, True, False])
    np.testing.assert_array_equal(truncated, [False, False, False])
    np.testing.assert_array_equal(reward, [-1.0, 0.0, -1.0])
    np.testing.assert_allclose(infos["final_obs"][1], [*(sliding.goal_xy + 0.6), 0.5, 0.5], atol=1e-6)
    assert infos["final_obs"][0] is None
    np.testing.assert_array_equal(infos["_final_obs"], [False, True, False])
    np.testing.assert_array_equal(infos["final_info"]["success"], [False, True, False])
    assert not np.allclose(obs[1, :2], sliding.goal_xy + 0.6)


def test_broken_physics_truncates_with_the_last_finite_observation(sliding: Any) -> None:
    single, batch = gym_api.TaskGymEnv("antmaze"), gym_api.TaskVectorEnv("antmaze", num_envs=2)
    start, _ = single.reset(seed=0)
    obs, reward, terminated, truncated, info = single.step(np.array([9.0, 0.0]))
    np.testing.assert_array_equal(obs, start)
    assert (reward, terminated, truncated, info) == (-1.0, False, True, {"success": False})
    batch.reset(seed=0)
    obs, _, terminated, truncated, infos = batch.step(np.array([[9.0, 0.0], [0.0, 0.0]]))
    np.testing.assert_array_equal(truncated, [True, False])
    np.testing.assert_array_equal(infos["final_obs"][0], start)
    assert np.isfinite(obs).all() and not terminated.any()


def test_a_batch_is_gymnasiums_own_batch_of_single_ones(sliding: Any) -> None:
    """Everything but the next starts, which come from other random numbers: spaces, dtypes, infos to the last mask."""
    ours = gym_api.TaskVectorEnv("antmaze", num_envs=3)
    theirs = SyncVectorEnv([lambda: gym_api.TaskGymEnv("antmaze")] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    same(ours.reset(seed=0)[1], theirs.reset(seed=0)[1])
    qpos, qvel = np.stack([sliding.goal_xy - 9, sliding.goal_xy, sliding.goal_xy - 5]), np.zeros((3, 2), np.float32)
    put(ours, qpos, qvel)
    for i, env in enumerate(theirs.envs):
        put(env, qpos[i : i + 1], qvel[i : i + 1])
    for step in range(3):
        actions = np.full((3, 2), 0.25 * step, np.float32)
        got, expected = ours.step(actions), theirs.step(actions)
        for one, two in zip(got[1:], expected[1:], strict=True):
            same(one, two)
        going = ~(got[2] | got[3]) & np.array([True, step == 0, True])
        np.testing.assert_array_equal(got[0][going], expected[0][going])
    assert got[3][[0, 2]].all()


def test_gymnasiums_wrappers_work(short: int) -> None:
    env = RecordEpisodeStatistics(gymnasium.make_vec("qdos/antmaze-medium-v0", num_envs=4, physics="mujoco"))
    env.action_space.seed(0)
    env.reset(seed=0)
    seen = []
    for step in range(1, 101):
        obs, *_, infos = env.step(env.action_space.sample())
        assert obs in env.observation_space
        if "episode" in infos:
            seen.append((step, *infos["episode"]["l"], *infos["episode"]["r"]))
    assert seen == [(at, *[short] * 4, *[-float(short)] * 4) for at in (30, 60, 90)]
    assert env.episode_count == 12


def test_what_is_wrong_is_one_line(sliding: Any) -> None:
    env, batch = gym_api.TaskGymEnv("antmaze"), gym_api.TaskVectorEnv("antmaze", num_envs=2)
    for one in (env, batch):
        with pytest.raises(ValueError, match=r"call reset\(\) first"):
            one.step(one.action_space.sample())
        one.reset(seed=0, options={})
        with pytest.raises(ValueError, match=r"have the shape \(3,\); this environment takes \("):
            one.step(np.zeros(3))
        with pytest.raises(ValueError, match="not finite"):
            one.step(np.full(one.action_space.shape, np.nan))
        with pytest.raises(ValueError, match="no reset option 'start'; options: "):
            one.reset(options={"start": (1, 1)})
        assert one.render() is None
        one.close()
    with pytest.raises(ValueError, match="choose rgb_array or None"):
        gym_api.TaskGymEnv("antmaze", render_mode="human")
    with pytest.raises(ValueError, match="at least 1"):
        gym_api.TaskVectorEnv("antmaze", num_envs=0)
    with pytest.raises(ValueError, match="did you mean 'antmaze-large'"):
        gym_api.TaskGymEnv("antmaze-larg")


def test_options_go_to_the_tasks_reset(sliding: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = type(sliding).reset

    def reset(self: Any, rng: jax.Array, start_xy: Any = None) -> Any:
        state = plain(self, rng)
        return state if start_xy is None else self.reset_to(jnp.asarray(start_xy), jnp.zeros(2))

    monkeypatch.setattr(type(sliding), "reset", reset)
    batch, single = gym_api.TaskVectorEnv("antmaze", num_envs=2), gym_api.TaskGymEnv("antmaze")
    np.testing.assert_array_equal(batch.reset(options={"start_xy": (2.0, 3.0)})[0], [[2, 3, 0, 0]] * 2)
    np.testing.assert_array_equal(single.reset(options={"start_xy": (2.0, 3.0)})[0], [2, 3, 0, 0])


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
@pytest.mark.parametrize(("wrong", "near"), [("phyics", "physics"), ("rendermode", "render_mode"), ("hight", "height")])
def test_unknown_keywords_are_refused_with_the_nearest(make: Any, wrong: str, near: str) -> None:
    with pytest.raises(ValueError, match=f"{wrong}.*did you mean '{near}'"):
        make(MEDIUM, **{wrong: "mjx"})


@pytest.mark.parametrize("steps", [0, -2])
def test_a_batch_refuses_a_limit_without_steps(steps: int) -> None:
    with pytest.raises(ValueError, match="max_episode_steps must be at least 1"):
        gymnasium.make_vec(MEDIUM, physics="mujoco", max_episode_steps=steps)


def test_specs_name_the_cap_and_a_shorter_limit_truncates() -> None:
    for spec in envs.list_tasks():
        assert gymnasium.spec(f"qdos/{spec.full_name}-v0").max_episode_steps == spec.episode_length
    single = gymnasium.make(MEDIUM, physics="mujoco", max_episode_steps=5)
    batch = gymnasium.make_vec(MEDIUM, num_envs=2, physics="mujoco", max_episode_steps=5)
    single.reset(seed=0), batch.reset(seed=0)
    for step in range(1, 6):
        assert single.step(np.zeros(8, np.float32))[3] == (step == 5)
        assert batch.step(np.zeros((2, 8), np.float32))[3].tolist() == [step == 5] * 2
