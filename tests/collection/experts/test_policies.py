"""Views, the shipped weights, and the dribbler's steering before it learns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from qdos_brax.collection.collector import Collector
from qdos_brax.collection.experts import policies, weights
from qdos_brax.collection.experts.poses import humanoid_is_up
from qdos_brax.collection.experts.tasks import HumanoidWalking
from qdos_brax.collection.experts.views import body_view, random_direction, to_direction_frame
from qdos_brax.collection.profiles import profile_of
from qdos_brax.collection.recipes import named
from qdos_brax.data.quality import QUALITY
from qdos_brax.errors import UserError


def rotated(qpos: np.ndarray, qvel: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """The ant with ball after the whole world was turned by ``angle`` about the origin's vertical."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    half = np.array([np.cos(angle / 2), np.sin(angle / 2)])
    qpos, qvel = qpos.copy(), qvel.copy()
    for place, speed in ((0, 0), (15, 14)):
        qpos[place : place + 2] = turn @ qpos[place : place + 2]
        qvel[speed : speed + 2] = turn @ qvel[speed : speed + 2]
        w, x, y, z = qpos[place + 3 : place + 7]
        c, s = half  # the quaternion (c, 0, 0, s) times (w, x, y, z)
        qpos[place + 3 : place + 7] = [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]
    return qpos, qvel


@pytest.mark.parametrize("angle", [0.7, -2.5])
def test_a_turned_world_looks_the_same(angle: float) -> None:
    rng = np.random.default_rng(0)
    qpos, qvel = rng.normal(size=22), rng.normal(size=20)
    for place in (3, 18):
        qpos[place : place + 4] /= np.linalg.norm(qpos[place : place + 4])
    direction = np.array([0.6, 0.8])
    turned_direction = np.array([np.cos(angle) * 0.6 - np.sin(angle) * 0.8, np.sin(angle) * 0.6 + np.cos(angle) * 0.8])
    other = rotated(qpos, qvel, angle)
    view = policies.dribbler_view(*map(jnp.asarray, (qpos, qvel, direction)))
    same = policies.dribbler_view(*map(jnp.asarray, (*other, turned_direction)))
    np.testing.assert_allclose(view, same, atol=1e-5)
    assert view.shape == (35,)
    np.testing.assert_allclose(
        to_direction_frame(jnp.asarray(direction), jnp.asarray(direction)), [1.0, 0.0], atol=1e-6
    )


