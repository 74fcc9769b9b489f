"""Tasks of the ant's experts: walk along a direction, or take a ball along it."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.mazes import models
from envs.physics.base import PipelineState
from envs.physics.mujoco.engine import MujocoEngine
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.tasks.base import EnvState, StepResult
from qdos_brax.collection.experts.views import (
    ANT_NQ,
    ANT_NV,
    body_view,
    random_direction,
    to_direction_frame,
    uprightness,
)
from qdos_brax.data.transitions import Transition


class AntWalking:
    """Reward ten times the metres along the direction (OGBench's recipe); end the episode when the ant falls."""

    name = "ant_walker"
    observation_dim, action_dim = 29, 8
    discount, episode_steps, direction_steps, action_noise = 0.99, 10**9, 100, 0.0

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.ant_model(), threads=1)

    def reset(self, key: jax.Array) -> EnvState:
        """Draw a standing ant with OGBench's reset noise."""
        qpos_key, qvel_key, direction_key = jax.random.split(key, 3)
        rest = jnp.asarray(self.engine.model.qpos0, jnp.float32)
        qpos = rest + jax.random.uniform(qpos_key, rest.shape, minval=-0.1, maxval=0.1)
        pipeline = self.engine.init(qpos, 0.1 * jax.random.normal(qvel_key, (self.engine.nv,)))
        return EnvState(pipeline, random_direction(direction_key), jnp.zeros((), jnp.int32))

    def observe(self, state: EnvState) -> jax.Array:
        """Return the body's view, float[29]."""
        return body_view(state.pipeline.qpos, state.pipeline.qvel, state.direction)

    def torques(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Return the action itself."""
        return action

    def evaluate_step(self, before: EnvState, torques: jax.Array, after: PipelineState) -> StepResult:
        """Compute the reward given in the class, and whether the ant is still up."""
        speed = (after.qpos[:2] - before.pipeline.qpos[:2]) @ before.direction
        return StepResult(10.0 * speed, ant_is_up(after.qpos), jnp.zeros((), bool), {"speed": speed})

    def mirror(self, batch: Transition) -> Transition:
        """Return the batch itself."""
        return batch


class AntDribbling:
    """Reward a ball that rolls along the direction, and an ant that stays with it.

    Reward per control step: forty times the ball's metres along the direction (up to 1.5 m/s), minus a quarter of that
    for metres sideways; closeness to the ball; being behind it; a constant that makes falling costly.
    The ball's friction stops it within 0.3 m of a kick (OGBench's: 0.5 against rolling, about 3 N of drag), so that it
    has to be pushed all the way. The episode is truncated when the ant is LOST m from the ball.
    """

    name = "ant_dribbler"
    observation_dim, action_dim = 35, 10
    discount, episode_steps, direction_steps, action_noise = 0.98, 300, 80, 0.0

    LOST = 5.0
    FASTEST = 0.15  # m per control step

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.ant_model(ball=True), threads=1)
        self.walker = policies.ant_walker()

    def reset(self, key: jax.Array) -> EnvState:
        """Draw a standing ant, turned at random, and a ball at rest, 0.7 to 3 m from it."""
        qpos_key, qvel_key, direction_key, place_key, gap_key, yaw_key = jax.random.split(key, 6)
        rest = jnp.asarray(self.engine.model.qpos0, jnp.float32)
        qpos = rest + jax.random.uniform(qpos_key, rest.shape, minval=-0.1, maxval=0.1)
        yaw = jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)
        turn = jnp.stack([jnp.cos(yaw / 2), 0.0, 0.0, jnp.sin(yaw / 2)])
        offset = jax.random.uniform(gap_key, (), minval=0.7, maxval=3.0) * random_direction(place_key)
        qpos = qpos.at[3:7].set(turn).at[ANT_NQ : ANT_NQ + 2].set(qpos[:2] + offset).at[ANT_NQ + 2].set(0.25)
        qvel = 0.1 * jax.random.normal(qvel_key, (self.engine.nv,))
        pipeline = self.engine.init(qpos, qvel.at[ANT_NV:].set(0.0))
        return EnvState(pipeline, random_direction(direction_key), jnp.zeros((), jnp.int32))

    def observe(self, state: EnvState) -> jax.Array:
        """Return the view of the ant and the ball, float[35]."""
        return policies.dribbler_view(state.pipeline.qpos, state.pipeline.qvel, state.direction)

    def torques(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Return the walker's action along a heading, plus corrections, float[8]."""
        return policies.dribbler_action(self.walker, state.pipeline.qpos, state.pipeline.qvel, state.direction, action)

    def evaluate_step(self, before: EnvState, torques: jax.Array, after: PipelineState) -> StepResult:
        """Compute the reward given in the class; truncate where the ball is out of reach."""
        ball = after.qpos[ANT_NQ : ANT_NQ + 2]
        way = to_direction_frame(ball - before.pipeline.qpos[ANT_NQ : ANT_NQ + 2], before.direction)
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
        return StepResult(reward, ant_is_up(after.qpos), gap > self.LOST, measures)

    def mirror(self, batch: Transition) -> Transition:
        """Return the batch itself."""
        return batch


def ant_is_up(qpos: jax.Array) -> jax.Array:
    """Return bool[...]: the torso's height is within [0.2, 1.0] m and its own z axis points up."""
    return (qpos[..., 2] > 0.2) & (qpos[..., 2] < 1.0) & (uprightness(qpos) > 0.0)
