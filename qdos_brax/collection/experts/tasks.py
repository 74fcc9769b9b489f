"""What experts are trained on: a body on an open floor, a commanded direction, a reward.

Every function takes one life; the trainer maps them over many.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from envs.mazes import models
from envs.mazes.locomotion import dropped_humanoid, dropped_poses
from envs.physics.base import PipelineState
from envs.physics.mujoco.engine import MujocoEngine
from qdos_brax.collection.experts import policies, symmetry
from qdos_brax.collection.experts.poses import STANDING, humanoid_is_up, standing_humanoid
from qdos_brax.collection.experts.views import (
    ANT_NQ,
    ANT_NV,
    body_view,
    forward_axis,
    random_direction,
    turned,
    uprightness,
)
from qdos_brax.high_level.sac import Batch


class Life(struct.PyTreeNode):
    """One environment of the training.

    Attributes:
        pipeline: the simulator's state.
        direction: float[2], the commanded direction, a unit vector.
        clock: int, control steps since the start.
    """

    pipeline: PipelineState
    direction: jax.Array
    clock: jax.Array


class Verdict(NamedTuple):
    """What a control step was worth.

    Attributes:
        reward: float.
        alive: bool, False where the body fell: the end, without a future.
        lost: bool, the life is not worth going on with, but had a future.
        measures: figures whose means are reported.
    """

    reward: jax.Array
    alive: jax.Array
    lost: jax.Array
    measures: dict[str, jax.Array]


class Task(Protocol):
    """A body and what it shall learn.

    Attributes:
        name: of the expert, and of its weights.
        engine: the physics.
        observation_dim, action_dim: of the policy.
        discount: per control step.
        life_steps: a life ends after so many.
        turn_every: mean steps between two draws of the direction.
        shake: standard deviation of the noise on ``joints`` while it learns, against which it has to hold its own.
    """

    name: str
    engine: MujocoEngine
    observation_dim: int
    action_dim: int
    discount: float
    life_steps: int
    turn_every: int
    shake: float

    def reset(self, key: jax.Array) -> Life:
        """A new life."""
        ...

    def observe(self, life: Life) -> jax.Array:
        """float[observation_dim]."""
        ...

    def joints(self, life: Life, action: jax.Array) -> jax.Array:
        """What the body gets, float[nu] in [-1, 1], for the policy's ``action[action_dim]``."""
        ...

    def judge(self, before: Life, joints: jax.Array, after: PipelineState) -> Verdict:
        """The step from ``before`` to ``after`` under ``joints``."""
        ...

    def mirror(self, batch: Batch) -> Batch:
        """The same transitions as a mirror shows them, or ``batch`` itself for a body that is learned as it is."""
        ...


class AntWalking:
    """Reward: ten times the metres along the direction (OGBench's recipe); falling ends it."""

    name = "ant_walker"
    observation_dim, action_dim = 29, 8
    discount, life_steps, turn_every, shake = 0.99, 10**9, 100, 0.0

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.ant_model(), threads=1)

    def reset(self, key: jax.Array) -> Life:
        """A standing ant with OGBench's reset noise."""
        qpos_key, qvel_key, direction_key = jax.random.split(key, 3)
        rest = jnp.asarray(self.engine.model.qpos0, jnp.float32)
        qpos = rest + jax.random.uniform(qpos_key, rest.shape, minval=-0.1, maxval=0.1)
        pipeline = self.engine.init(qpos, 0.1 * jax.random.normal(qvel_key, (self.engine.nv,)))
        return Life(pipeline, random_direction(direction_key), jnp.zeros((), jnp.int32))

    def observe(self, life: Life) -> jax.Array:
        """The body's view."""
        return body_view(life.pipeline.qpos, life.pipeline.qvel, life.direction)

    def joints(self, life: Life, action: jax.Array) -> jax.Array:
        """The action itself."""
        return action

    def judge(self, before: Life, joints: jax.Array, after: PipelineState) -> Verdict:
        """See the class."""
        speed = (after.qpos[:2] - before.pipeline.qpos[:2]) @ before.direction
        return Verdict(10.0 * speed, ant_is_up(after.qpos), jnp.zeros((), bool), {"speed": speed})

    def mirror(self, batch: Batch) -> Batch:
        """The batch itself."""
        return batch


