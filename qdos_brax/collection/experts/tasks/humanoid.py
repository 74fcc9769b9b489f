"""Tasks of the humanoid's experts: walk along a direction, or get up."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.mazes import models
from envs.physics.base import PipelineState
from envs.physics.mujoco.engine import MujocoEngine
from qdos_brax.collection.experts import falls, policies, rising, symmetry
from qdos_brax.collection.experts.poses import humanoid_is_up, standing_humanoid
from qdos_brax.collection.experts.tasks.base import EnvState, StepResult
from qdos_brax.collection.experts.views import (
    direction_of,
    forward_axis,
    random_direction,
    to_direction_frame,
    uprightness,
)
from qdos_brax.data.transitions import Transition
from qdos_brax.nn.vectors import unit_vector


class _Humanoid:
    """Reward walking upright along the direction, 40 control steps per second.

    Reward per control step: mainly for speed along the direction, a parabola that is 0 at rest and 2 at PACE (faster,
    the body would run and fall); a quarter of that for being upright and facing the direction (with more, it learns to
    stand still); minus terms for sideways speed and for effort. A fall ends the episode.
    """

    observation_dim, action_dim = 55, 21
    discount, action_noise = 0.99, 0.2

    PACE = 1.2  # m/s

    def __init__(self) -> None:
        self.engine = MujocoEngine(models.humanoid_model(), threads=1)
        self._seconds = self.engine.frame_skip * self.engine.model.opt.timestep

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
        return StepResult(reward, self.is_up(after.qpos), jnp.zeros((), bool), measures)

    def is_up(self, qpos: jax.Array) -> jax.Array:
        """Return bool[...]: the body has not fallen."""
        return humanoid_is_up(qpos)

    def mirror(self, batch: Transition) -> Transition:
        """Exchange left and right: the body and the reward are symmetric."""
        return batch._replace(
            observation=symmetry.mirrored_view(batch.observation),
            action=symmetry.mirrored_action(batch.action),
            next_observation=symmetry.mirrored_view(batch.next_observation),
        )

    def _on_feet(self, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Draw (qpos[28], qvel[27], direction[2]) of a humanoid on its feet, the direction mostly ahead of it."""
        pose_key, qvel_key, yaw_key, direction_key = jax.random.split(key, 4)
        yaw = jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)
        qpos, qvel = standing_humanoid(pose_key, yaw)
        qvel = qvel + 0.1 * jax.random.normal(qvel_key, qvel.shape)
        return qpos, qvel, direction_of(yaw + 0.6 * jax.random.normal(direction_key))

    def _begin(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> EnvState:
        return EnvState(self.engine.init(qpos, qvel), direction, jnp.zeros((), jnp.int32))


class HumanoidWalking(_Humanoid):
    """Reward walking as a maze asks for it, with turns, and from wherever a body has risen.

    RISEN_SHARE of the episodes begin where ``experts.rising`` hands over, with any direction; the others on the feet,
    the direction close to where the body faces. Later directions are drawn often, and of any kind. The body sees them
    as it will be led, at most ``policies.MAX_TURN`` aside, and is rewarded for the whole turn.
    """

    name = "humanoid_walker"
    episode_steps, direction_steps = 400, 100

    RISEN_SHARE = 0.4
    RISEN = 512  # bodies, drawn once

    def __init__(self) -> None:
        super().__init__()
        drop_key, key = jax.random.split(jax.random.key(0))
        state = falls.dropped(self.engine, drop_key, self.RISEN)
        self._risen = falls.hand_overs(self.engine, rising.humanoid_rising(), state, key).some()

    def observe(self, state: EnvState) -> jax.Array:
        """Return the body's view of the direction in which it will be led, float[55]."""
        heading = policies.humanoid_heading(state.pipeline.qpos, state.direction, policies.MAX_TURN)
        return super().observe(state.replace(direction=heading))

    def reset(self, key: jax.Array) -> EnvState:
        """Draw a humanoid on its feet, or one that has just risen, and a direction."""
        kind_key, stand_key, index_key, direction_key = jax.random.split(key, 4)
        risen = (*_drawn(index_key, self._risen), random_direction(direction_key))
        has_risen = jax.random.bernoulli(kind_key, self.RISEN_SHARE)
        start = (jnp.where(has_risen, a, b) for a, b in zip(risen, self._on_feet(stand_key), strict=True))
        return self._begin(*start)


class HumanoidRising(_Humanoid):
    """Reward walking likewise, from the crouches in which the motions of ``experts.rising`` leave a body that fell.

    The body is to walk where it faces. STANDING_SHARE of the episodes begin on their feet. An episode ends where the
    body sits or lies.
    """

    name = "humanoid_riser"
    episode_steps, direction_steps = 120, 10**9

    STANDING_SHARE = 0.15
    CROUCHES = 256  # drawn once; half of them shaken, with up to ``action_noise``
    LOWEST = 0.45  # height of the torso of a body that still crouches, m

    def __init__(self) -> None:
        super().__init__()
        drop_key, noise_key = jax.random.split(jax.random.key(0))
        state = falls.dropped(self.engine, drop_key, self.CROUCHES)
        noise = jnp.maximum(jnp.linspace(-self.action_noise, self.action_noise, self.CROUCHES), 0.0)[:, None]
        motions = rising.humanoid_motions()
        self._crouches = falls.arrivals(self.engine, rising.RISES, motions, state, noise, noise_key).some()

    def reset(self, key: jax.Array) -> EnvState:
        """Draw a crouching or a standing body, and its facing direction."""
        kind_key, crouch_key, stand_key = jax.random.split(key, 3)
        stands = jax.random.bernoulli(kind_key, self.STANDING_SHARE)
        standing, crouching = self._on_feet(stand_key)[:2], _drawn(crouch_key, self._crouches)
        qpos, qvel = (jnp.where(stands, a, b) for a, b in zip(standing, crouching, strict=True))
        return self._begin(qpos, qvel, unit_vector(forward_axis(qpos)[:2]))

    def is_up(self, qpos: jax.Array) -> jax.Array:
        """Return bool[...]: the body crouches or stands."""
        return (qpos[..., 2] > self.LOWEST) & (uprightness(qpos) > 0.3)


def _drawn(key: jax.Array, arrivals: falls.Arrivals) -> tuple[jax.Array, jax.Array]:
    """Draw (qpos[28], qvel[27]) of one of the bodies that arrived."""
    index = jax.random.categorical(key, jnp.where(arrivals.arrived, 0.0, -jnp.inf))
    return arrivals.qpos[index], arrivals.qvel[index]