def test_forward_and_up_of_a_known_pose() -> None:
    half = np.sqrt(0.5)
    qpos = jnp.zeros(15).at[2:7].set(jnp.array([0.6, half, 0.0, 0.0, half]))  # faces +y
    view = body_view(qpos, jnp.zeros(14), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(view[:7], [0.6, 1, 0, 0, 0, 0, 1], atol=1e-6)
    view = body_view(qpos, jnp.zeros(14), jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(view[1:4], [0, 1, 0], atol=1e-6)


@pytest.mark.parametrize(("off", "taken"), [(0.3, 0.3), (-0.3, -0.3), (2.5, 0.7), (-3.0, -0.7)])
def test_the_humanoid_turns_in_a_curve(off: float, taken: float) -> None:
    yaw = 2.0  # where it faces, leaning forward by 0.4
    turn, lean = np.array([np.cos(1.0), 0, 0, np.sin(1.0)]), np.array([np.cos(0.2), 0, np.sin(0.2), 0])
    quat = [turn[0] * lean[0], -turn[3] * lean[2], turn[0] * lean[2], turn[3] * lean[0]]  # first the lean
    qpos = jnp.zeros(28).at[3:7].set(jnp.array(quat))
    heading = policies.humanoid_heading(qpos, jnp.array([np.cos(yaw + off), np.sin(yaw + off)]), 0.7)
    np.testing.assert_allclose(heading, [np.cos(yaw + taken), np.sin(yaw + taken)], atol=1e-5)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_in_front_of_the_ball_it_goes_round_it(side: float) -> None:
    at = jnp.array([1.0, 0.1 * side])
    closest = 10.0
    for _ in range(80):
        heading = policies.push_heading(-at)
        np.testing.assert_allclose(jnp.linalg.norm(heading), 1.0, atol=1e-5)
        at = at + 0.1 * heading
        if at[0] < -0.5 and abs(at[1]) < 0.8:  # behind it, in the lane
            break
        closest = min(closest, float(jnp.linalg.norm(at)))
    assert at[0] < -0.5
    assert closest > 0.6
    onward = policies.push_heading(-at)
    assert onward[0] > 0.0 and onward[1] * at[1] < 0.0  # through the ball, and back into the middle of the lane


def test_weights_come_back_as_they_were_written(tmp_path: Path) -> None:
    walker = policies.ant_walker()
    path = tmp_path / "copy.npz"
    weights.write_actor(path, walker.actor)
    again = policies.ant_walker(path)
    assert policies.digest(again) == policies.digest(walker)
    assert again.actor.header == walker.actor.header and again.actor.hidden == walker.actor.hidden
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match="cannot read the expert's weights"):
        policies.ant_walker(path)
    with pytest.raises(UserError, match="cannot read the expert's weights"):
        policies.ant_walker(tmp_path / "none.npz")


@pytest.mark.parametrize("name", ["ant_walker", "ant_dribbler", "humanoid_walker", "humanoid_riser"])
def test_shipped_weights_are_small_and_say_where_they_come_from(name: str) -> None:
    path = weights.shipped(name)
    assert path.stat().st_size < 5_000_000
    header = weights.read_actor(path).header
    assert {"command", "seed", "steps", "seconds", "speed", "falls_per_1000"} <= set(header)


@pytest.mark.slow
def test_the_dribbler_scores() -> None:
    """Goals per 1,000 steps, averaged over 64 episodes of ``navigate`` (OGBench's: on arrival another random goal)."""
    env = envs.make("antsoccer-arena", physics="mujoco")
    collector = Collector(env, named("navigate", profile_of(env), noise=0.2))
    reset_key, step_key = jax.random.split(jax.random.key(0))
    states = collector.reset(jax.random.split(reset_key, 64))
    states = collector.run(states, np.full(64, QUALITY["navigate"], np.int8), 1000, step_key)[1]
    assert np.mean(states.arrivals) >= 5.0


@pytest.mark.slow
def test_the_dribbler_gets_the_ball_out_of_a_corner_and_along_a_wall() -> None:
    """The task itself: every episode starts at its start and keeps its goal."""
    env, episodes = envs.make("antsoccer-arena-task4", physics="mujoco"), 32
    collector = Collector(env, replace(named("navigate", profile_of(env), noise=0.2), goal_cells=1))
    reset_key, step_key = jax.random.split(jax.random.key(0))
    reset_keys = jax.random.split(reset_key, episodes)
    pipeline = jax.jit(jax.vmap(env.reset))(reset_keys).pipeline_state
    body, ball = pipeline.qpos[:, :2], pipeline.qpos[:, 15:17]
    states = collector.reset(reset_keys).replace(
        pipeline=pipeline,
        observation=jax.vmap(env.observe)(pipeline),
        has_ball=jnp.ones(episodes, bool),
        goal_xy=jnp.tile(jnp.asarray(env.goal_xy, jnp.float32), (episodes, 1)),
        origin_xy=ball,
        escape_xy=body,
        checked_body=body,
        checked_object=ball,
    )
    rows = collector.run(states, np.full(episodes, QUALITY["navigate"], np.int8), 1000, step_key)[0]
    qpos = rows["infos/qpos"].reshape(episodes, 1000, -1)
    scored = np.asarray(env.success(qpos, env.goal_xy)).astype(bool)
    assert scored.any(axis=1).mean() >= 0.9
    assert np.median(scored.argmax(axis=1)[scored.any(axis=1)]) <= 500


@pytest.mark.slow
def test_the_humanoid_walks(monkeypatch: pytest.MonkeyPatch) -> None:
    """64 episodes of 1,000 steps from standing, each along a direction of its own, without noise."""
    monkeypatch.setattr(HumanoidWalking, "RISEN", 1)
    monkeypatch.setattr(HumanoidWalking, "RISEN_SHARE", 0.0)
    task, walker, episodes = HumanoidWalking(), policies.humanoid_walker(), 64
    reset_key, direction_key = jax.random.split(jax.random.key(7))
    states = jax.vmap(task.reset)(jax.random.split(reset_key, episodes))
    direction = jax.vmap(random_direction)(jax.random.split(direction_key, episodes))

    def step(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], jax.Array]:
        state, is_up = carry
        after = jax.vmap(task.engine.step)(state, jax.vmap(walker.act)(state.qpos, state.qvel, direction))
        way = jnp.sum((after.qpos[:, :2] - state.qpos[:, :2]) * direction, axis=1)
        return (after, is_up & humanoid_is_up(after.qpos)), way

    start = (states.pipeline, jnp.ones(episodes, bool))
    (_, is_up), way = jax.jit(lambda carry: jax.lax.scan(step, carry, length=1000))(start)
    speed, fell = float(way.sum(axis=0).mean() / 25.0), 1.0 - float(is_up.mean())
    print(f"{speed:.3f} m/s along the direction, {fell:.3f} fell")
    assert speed >= 1.3
    assert fell < 0.05
