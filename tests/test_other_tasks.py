"""A task that is no maze goes all the way: steps, Gymnasium, data, rollouts of skills, training, report."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import envs
from envs import gym_api, gym_programs, render
from qdos_brax.commands.main import main
from qdos_brax.commands.train import train_main
from qdos_brax.config import load_config
from qdos_brax.data import checks, formats
from qdos_brax.data.device import to_device
from qdos_brax.data.requirements import unmet
from qdos_brax.skills.information import PhysicsRollout
from tests import reacher

HORIZON = 5


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    with reacher.registered():
        yield


@pytest.fixture(scope="module")
def env() -> reacher.Reacher:
    made = envs.make("reacher")
    assert isinstance(made, reacher.Reacher)
    return made


@pytest.fixture(scope="module")
def file(env: reacher.Reacher, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("reacher") / "random.hdf5"
    formats.write_hdf5(path, reacher.random_rows(env, episodes=60, length=40), {"env": "reacher-task1"})
    return path


def test_it_is_listed_found_and_made_as_every_other(env: reacher.Reacher) -> None:
    assert [spec.full_name for spec in envs.list_tasks() if spec.family == "reacher"] == [
        "reacher-task1",
        "reacher-task2",
    ]
    assert env.spec == envs.get_spec("reacher-task1") == envs.get_spec("reacher")
    assert (env.observation_size, env.action_size, env.episode_length, env.backend) == (7, 2, 40, "mujoco")
    with pytest.raises(ValueError, match="no task 'reachr'; did you mean 'reacher'"):
        envs.get_spec("reachr")
    with pytest.raises(ValueError, match="does not run on 'mjx'"):
        envs.make("reacher", physics="mjx")
    for name, family, message in (
        ("reacher", reacher.FAMILY, "already a family"),
        ("two-words", reacher.FAMILY, "one word"),
        ("other", envs.Family(reacher.Reacher, ("mujoco",), {}, "x"), "no variant 'x'"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.register_family(name, family)


def test_the_rig_steps_as_a_plain_loop_of_mujoco(env: reacher.Reacher) -> None:
    """Memory, switch, damping and sensor by hand, bit for bit, over the flip of the switch."""
    model = mujoco.MjModel.from_xml_string(reacher.XML)
    data = mujoco.MjData(model)
    state = env.reset_to(jnp.array([0.1, -0.2]), jnp.array([0.5, 0.0]))
    data.qpos[:], data.qvel[:] = np.float32([0.1, -0.2]), np.float32([0.5, 0.0])
    target, switch, flips = data.qpos.copy(), 0, 0
    step = jax.jit(env.step)
    for action in np.random.default_rng(0).uniform(-1.3, 1.3, (40, 2)).astype(np.float32) + np.float32([0.4, 0]):
        state = step(state, action)
        model.dof_damping[0] = reacher.OIL if switch else 0.1
        target = target + reacher.MOVE * np.clip(action, -1, 1).astype(np.float64)
        data.ctrl[:] = target
        before = data.qpos[0]
        mujoco.mj_step(model, data, reacher.FRAME_SKIP)
        if before <= reacher.SWITCH < data.qpos[0]:
            switch, flips = 1 - switch, flips + 1
        np.testing.assert_array_equal(
            np.concatenate(env.engine.exact_state(state.pipeline_state)), [*data.qpos, *data.qvel]
        )
        assert state.pipeline_state.extra.tolist() == [switch]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_array_equal(state.obs[4:6], data.site_xpos[0, :2].astype(np.float32))
        np.testing.assert_allclose(state.obs[4:6], reacher.tip(data.qpos), atol=1e-6)
        assert float(state.obs[6]) == switch
    assert flips >= 1


def test_the_discrete_state_can_be_given_and_decides_success(env: reacher.Reacher) -> None:
    x, y = reacher.GOALS[0]
    elbow = np.arccos((x * x + y * y - 0.5) / 0.5)
    qpos = np.array([np.arctan2(y, x) - elbow / 2, elbow], np.float32)
    np.testing.assert_allclose(reacher.tip(qpos), reacher.GOALS[0], atol=1e-6)
    ends = {}
    for switch in (0, 1):
        state = jax.vmap(env.reset_to)(qpos[None], np.zeros((1, 2)), extra=np.array([[switch]]))
        ends[switch] = jax.vmap(env.step)(state, np.zeros((1, 2)))
        assert ends[switch].pipeline_state.extra.tolist() == [[switch]]
    assert [(float(s.reward[0]), float(s.done[0])) for s in ends.values()] == [(-1.0, 0.0), (0.0, 1.0)]
    # what is changed by hand counts, as qpos does
    changed = ends[0].replace(pipeline_state=ends[0].pipeline_state.replace(extra=jnp.ones((1, 1), jnp.int32)))
    assert float(jax.vmap(env.step)(changed, np.zeros((1, 2))).metrics["success"][0]) == 1.0
    assert env.distance_left(np.stack([qpos, qpos]), np.array([[0], [1]])).tolist() == [1, 0]
    assert env.position(qpos) is None and env.floor_map() is None


def test_a_broken_state_is_reset_alone(env: reacher.Reacher) -> None:
    auto = envs.AutoReset(env)
    states = jax.vmap(auto.reset)(jax.random.split(jax.random.key(0), 3))
    broken = states.pipeline_state.replace(qpos=states.pipeline_state.qpos.at[1, 0].set(jnp.nan))
    after = jax.jit(jax.vmap(auto.step))(states.replace(pipeline_state=broken), jnp.ones((3, 2)))
    np.testing.assert_array_equal(after.metrics["nan"], [0, 1, 0])
    assert bool(jnp.isfinite(after.obs).all())


def test_gymnasium_makes_it(env: reacher.Reacher) -> None:
    gym_api.register_tasks()
    try:
        single = gymnasium.make("qdos/reacher-task2-v0", disable_env_checker=True)
        check_env(single.unwrapped, skip_render_check=True)
        batch = gymnasium.make_vec("qdos/reacher-v0", num_envs=3)
        first, _ = batch.reset(seed=0)
        assert first.shape == (3, 7)
        for _ in range(40):
            _, rewards, terminated, truncated, infos = batch.step(np.zeros((3, 2), np.float32))
        assert (truncated | terminated).all() and rewards.min() >= -2 and infos["final_obs"][0].shape == (7,)
        with pytest.raises(ValueError, match="no reset option 'start_ij'; options: none"):
            batch.reset(options={"start_ij": (1, 1)})
    finally:
        gym_programs.programs.cache_clear()
        for name in [name for name in gymnasium.registry if name.startswith("qdos/reacher")]:
            del gymnasium.registry[name]


@pytest.mark.usefixtures("opengl")
def test_it_is_drawn(env: reacher.Reacher) -> None:
    with render.Renderer(env, 96) as renderer:
        here, there = (renderer.frame(np.zeros(2), goal) for goal in reacher.GOALS)
        assert here.shape == (96, 128, 3) and (here != there).any()
    with pytest.raises(ValueError, match="cameras: free"):
        render.Renderer(env, camera="top")


def test_data_is_read_with_its_discrete_state(env: reacher.Reacher, file: Path) -> None:
    dataset = formats.read(file, env)
    assert dataset.extra is not None and dataset.extra.dtype == np.int32 and dataset.extra.shape == (2400, 1)
    assert 0 < dataset.extra.mean() < 1
    np.testing.assert_array_equal(dataset.extra[:, 0], dataset.observations[:, 6])
    assert set(np.unique(dataset.rewards)) <= {-2.0, -1.0, 0.0} and (dataset.masks == 0).any()
    np.testing.assert_array_equal(dataset.masks, dataset.rewards < 0)
    data, _ = to_device(dataset, HORIZON)
    np.testing.assert_array_equal(data.extra, dataset.extra)


def test_states_without_their_discrete_part_are_refused(env: reacher.Reacher, file: Path) -> None:
    rows = formats.load(file)
    rows.extra = None
    assert "states are not whole" in checks.errors(rows, env)[0]
    rows.extra = np.zeros((rows.size, 3), np.int32)
    assert "extra has 3 numbers per row, reacher has 1" in checks.errors(rows, env)[0]
    without = replace(formats.read(file, env), extra=None)
    (line,) = unmet(without, env, load_config("reacher", "smoke", {"skills.horizon": HORIZON}))
    assert "no infos/extra, the simulator states" in line and "mi_rollout=logged" in line


def test_rollouts_of_skills_start_from_the_whole_state(env: reacher.Reacher, file: Path) -> None:
    data, _ = to_device(formats.read(file, env), HORIZON)
    skills: Any = SimpleNamespace(
        act=lambda params, observation, skill: skill, begin=lambda params, latent, observation: latent
    )
    rollout = PhysicsRollout(env, skills, lambda observation: observation, HORIZON)
    starts = data.starts[::400]
    latent = np.random.default_rng(0).uniform(-1, 1, (len(starts), 2)).astype(np.float32)
    seen = np.asarray(jax.jit(lambda data, starts, latent: rollout({}, data, starts, latent))(data, starts, latent))
    assert data.extra is not None and 0 < np.asarray(data.extra[starts]).sum() < len(starts)
    for n, start in enumerate(starts):
        assert data.qpos is not None and data.qvel is not None
        state = env.reset_to(data.qpos[start], data.qvel[start], extra=data.extra[start])
        for step in range(HORIZON):
            np.testing.assert_allclose(seen[n, step], state.obs, atol=1e-6)
            state = env.step(state, latent[n])


def test_data_check_and_info(file: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["data", "check", str(file), "--env", "reacher", "--horizon", "5"]) == 0
    assert "fits reacher-task1: 2,400 transitions, 60 episodes" in capsys.readouterr().out
    assert main(["data", "info", str(file)]) == 0
    assert "extra              int32 2400x1" in capsys.readouterr().out
    for arguments, message in (
        (["check", str(file), "--env", "antmaze-medium"], "made for another task?"),
        (["check", str(file), "--env", "reacher", "--map", str(tmp_path / "map.png")], "has a position on a map"),
        (["make", "reacher", "--out", str(tmp_path / "a.hdf5")], "no expert is shipped for reacher"),
    ):
        assert main(["data", *arguments]) == 2
        output = capsys.readouterr()
        assert message in output.out + output.err


@pytest.mark.slow
def test_training_knows_no_maze(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    sets = ["skills.horizon=5", "values.n_step=5", "high_level.env_steps=400", "high_level.warmup_env_steps=80"]
    sets += ["labels.start_env_steps=80", "eval.episodes=2", "eval.every_env_steps=200"]
    arguments = ["--env", "reacher", "--preset", "smoke", "--dataset", str(file), "--out", str(out)]
    assert train_main([*arguments, *(part for text in sets for part in ("--set", text))]) == 0
    output = capsys.readouterr()
    assert "left out" not in output.err
    summary = json.loads((out / "summary.json").read_text())
    assert summary["env"] == "reacher-task1" and summary["members"][0]["status"] == "ok"
    with np.load(out / "inside.npz") as found:
        assert {"gain", "return", "0/latent", "0/latents", "0/left"} <= set(found)
        assert not {"goal", "walls", "0/path", "0/grid"} & set(found)
    assert "Weight against quality" in (out / "report.html").read_text()