class AntDribbling:
    """The ball shall roll along the direction, and the ant stay with it.

    Reward per control step: forty times the ball's metres along the direction (at most 1.5 m/s count), less a quarter
    of that for metres aside; closeness to the ball; being behind it; a constant that makes falling cost something.
    The ball's friction is such that it stops within 0.3 m when it is kicked (OGBench's: 0.5 against rolling, about
    3 N of drag), so that it has to be pushed all the way. The life ends at LOST m from the ball, with a future.
    """

    name = "ant_dribbler"
    observation_dim, action_dim = 35, 10
    discount, life_steps, turn_every, shake = 0.98, 300, 80, 0.0

    LOST = 5.0
    FASTEST = 0.15  # m per control step

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.ant_model(ball=True), threads=1)
        self.walker = policies.ant_walker()

    def reset(self, key: jax.Array) -> Life:
        """A standing ant, turned at random, and a ball at rest, 0.7 to 3 m from it."""
        qpos_key, qvel_key, direction_key, place_key, gap_key, yaw_key = jax.random.split(key, 6)
        rest = jnp.asarray(self.engine.model.qpos0, jnp.float32)
        qpos = rest + jax.random.uniform(qpos_key, rest.shape, minval=-0.1, maxval=0.1)
        yaw = jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)
        turn = jnp.stack([jnp.cos(yaw / 2), 0.0, 0.0, jnp.sin(yaw / 2)])
        offset = jax.random.uniform(gap_key, (), minval=0.7, maxval=3.0) * random_direction(place_key)
        qpos = qpos.at[3:7].set(turn).at[ANT_NQ : ANT_NQ + 2].set(qpos[:2] + offset).at[ANT_NQ + 2].set(0.25)
        qvel = 0.1 * jax.random.normal(qvel_key, (self.engine.nv,))
        pipeline = self.engine.init(qpos, qvel.at[ANT_NV:].set(0.0))
        return Life(pipeline, random_direction(direction_key), jnp.zeros((), jnp.int32))

    def observe(self, life: Life) -> jax.Array:
        """The ant's and the ball's view."""
        return policies.dribbler_view(life.pipeline.qpos, life.pipeline.qvel, life.direction)

    def joints(self, life: Life, action: jax.Array) -> jax.Array:
        """The walker's action along a heading, and corrections."""
        return policies.dribbler_joints(self.walker, life.pipeline.qpos, life.pipeline.qvel, life.direction, action)

    def judge(self, before: Life, joints: jax.Array, after: PipelineState) -> Verdict:
        """See the class."""
        ball = after.qpos[ANT_NQ : ANT_NQ + 2]
        way = turned(ball - before.pipeline.qpos[ANT_NQ : ANT_NQ + 2], before.direction)
        offset = ball - after.qpos[:2]
        gap = jnp.linalg.norm(offset)
        behind = offset @ before.direction / jnp.maximum(gap, 1e-6)
        reward = (
            0.5
            + 40.0 * jnp.clip(way[0], -self.FASTEST, self.FASTEST)
            - 10.0 * jnp.minimum(jnp.abs(way[1]), self.FASTEST)
            - 0.3 * jnp.clip(gap - 0.7, 0.0, self.LOST)
            + 0.2 * behind
        )
        measures = {"speed": way[0], "aside": jnp.abs(way[1]), "gap": gap}
        return Verdict(reward, ant_is_up(after.qpos), gap > self.LOST, measures)

    def mirror(self, batch: Batch) -> Batch:
        """The batch itself."""
        return batch


def ant_is_up(qpos: jax.Array) -> jax.Array:
    """bool[...]: the torso's height is within [0.2, 1.0] m and its own z axis points up."""
    return (qpos[..., 2] > 0.2) & (qpos[..., 2] < 1.0) & (uprightness(qpos) > 0.0)


