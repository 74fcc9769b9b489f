"""Views, the shipped weights, and the dribbler's steering before it learns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from qdos_brax.collection import bodies, collect
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.poses import humanoid_is_up
from qdos_brax.collection.experts.tasks import HumanoidWalking
from qdos_brax.collection.experts.views import body_view, random_direction, turned
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
    np.testing.assert_allclose(turned(jnp.asarray(direction), jnp.asarray(direction)), [1.0, 0.0], atol=1e-6)


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
    policies.write_actor(path, walker.actor)
    again = policies.ant_walker(path)
    assert policies.digest(again) == policies.digest(walker)
    assert again.actor.header == walker.actor.header and again.actor.hidden == walker.actor.hidden
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match="cannot read the expert's weights"):
        policies.ant_walker(path)
    with pytest.raises(UserError, match="cannot read the expert's weights"):
        policies.ant_walker(tmp_path / "none.npz")


@pytest.mark.parametrize("name", ["ant_walker", "ant_dribbler", "humanoid_walker"])
def test_shipped_weights_are_small_and_say_where_they_come_from(name: str) -> None:
    path = policies.shipped(name)
    assert path.stat().st_size < 5_000_000
    header = policies.read_actor(path).header
    assert {"command", "seed", "steps", "seconds", "speed", "falls_per_1000"} <= set(header)


@pytest.mark.slow
def test_the_dribbler_scores() -> None:
    env = envs.make("antsoccer-arena", physics="mujoco")
    assert collect.goals_per_1000(env, policies.ant_dribbler(), noise=0.2, seed=0) >= 5.0


class HeldGoal(collect.Collector):
    """Collects the task itself: from its start, always to its goal."""

    def _draw(self, key: jax.Array) -> collect.Draws:
        return super()._draw(key)._replace(goal_xy=jnp.asarray(self.env.goal_xy, jnp.float32))

    def _reset_lane(self, key: jax.Array) -> collect.Lane:
        pipeline = self.env.reset(key).pipeline_state
        goal, (body, ball) = jnp.asarray(self.env.goal_xy, jnp.float32), (pipeline.qpos[:2], pipeline.qpos[15:17])
        lane = super()._reset_lane(key).replace(pipeline=pipeline, observation=self.env.observe(pipeline))
        return lane.replace(goal_xy=goal, origin_xy=ball, away_xy=body, seen_body=body, seen_cargo=ball)


@pytest.mark.slow
def test_the_dribbler_gets_the_ball_out_of_a_corner_and_along_a_wall() -> None:
    env, noise = envs.make("antsoccer-arena-task4", physics="mujoco"), 0.2
    collector = HeldGoal(env, policies.ant_dribbler(), named("navigate", bodies.conduct_of(env), noise))
    kinds = np.full(32, QUALITY["navigate"], np.int8)
    qpos = collector.run(jax.random.key(0), kinds, 1000)[0]["infos/qpos"].reshape(32, 1000, -1)
    scored = np.asarray(env.success(qpos, env.goal_xy)).astype(bool)
    assert scored.any(axis=1).mean() >= 0.9
    assert np.median(scored.argmax(axis=1)[scored.any(axis=1)]) <= 500


@pytest.mark.slow
def test_the_humanoid_walks() -> None:
    """64 episodes of 1,000 steps from standing, each along a direction of its own, without noise."""
    task, walker, episodes = HumanoidWalking(), policies.humanoid_walker(), 64
    reset_key, direction_key = jax.random.split(jax.random.key(7))
    lives = jax.vmap(task.reset)(jax.random.split(reset_key, episodes))
    direction = jax.vmap(random_direction)(jax.random.split(direction_key, episodes))

    def step(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], jax.Array]:
        state, is_up = carry
        after = jax.vmap(task.engine.step)(state, jax.vmap(walker.act)(state.qpos, state.qvel, direction))
        way = jnp.sum((after.qpos[:, :2] - state.qpos[:, :2]) * direction, axis=1)
        return (after, is_up & humanoid_is_up(after.qpos)), way

    start = (lives.pipeline, jnp.ones(episodes, bool))
    (_, is_up), way = jax.jit(lambda carry: jax.lax.scan(step, carry, length=1000))(start)
    speed, fell = float(way.sum(axis=0).mean() / 25.0), 1.0 - float(is_up.mean())
    print(f"{speed:.3f} m/s along the direction, {fell:.3f} fell")
    assert speed >= 1.0
    assert fell < 0.05
