"""Getting up: stages and torques by hand, motions on real physics, the hand-over to the walker."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.mazes import models
from envs.physics.mujoco.engine import MujocoEngine
from qdos_brax.collection.experts import falls, policies, rising
from qdos_brax.collection.experts.policies import MAX_TURN
from qdos_brax.collection.experts.poses import humanoid_is_up
from qdos_brax.collection.experts.rising import CROUCHES, LIES, RISES, TURNS, WALKS, Motion, Motions
from qdos_brax.collection.experts.symmetry import HUMANOID_ACTUATED, mirrored_action
from qdos_brax.collection.experts.views import random_direction
from qdos_brax.errors import UserError

HALF = float(np.sqrt(0.5))
MOTIONS = Motions(
    turn=Motion(np.full((1, 21), 0.5, np.float32), np.array([0.1], np.float32)),
    crouch=Motion(np.stack([np.full(21, 1.0), np.full(21, -1.0)]).astype(np.float32), np.array([0.1, 0.2], np.float32)),
)


def pose(height: float, quaternion: tuple[float, ...]) -> jax.Array:
    return jnp.zeros(28).at[2].set(height).at[3:7].set(jnp.array(quaternion))


UPRIGHT, ON_BACK, ON_FRONT = (1.0, 0, 0, 0), (HALF, 0, -HALF, 0), (HALF, 0, HALF, 0)


@pytest.mark.parametrize(
    ("doing", "steps", "qpos", "speed", "expected"),
    [
        (WALKS, 7, pose(1.2, UPRIGHT), 1.0, [WALKS, 8]),
        (WALKS, 7, pose(0.5, UPRIGHT), 1.0, [LIES, 0]),
        (WALKS, 7, pose(1.2, ON_BACK), 1.0, [LIES, 0]),
        (LIES, 19, pose(0.1, ON_BACK), 0.0, [LIES, 20]),  # it may have just begun to fall
        (LIES, 20, pose(0.1, ON_BACK), 0.0, [CROUCHES, 0]),
        (LIES, 20, pose(0.1, ON_BACK), 0.5, [LIES, 21]),
        (LIES, 60, pose(0.1, ON_BACK), 0.5, [CROUCHES, 0]),
        (LIES, 20, pose(0.1, ON_FRONT), 0.0, [TURNS, 0]),
        (TURNS, 3, pose(0.1, ON_FRONT), 1.0, [TURNS, 4]),
        (TURNS, 4, pose(0.1, ON_FRONT), 1.0, [LIES, 0]),  # 0.1 s
        (CROUCHES, 27, pose(0.5, UPRIGHT), 1.0, [CROUCHES, 28]),
        (CROUCHES, 28, pose(0.5, UPRIGHT), 1.0, [RISES, 0]),  # 0.3 s, held for 16 steps
        (RISES, 29, pose(1.25, UPRIGHT), 1.0, [RISES, 30]),
        (RISES, 30, pose(1.25, UPRIGHT), 1.0, [WALKS, 0]),
        (RISES, 39, pose(0.5, UPRIGHT), 1.0, [RISES, 40]),
        (RISES, 39, pose(1.25, ON_BACK), 1.0, [RISES, 40]),
        (RISES, 40, pose(0.5, UPRIGHT), 1.0, [LIES, 0]),
        (RISES, 40, pose(1.15, UPRIGHT), 1.0, [WALKS, 0]),
    ],
)
def test_stages_by_hand(doing: int, steps: int, qpos: jax.Array, speed: float, expected: list[int]) -> None:
    memory = jnp.array([doing, steps], jnp.int32)
    np.testing.assert_array_equal(rising.next_stage(MOTIONS, memory, qpos, jnp.full(27, speed)), expected)


def test_key_poses_are_joined_by_straight_lines() -> None:
    seen = [float(rising.pose_at(MOTIONS.crouch, jnp.asarray(steps))[5]) for steps in (0, 2, 4, 8, 12, 40)]
    np.testing.assert_allclose(seen, [0.0, 0.5, 1.0, 0.0, -1.0, -1.0], atol=1e-6)


def test_torques_by_hand() -> None:
    joints = np.zeros(21)
    joints[[HUMANOID_ACTUATED[6], HUMANOID_ACTUATED[15]]] = 0.4, 0.4  # a knee, and a shoulder
    qpos, qvel = jnp.zeros(28).at[7:].set(joints), jnp.zeros(27).at[6:].set(2.0)
    torques = rising.holding_torques(qpos, qvel, jnp.zeros(21).at[0].set(3.0))
    assert torques[0] == 1.0  # abdomen, clipped
    np.testing.assert_allclose(torques[6], -0.4 - 0.02 * 2, atol=1e-6)
    np.testing.assert_allclose(torques[15], -0.5 * 0.4 - 0.01 * 2, atol=1e-6)


def test_only_a_walking_humanoid_gets_the_walkers_action() -> None:
    recovery = rising.humanoid_rising()
    qpos, qvel, action = pose(0.1, ON_BACK), jnp.zeros(27), jnp.full(21, 0.3)
    act = jax.jit(recovery.act)
    np.testing.assert_array_equal(act(recovery.begin(), qpos, qvel, action), action)
    for doing, target in ((LIES, jnp.zeros(21)), (TURNS, rising.pose_at(recovery.motions.turn, jnp.asarray(5)))):
        given = act(jnp.array([doing, 5], jnp.int32), qpos, qvel, action)
        np.testing.assert_allclose(given, rising.holding_torques(qpos, qvel, target), atol=1e-6)
    assert not np.allclose(act(jnp.array([RISES, 5], jnp.int32), qpos, qvel, action), action)
    np.testing.assert_array_equal(recovery.follow(recovery.begin(), qpos, qvel), [LIES, 0])


def test_motions_come_back_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "motions.npz"
    rising.write_motions(path, MOTIONS, {"command": "a command"})
    again, header = rising.read_motions(path)
    assert header == {"command": "a command"}
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(MOTIONS), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(UserError, match=r"cannot read the motions .*train_motions"):
        rising.humanoid_motions(tmp_path / "none.npz")


def test_bodies_dropped_as_the_task_drops_them_end_in_a_crouch() -> None:
    engine, motions = MujocoEngine(models.humanoid_model(), threads=1), rising.humanoid_motions()
    poses = motions.crouch.poses
    np.testing.assert_allclose(jax.vmap(mirrored_action)(poses), poses, atol=1e-6)
    drop_key, noise_key = jax.random.split(jax.random.key(5))
    state = falls.dropped(engine, drop_key, 24)
    seen = falls.arrivals(engine, RISES, motions, state, jnp.zeros((24, 1)), noise_key)
    assert seen.arrived.mean() > 0.9 and seen.some() is seen
    tall = np.asarray(seen.qpos[:, 2] > 0.45) & np.asarray(rising.uprightness(seen.qpos) > 0.8)
    assert (tall & np.asarray(seen.arrived)).mean() > 0.85
    assert np.asarray(state.qpos[:, 2] == 1.5).all() and np.abs(seen.qpos[:, 2] - 1.5).min() > 0.5


def test_an_expert_that_nobody_reaches_is_refused_before_it_is_trained() -> None:
    nobody = falls.Arrivals(jnp.zeros((3, 28)), jnp.zeros((3, 27)), jnp.zeros(3, bool))
    with pytest.raises(UserError, match="none of 3 fallen humanoids got as far"):
        nobody.some()


@pytest.mark.slow
@pytest.mark.parametrize("max_turn", [1.0, MAX_TURN])
def test_a_dropped_humanoid_gets_up_and_walks_on(max_turn: float) -> None:
    """256 of the task's own resets, 20 s each without noise, then along a direction of their own."""
    episodes, steps = 256, 800
    engine, walker = MujocoEngine(models.humanoid_model()), policies.humanoid_walker(max_turn=max_turn)
    recovery = rising.humanoid_rising()
    drop_key, direction_key = jax.random.split(jax.random.key(11))
    state = falls.dropped(engine, drop_key, episodes)
    direction = jax.vmap(random_direction)(jax.random.split(direction_key, episodes))

    def step(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], tuple[jax.Array, ...]]:
        state, memory = carry
        memory = jax.vmap(recovery.follow)(memory, state.qpos, state.qvel)
        action = walker.act(state.qpos, state.qvel, direction)
        after = jax.vmap(engine.step)(state, jax.vmap(recovery.act)(memory, state.qpos, state.qvel, action))
        way = jnp.sum((after.qpos[:, :2] - state.qpos[:, :2]) * direction, axis=1)
        return (after, memory), (memory[:, 0], humanoid_is_up(after.qpos), way)

    memory = jnp.tile(recovery.begin(), (episodes, 1))
    run = jax.jit(lambda state, memory: jax.lax.scan(step, (state, memory), length=steps)[1])
    doing, is_up, way = map(np.asarray, run(state, memory))
    within = {seconds: float(is_up[40 * seconds - 1].mean()) for seconds in (4, 5, 8)}
    rose = np.array([np.argmax(np.convolve(up[60:], np.ones(40), "valid") == 40) + 60 for up in is_up.T]) / 40
    walks = doing == WALKS
    later = walks[320:-1]
    falls_per_1000 = 1000 * (later & (doing[321:] == LIES)).sum() / later.sum()
    speed = way[320:][walks[320:]].mean() * 40
    print(f"up after 4, 5, 8 s: {within}; rose after {np.median(rose):.2f} s (median of all)")
    print(f"from 8 s on {falls_per_1000:.2f} falls per 1,000 steps of walking, {speed:.2f} m/s along the direction")
    assert within[5] >= 0.9 and within[8] >= 0.95 and np.median(rose) < 5
    assert speed >= 1.0 and falls_per_1000 < 0.2