class HumanoidWalking:
    """Upright and along the direction, 40 control steps per second.

    Reward per control step: for speed along the direction most, a parabola that is 0 for none and 2 at PACE (beyond
    it, it would run, and fall); for being up and facing the way a quarter of that (with more, it stands still and is
    content); less for speed aside and for effort. Falling ends it. The direction is at first nearly where the body
    faces, and now and then another. Lives are short, for setting off is where it falls most.
    """

    name = "humanoid_walker"
    observation_dim, action_dim = 55, 21
    discount, life_steps, turn_every, shake = 0.99, 300, 400, 0.2

    PACE = 1.2  # m/s

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.humanoid_model(), threads=1)
        self._seconds = self.engine.frame_skip * self.engine.model.opt.timestep

    def reset(self, key: jax.Array) -> Life:
        """On its feet, the direction mostly ahead."""
        pose_key, qvel_key, yaw_key, direction_key = jax.random.split(key, 4)
        yaw = jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)
        qpos, qvel = standing_humanoid(pose_key, yaw)
        qvel = qvel + 0.1 * jax.random.normal(qvel_key, qvel.shape)
        ahead = yaw + 0.6 * jax.random.normal(direction_key)
        direction = jnp.stack([jnp.cos(ahead), jnp.sin(ahead)])
        return Life(self.engine.init(qpos, qvel), direction, jnp.zeros((), jnp.int32))

    def observe(self, life: Life) -> jax.Array:
        """The body's view."""
        return policies.humanoid_view(life.pipeline.qpos, life.pipeline.qvel, life.direction)

    def joints(self, life: Life, action: jax.Array) -> jax.Array:
        """Springs to where the action says."""
        return policies.humanoid_joints(life.pipeline.qpos, action)

    def judge(self, before: Life, joints: jax.Array, after: PipelineState) -> Verdict:
        """See the class."""
        velocity = turned(after.qpos[:2] - before.pipeline.qpos[:2], before.direction) / self._seconds
        facing = forward_axis(after.qpos)[:2] @ before.direction
        reward = (
            2.0 * jnp.maximum(1.0 - (velocity[0] / self.PACE - 1.0) ** 2, -1.0)
            + 0.3 * uprightness(after.qpos)
            + 0.2 * facing
            - 0.2 * jnp.minimum(jnp.abs(velocity[1]), self.PACE)
            - 0.1 * jnp.mean(joints**2)
        )
        return Verdict(
            reward, humanoid_is_up(after.qpos), jnp.zeros((), bool), {"speed": velocity[0], "facing": facing}
        )

    def mirror(self, batch: Batch) -> Batch:
        """Left and right exchanged: the body is symmetric, the reward as well."""
        return _mirrored(batch)


class HumanoidRising:
    """Up from wherever it fell, and stand.

    Reward per control step: height of the torso as a share of the standing one, half as much again for being
    upright there; one while it is up, less the more it moves then; less for effort. A life begins as OGBench's resets
    do, dropped in a random pose, or (one in STANDING_SHARE) on its feet and pushed; it never ends early, so that lying
    costs.
    """

    name = "humanoid_riser"
    observation_dim, action_dim = 55, 21
    discount, life_steps, turn_every, shake = 0.99, 300, 10**9, 0.0

    STANDING_SHARE = 0.25
    PUSH = 0.5  # standard deviation of the velocities at a start on its feet, m/s and rad/s

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.humanoid_model(), threads=1)
        self._poses = dropped_poses()

    def reset(self, key: jax.Array) -> Life:
        """See the class; the direction is of no matter here."""
        kind_key, drop_key, pose_key, qvel_key, direction_key = jax.random.split(key, 5)
        stands = jax.random.bernoulli(kind_key, self.STANDING_SHARE)
        dropped = jnp.concatenate([jnp.zeros(2), dropped_humanoid(drop_key, self._poses)])
        direction = random_direction(direction_key)
        standing, _ = standing_humanoid(pose_key, jnp.arctan2(direction[1], direction[0]))
        qvel = jnp.where(stands, self.PUSH, 0.1) * jax.random.normal(qvel_key, (self.engine.nv,))
        pipeline = self.engine.init(jnp.where(stands, standing, dropped), qvel)
        return Life(pipeline, direction, jnp.zeros((), jnp.int32))

    def observe(self, life: Life) -> jax.Array:
        """The body's view."""
        return policies.humanoid_view(life.pipeline.qpos, life.pipeline.qvel, life.direction)

    def joints(self, life: Life, action: jax.Array) -> jax.Array:
        """Springs to where the action says."""
        return policies.rising_joints(life.pipeline.qpos, action)

    def judge(self, before: Life, joints: jax.Array, after: PipelineState) -> Verdict:
        """See the class."""
        height = jnp.clip(after.qpos[2] / STANDING, 0.0, 1.0)
        is_up = humanoid_is_up(after.qpos)
        calm = jnp.exp(-jnp.sum(after.qvel[:2] ** 2))
        reward = (
            height + 0.5 * height * jnp.maximum(uprightness(after.qpos), 0.0) + is_up * calm - 0.1 * jnp.mean(joints**2)
        )
        ends = jnp.zeros((), bool)
        return Verdict(reward, ~ends, ends, {"height": after.qpos[2], "up": is_up.astype(jnp.float32)})

    def mirror(self, batch: Batch) -> Batch:
        """Left and right exchanged."""
        return _mirrored(batch)


def _mirrored(batch: Batch) -> Batch:
    return batch._replace(
        observation=symmetry.mirrored_view(batch.observation),
        action=symmetry.mirrored_action(batch.action),
        next_observation=symmetry.mirrored_view(batch.next_observation),
    )


TASKS: dict[str, Callable[[], Task]] = {
    task.name: task for task in (AntWalking, AntDribbling, HumanoidWalking, HumanoidRising)
}
