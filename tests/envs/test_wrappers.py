"""Auto-reset, on a task small enough to reckon by hand."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State

import envs
from envs.mazes.maze import get_maze
from envs.mazes.maze_task import MazeTask
from envs.physics import PipelineState


class Slider:
    """A point whose velocity is its action; an action above 8 breaks the physics."""

    name = "toy"
    nq = nv = action_size = 2
    extra_size = 0

    def init(self, qpos: jax.Array, qvel: jax.Array, extra: jax.Array | None = None) -> PipelineState:
        none = jnp.zeros(0, jnp.int32) if extra is None else extra
        return PipelineState(
            jnp.asarray(qpos), jnp.asarray(qvel), jnp.zeros(0), none, jnp.zeros(()), jnp.zeros((), jnp.int32)
        )

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        qpos = jnp.where(action[0] > 8, jnp.nan, state.qpos + action)
        return state.replace(qpos=qpos, qvel=action, carry=state.carry + 1, steps=state.steps + 1)


def sliding_task(cap: int = 3) -> MazeTask:
    spec = envs.TaskSpec("toy", "arena", 1, cap)
    return MazeTask(spec, get_maze("arena"), Slider(), np.zeros(2), {"body": 0}, ((1, 1),), (1, 3))


def toy(cap: int = 3) -> envs.AutoReset:
    return envs.AutoReset(sliding_task(cap))


def shapes(state: State) -> Any:
    return jax.tree.map(lambda x: (x.shape, x.dtype), state)


def test_cap_truncates_and_starts_anew() -> None:
    env = toy()
    state = first = env.reset(jax.random.key(0))
    for _ in range(2):
        state = env.step(state, jnp.array([0.0, -0.1]))
        assert float(state.done) == 0.0
    assert shapes(state) == shapes(first)
    last = env.step(state, jnp.array([0.0, -0.1]))
    assert (float(last.done), float(last.info["truncation"]), float(last.reward)) == (1.0, 1.0, -1.0)
    np.testing.assert_allclose(last.info["final_obs"][:2], state.obs[:2] + jnp.array([0.0, -0.1]), atol=1e-6)
    assert not np.allclose(last.obs, last.info["final_obs"])
    np.testing.assert_array_equal(last.obs[:2], last.pipeline_state.qpos)
    assert int(last.pipeline_state.steps) == 0 and float(last.pipeline_state.carry) == 0.0
    onward = env.step(last, jnp.zeros(2))
    assert (float(onward.done), float(onward.info["truncation"]), int(onward.pipeline_state.steps)) == (0.0, 0.0, 1)


def test_success_terminates_without_truncation_even_at_the_cap() -> None:
    for cap in (3, 1):
        env = toy(cap)
        state = env.reset_to(env.goal_xy - 0.1, jnp.zeros(2), env.goal_xy, jax.random.key(1))
        after = env.step(state, jnp.array([-5.0, 0.0]))  # success is read before the action
        assert (float(after.done), float(after.info["truncation"]), float(after.reward)) == (1.0, 0.0, 0.0)
        assert float(after.metrics["success"]) == 1.0
        np.testing.assert_allclose(after.info["final_obs"][:2], env.goal_xy - 0.1 + np.array([-5.0, 0.0]), atol=1e-6)


def test_every_episode_starts_elsewhere() -> None:
    env = toy(cap=1)
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(2), 2))
    starts = [np.asarray(states.obs)]
    for _ in range(5):
        states = jax.vmap(env.step)(states, jnp.zeros((2, 2)))
        starts.append(np.asarray(states.obs))
    flat = np.concatenate(starts)
    assert len(np.unique(flat[:, 0])) == len(flat)
    again = env.reset(jax.random.split(jax.random.key(2), 2)[0])
    np.testing.assert_array_equal(again.obs, starts[0][0])


@pytest.mark.parametrize("name", ["antmaze-medium", "cube-single", "scene-task1", "kitchen-mixed"])
def test_every_family_starts_each_episode_elsewhere(name: str) -> None:
    env = envs.AutoReset(envs.make(name, physics="mujoco"))
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.key(0))
    starts = [np.asarray(state.obs)]
    for _ in range(2):
        last = state.replace(pipeline_state=state.pipeline_state.replace(steps=jnp.int32(env.episode_length - 1)))
        state = step(last, jnp.zeros(env.action_size))
        assert float(state.done) == 1.0
        starts.append(np.asarray(state.obs))
    assert len(np.unique(starts, axis=0)) == 3


def test_broken_physics_is_reset_and_counted() -> None:
    env = toy()
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(3), 2))
    after = jax.jit(jax.vmap(env.step))(states, jnp.array([[9.0, 0.0], [0.1, 0.0]]))
    np.testing.assert_array_equal(after.metrics["nan"], [1.0, 0.0])
    np.testing.assert_array_equal(after.done, [1.0, 0.0])
    np.testing.assert_array_equal(after.info["truncation"], [1.0, 0.0])
    np.testing.assert_array_equal(after.info["final_obs"][0], states.obs[0])
    leaves = [leaf for leaf in jax.tree.leaves(after) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in leaves)


@pytest.mark.parametrize(
    ("physics", "part"), [("mujoco", "qpos"), ("mujoco", "qvel"), pytest.param("mjx", "qpos", marks=pytest.mark.slow)]
)
def test_a_broken_state_resets_its_own_environment_alone(physics: str, part: str) -> None:
    env = envs.AutoReset(envs.make("antmaze-medium", physics=physics))
    step = jax.jit(jax.vmap(env.step))
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    states = step(states, jnp.zeros((3, 8)))
    numbers = getattr(states.pipeline_state, part).at[1, 5].set(jnp.nan)
    broken = states.replace(pipeline_state=states.pipeline_state.replace(**{part: numbers}))
    after, expected = step(broken, jnp.ones((3, 8))), step(states, jnp.ones((3, 8)))
    np.testing.assert_array_equal(after.metrics["nan"], [0, 1, 0])
    np.testing.assert_array_equal(after.done, [0, 1, 0])
    np.testing.assert_array_equal(after.obs[jnp.array([0, 2])], expected.obs[jnp.array([0, 2])])
    assert bool(jnp.isfinite(after.obs).all()) and int(after.pipeline_state.steps[1]) == 0
    onward = step(after, jnp.ones((3, 8)))
    np.testing.assert_array_equal(onward.metrics["nan"], [0, 0, 0])


def test_wrapper_shows_the_task() -> None:
    env = toy()
    assert env.spec.family == "toy" and env.unwrapped is env.env and env.observation_size == 4
    assert env.action_size == 2 and env.backend == "toy"
