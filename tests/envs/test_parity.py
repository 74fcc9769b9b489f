"""The MuJoCo C engine is OGBench 1.2.2, bit for bit."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from tests.envs.ogbench_reference import ogbench_env, ogbench_rollout, our_rollout, start_state

STEPS = 200


def start_positions(env: envs.TaskEnv, kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A start: at the task's own, pressed against walls, or about to reach the goal."""
    qpos, qvel = start_state(env, seed)
    soccer = env.spec.family == "antsoccer"
    if kind == "wall":  # into the corner of cell (1, 1)
        qpos[:3] = (-1.3, -1.3, 0.6)
        if soccer:
            qpos[15:18] = (-1.6, -0.4, 0.3)
            qvel[14:16] = (-2.0, -3.0)
    elif kind == "goal":  # moving towards the goal from just outside
        target = 15 if soccer else 0
        qpos[0:3] = (*(env.goal_xy - 2.0), 0.6)
        qpos[target : target + 2] = env.goal_xy - np.array([0.9, 0.0])
        qpos[target + 2] = 0.6
        qvel[14 if soccer else 0] = 3.0
    return qpos, qvel


@pytest.mark.parametrize("name", ["antmaze-medium-task1", "antsoccer-arena-task4"])
def test_rollouts_equal_ogbench_bit_for_bit(name: str) -> None:
    env = envs.make(name, physics="mujoco")
    reference = ogbench_env(name)
    rng = np.random.default_rng(0)
    wall_contacts = 0
    successes = []
    for seed, kind in enumerate(["task", "wall", "goal"]):
        qpos, qvel = start_positions(env, kind, seed)
        actions = rng.uniform(-1.2, 1.2, (STEPS, 8)).astype(np.float32)  # beyond the range too: both clip
        used = 1000 - STEPS if kind == "task" else 0  # the cap falls on the last step
        expected = ogbench_rollout(reference, qpos, qvel, actions, steps_done=used)
        state = env.reset_to(qpos, qvel, env.goal_xy)
        state.info["steps"] = jnp.int32(used)
        states = our_rollout(env, state, actions)

        exact = np.concatenate(env.engine.exact_state(states.pipeline_state), axis=-1)
        np.testing.assert_array_equal(exact, expected["obs"])
        np.testing.assert_allclose(states.obs, expected["obs"], rtol=1e-7, atol=1e-5)
        np.testing.assert_array_equal(states.info["final_obs"], states.obs)
        np.testing.assert_array_equal(states.reward, expected["reward"])
        np.testing.assert_array_equal(states.metrics["success"], expected["success"])
        np.testing.assert_array_equal(states.info["truncation"], expected["truncated"])
        terminated = np.asarray(states.done) * (1 - np.asarray(states.info["truncation"]))
        np.testing.assert_array_equal(terminated, expected["terminated"])
        if kind == "wall":
            wall_contacts = _wall_contacts(env.engine.model, exact)
        if kind == "goal":
            successes = list(np.flatnonzero(expected["success"]))
        if kind == "task":
            assert list(np.flatnonzero(states.info["truncation"])) == [STEPS - 1]
    assert wall_contacts >= 10
    assert successes and successes[0] > 0


@pytest.mark.parametrize("name", ["antmaze-giant-task3", "antsoccer-medium-task2"])
def test_model_and_task_equal_ogbench(name: str) -> None:
    env = envs.make(name, physics="mujoco")
    reference = ogbench_env(name)
    ours, theirs = env.engine.model, reference.unwrapped.model
    names = """geom_type geom_size geom_pos geom_quat geom_friction geom_margin geom_solref geom_solimp geom_condim
        geom_contype geom_conaffinity geom_priority body_mass body_inertia body_pos jnt_type jnt_axis jnt_range
        dof_armature dof_damping actuator_gear actuator_ctrlrange actuator_trnid qpos0""".split()  # noqa: SIM905
    reference.reset()
    theirs.geom("target").pos[:] = ours.geom("target").pos  # OGBench moves it, for show
    for field in names:
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)
    for field in ("timestep", "integrator", "solver", "iterations", "ls_iterations", "tolerance", "cone", "impratio"):
        assert getattr(ours.opt, field) == getattr(theirs.opt, field), field
    info = reference.unwrapped.cur_task_info
    np.testing.assert_array_equal(env.goal_xy, info["goal_xy"])
    np.testing.assert_array_equal(env.layout.grid, reference.unwrapped.maze_map)
    for seed in range(3):
        qpos, _ = start_state(env, seed)
        start = np.asarray(info.get("init_xy", info.get("agent_init_xy")))
        assert np.abs(qpos[:2] - start).max() <= 1.0
        if "ball_init_xy" in info:
            assert np.abs(qpos[15:17] - np.asarray(info["ball_init_xy"])).max() <= 1.0


def _wall_contacts(model: mujoco.MjModel, states: np.ndarray) -> int:
    """How many of ``states[T, nq + nv]`` have a moving geom in touch with a wall."""
    data = mujoco.MjData(model)
    walls = [g for g in range(model.ngeom) if model.geom(g).name.startswith("block_")]
    count = 0
    for row in states:
        data.qpos[:], data.qvel[:] = row[: model.nq], row[model.nq :]
        mujoco.mj_forward(model, data)
        count += bool(np.isin(data.contact.geom[: data.ncon], walls).any())
    return count
