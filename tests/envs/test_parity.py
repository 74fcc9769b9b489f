"""The MuJoCo C engine is OGBench 1.2.2, bit for bit."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from tests.envs.ogbench_reference import ogbench_env, ogbench_rollout, our_rollout, start_state

STEPS = 200


def start_positions(env: envs.Task, kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A start: at the task's own, pressed against walls, or about to reach the goal."""
    qpos, qvel = start_state(env, seed)
    soccer = env.spec.family == "antsoccer"
    humanoid = env.spec.family == "humanoidmaze"
    if kind == "wall":  # into the corner of cell (1, 1)
        qpos[:3] = (-1.4, -1.4, 1.2) if humanoid else (-1.3, -1.3, 0.6)
        qvel[:2] -= 2.0 if humanoid else 0.0
        if soccer:
            qpos[15:18] = (-1.6, -0.4, 0.3)
            qvel[14:16] = (-2.0, -3.0)
    elif kind == "goal":  # moving towards the goal from just outside
        target = 15 if soccer else 0
        qpos[0:3] = (*(env.goal_xy - 2.0), 0.6)
        qpos[target : target + 2] = env.goal_xy - np.array([0.9, 0.0])
        qpos[target + 2] = 1.2 if humanoid else 0.6
        qvel[14 if soccer else 0] = 3.0
    return qpos, qvel


@pytest.mark.parametrize("name", ["antmaze-medium-task1", "antsoccer-arena-task4", "humanoidmaze-medium-task1"])
def test_rollouts_equal_ogbench_bit_for_bit(name: str) -> None:
    env = envs.make(name, physics="mujoco")
    reference = ogbench_env(name)
    rng = np.random.default_rng(0)
    wall_contacts = 0
    successes = []
    for seed, kind in enumerate(["task", "wall", "goal"]):
        qpos, qvel = start_positions(env, kind, seed)
        actions = rng.uniform(-1.2, 1.2, (STEPS, env.action_size)).astype(np.float32)  # beyond the range too: both clip
        used = env.episode_length - STEPS if kind == "task" else 0  # the cap falls on the last step
        expected = ogbench_rollout(reference, qpos, qvel, actions, steps_done=used)
        state = env.reset_to(qpos, qvel, env.goal_xy)
        state = state.replace(pipeline_state=state.pipeline_state.replace(steps=jnp.int32(used)))
        states = our_rollout(env, state, actions)

        exact = np.concatenate(env.engine.exact_state(states.pipeline_state), axis=-1)
        np.testing.assert_array_equal(exact, expected["state"])
        np.testing.assert_allclose(states.obs, expected["obs"], rtol=1e-7, atol=1e-5)
        assert states.obs.dtype == np.float32
        np.testing.assert_array_equal(states.info["final_obs"], states.obs)
        np.testing.assert_array_equal(states.reward, expected["reward"])
        np.testing.assert_array_equal(states.metrics["success"], expected["success"])
        np.testing.assert_array_equal(states.info["truncation"], expected["truncated"])
        terminated = np.asarray(states.done) * (1 - np.asarray(states.info["truncation"]))
        np.testing.assert_array_equal(terminated, expected["terminated"])
        if kind == "wall":
            wall_contacts = _wall_contacts(env.whole_model(), exact)
        if kind == "goal":
            successes = list(np.flatnonzero(expected["success"]))
        if kind == "task":
            assert list(np.flatnonzero(states.info["truncation"])) == [STEPS - 1]
    assert wall_contacts >= 10
    assert successes and successes[0] > 0


def test_teleporters_equal_ogbench_bit_for_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """OGBench draws exits with NumPy; it is given those that we drew, in turn."""
    env = envs.make("antmaze-teleport-task2", physics="mujoco")
    reference = ogbench_env("antmaze-teleport-task2")
    exits = env.layout.ij_to_xy(np.array(env.layout.teleporters.exits))
    np.testing.assert_array_equal(exits, reference.unwrapped._teleport_info["teleport_out_xys"])
    rng = np.random.default_rng(0)
    seen: set[int] = set()
    for seed, entrance in enumerate((*env.layout.teleporters.entrances, (4, 6))):
        qpos, qvel = start_state(env, seed)
        qpos[:3] = (*(env.layout.ij_to_xy(entrance) - np.array([0.0, 1.7])), 0.6)
        qvel[1] = 3.0
        actions = rng.uniform(-1, 1, (STEPS // 2, 8)).astype(np.float32)
        states = our_rollout(env, env.reset_to(qpos, qvel, key=jax.random.key(seed)), actions)
        exact = np.concatenate(env.engine.exact_state(states.pipeline_state), axis=-1)

        jumps = np.linalg.norm(np.diff(exact[:, :2], axis=0, prepend=qpos[None, :2]), axis=1) > 2
        drawn = [int(np.linalg.norm(exits - xy, axis=1).argmin()) for xy in exact[jumps, :2]]
        left = iter(drawn)
        with monkeypatch.context() as patch:
            patch.setattr(np.random, "randint", lambda size, left=left: next(left))
            expected = ogbench_rollout(reference, qpos, qvel, actions)

        assert drawn and next(left, None) is None
        np.testing.assert_array_equal(exact, expected["state"])
        np.testing.assert_allclose(states.obs, expected["obs"], rtol=1e-7, atol=1e-5)
        np.testing.assert_array_equal(states.reward, expected["reward"])
        entering = np.flatnonzero(jumps)[0]
        assert np.linalg.norm(states.obs[entering, :2] - env.layout.ij_to_xy(entrance)) <= 1.5
        seen |= set(drawn)
    assert len(seen) > 1


def test_sensed_is_fresh_wherever_a_state_comes_from() -> None:
    """The humanoid's observation after reset_to, one by one, batched and in jit, is OGBench's of the same state."""
    env = envs.make("humanoidmaze-large", physics="mujoco")
    reference = ogbench_env("humanoidmaze-large-task1")
    reference.reset()
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    qpos, qvel = np.array(states.pipeline_state.qpos), np.array(states.pipeline_state.qvel)
    qvel *= 10
    batched = jax.jit(jax.vmap(lambda q, v: env.reset_to(q, v).obs))(qpos, qvel)
    for n in range(3):
        reference.unwrapped.set_state(qpos[n].astype(np.float64), qvel[n].astype(np.float64))
        expected = reference.unwrapped.get_ob()
        np.testing.assert_allclose(batched[n], expected, rtol=1e-7, atol=1e-6)
        np.testing.assert_allclose(env.reset_to(qpos[n], qvel[n]).obs, expected, rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize(
    "name", ["antmaze-giant-task3", "antsoccer-medium-task2", "antmaze-teleport-task4", "humanoidmaze-giant-task5"]
)
def test_model_and_task_equal_ogbench(name: str) -> None:
    env = envs.make(name, physics="mujoco")
    reference = ogbench_env(name)
    ours, theirs = env.whole_model(), reference.unwrapped.model
    names = """geom_type geom_size geom_pos geom_quat geom_friction geom_margin geom_solref geom_solimp geom_condim
        geom_contype geom_conaffinity geom_priority body_mass body_inertia body_pos jnt_type jnt_axis jnt_range
        jnt_stiffness jnt_solimp body_quat body_ipos body_iquat body_parentid dof_armature dof_damping actuator_gear
        actuator_ctrlrange actuator_trnid qpos0""".split()  # noqa: SIM905
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
