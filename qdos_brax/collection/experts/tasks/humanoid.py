"""Tasks of the humanoid's experts: walk along a direction, or get up."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.mazes import models
from envs.mazes.locomotion import dropped_humanoid, dropped_poses
from envs.physics.base import PipelineState
from envs.physics.mujoco.engine import MujocoEngine
from qdos_brax.collection.experts import policies, symmetry
from qdos_brax.collection.experts.poses import STANDING, humanoid_is_up, standing_humanoid
from qdos_brax.collection.experts.tasks.base import EnvState, StepResult
from qdos_brax.collection.experts.views import (
    direction_of,
    forward_axis,
    random_direction,
    to_direction_frame,
    uprightness,
)
from qdos_brax.data.transitions import Transition


class HumanoidWalking:
    """Reward walking upright along the direction, 40 control steps per second.

    Reward per control step: mainly for speed along the direction, a parabola that is 0 at rest and 2 at PACE (faster,
    the body would run and fall); a quarter of that for being upright and facing the direction (with more, it learns to
    stand still); minus terms for sideways speed and for effort. A fall ends the episode. The first direction is close
    to where the body faces; later ones are drawn now and then. Episodes are short because most falls happen at the
    start.
    """

    name = "humanoid_walker"
    observation_dim, action_dim = 55, 21
    discount, episode_steps, direction_steps, action_noise = 0.99, 300, 400, 0.2

    PACE = 1.2  # m/s

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.humanoid_model(), threads=1)
        self._seconds = self.engine.frame_skip * self.engine.model.opt.timestep

    def reset(self, key: jax.Array) -> EnvState:
        """Draw a humanoid on its feet, the direction mostly ahead of it."""
        pose_key, qvel_key, yaw_key, direction_key = jax.random.split(key, 4)
        yaw = jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)
        qpos, qvel = standing_humanoid(pose_key, yaw)
        qvel = qvel + 0.1 * jax.random.normal(qvel_key, qvel.shape)
        direction = direction_of(yaw + 0.6 * jax.random.normal(direction_key))
        return EnvState(self.engine.init(qpos, qvel), direction, jnp.zeros((), jnp.int32))

    def observe(self, state: EnvState) -> jax.Array:
        """Return the body's view, float[55]."""
        return policies.humanoid_view(state.pipeline.qpos, state.pipeline.qvel, state.direction)

    def torques(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Return float[21] that pull the joints to the targets in ``action``."""
        return policies.humanoid_torques(state.pipeline.qpos, action)

    def evaluate_step(self, before: EnvState, torques: jax.Array, after: PipelineState) -> StepResult:
        """Compute the reward given in the class, and whether the body is still up."""
        velocity = to_direction_frame(after.qpos[:2] - before.pipeline.qpos[:2], before.direction) / self._seconds
        facing = forward_axis(after.qpos)[:2] @ before.direction
        reward = (
            2.0 * jnp.maximum(1.0 - (velocity[0] / self.PACE - 1.0) ** 2, -1.0)
            + 0.3 * uprightness(after.qpos)
            + 0.2 * facing
            - 0.2 * jnp.minimum(jnp.abs(velocity[1]), self.PACE)
            - 0.1 * jnp.mean(torques**2)
        )
        measures = {"speed": velocity[0], "facing": facing}
        return StepResult(reward, humanoid_is_up(after.qpos), jnp.zeros((), bool), measures)

    def mirror(self, batch: Transition) -> Transition:
        """Exchange left and right: the body and the reward are symmetric."""
        return _mirrored(batch)


class HumanoidRising:
    """Reward getting up from wherever the body fell, and standing.

    Reward per control step: the torso's height as a share of the standing height, and half as much again for being
    upright there; 1 while it is up, reduced by how fast it moves; minus a term for effort. An episode begins as in
    OGBench's resets, dropped in a random pose, or (a share STANDING_SHARE of them) on its feet with a push; it never
    ends early, so that lying costs reward.
    """

    name = "humanoid_riser"
    observation_dim, action_dim = 55, 21
    discount, episode_steps, direction_steps, action_noise = 0.99, 300, 10**9, 0.0

    STANDING_SHARE = 0.25
    PUSH = 0.5  # standard deviation of the velocities of a standing start, m/s and rad/s

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.humanoid_model(), threads=1)
        self._poses = dropped_poses()

    def reset(self, key: jax.Array) -> EnvState:
        """Draw a dropped or a standing body, as described in the class; the direction does not matter."""
        kind_key, drop_key, pose_key, qvel_key, direction_key = jax.random.split(key, 5)
        stands = jax.random.bernoulli(kind_key, self.STANDING_SHARE)
        dropped = jnp.concatenate([jnp.zeros(2), dropped_humanoid(drop_key, self._poses)])
        direction = random_direction(direction_key)
        standing, _ = standing_humanoid(pose_key, jnp.arctan2(direction[1], direction[0]))
        qvel = jnp.where(stands, self.PUSH, 0.1) * jax.random.normal(qvel_key, (self.engine.nv,))
        pipeline = self.engine.init(jnp.where(stands, standing, dropped), qvel)
        return EnvState(pipeline, direction, jnp.zeros((), jnp.int32))

    def observe(self, state: EnvState) -> jax.Array:
        """Return the body's view, float[55]."""
        return policies.humanoid_view(state.pipeline.qpos, state.pipeline.qvel, state.direction)

    def torques(self, state: EnvState, action: jax.Array) -> jax.Array:
        """Return float[21] that pull the joints to the targets in ``action``, scaled to the range of crouching."""
        return policies.rising_torques(state.pipeline.qpos, action)

    def evaluate_step(self, before: EnvState, torques: jax.Array, after: PipelineState) -> StepResult:
        """Compute the reward given in the class; never end the episode."""
        height = jnp.clip(after.qpos[2] / STANDING, 0.0, 1.0)
        is_up = humanoid_is_up(after.qpos)
        calm = jnp.exp(-jnp.sum(after.qvel[:2] ** 2))
        effort = jnp.mean(torques**2)
        reward = height + 0.5 * height * jnp.maximum(uprightness(after.qpos), 0.0) + is_up * calm - 0.1 * effort
        ends = jnp.zeros((), bool)
        return StepResult(reward, ~ends, ends, {"height": after.qpos[2], "up": is_up.astype(jnp.float32)})

    def mirror(self, batch: Transition) -> Transition:
        """Exchange left and right: the body and the reward are symmetric."""
        return _mirrored(batch)


def _mirrored(batch: Transition) -> Transition:
    return batch._replace(
        observation=symmetry.mirrored_view(batch.observation),
        action=symmetry.mirrored_action(batch.action),
        next_observation=symmetry.mirrored_view(batch.next_observation),
    )
