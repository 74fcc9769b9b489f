"""What one environment carries while data is collected, and the row that each of its control steps yields."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
from flax import struct

from envs.physics.base import PipelineState


class Row(NamedTuple):
    """Hold one control step, or many of them along leading axes; JAX arrays on the device, NumPy arrays on the host.

    Attributes:
        qpos, qvel, observation, action: before the step.
        next_observation: after the step.
    """

    qpos: Any
    qvel: Any
    observation: Any
    action: Any
    next_observation: Any


class Draws(NamedTuple):
    """Hold the random numbers of one environment for one step, whether the step needs them or not.

    They are drawn for many steps at once: drawing between two engine calls would add dozens of tiny operations.

    Attributes:
        goal_xy, escape_xy: float32[2], centres of free cells.
        turn: float32, uniform in [0, 1).
        heading: float32[2], a unit vector.
        noise: float32[nu], standard normal.
        teleport: key for the teleporters.
    """

    goal_xy: jax.Array
    escape_xy: jax.Array
    turn: jax.Array
    heading: jax.Array
    noise: jax.Array
    teleport: jax.Array


class RolloutState(struct.PyTreeNode):
    """Hold the state of one environment while it collects.

    The target object is what has to reach the goal: the body itself, or the ball.

    Attributes:
        pipeline: the simulator's state.
        observation: float32[obs], the task's observation.
        memory: int32[m], what the recovery remembers.
        has_ball: bool, whether the target object is the ball.
        goal_xy, origin_xy: float32[2], the target object's goal, and its position when that goal was drawn.
        returning: bool, a failing attempt is on its way back to the origin.
        attempt_steps: int32, steps since the goal was drawn or the attempt turned round.
        heading: float32[2], direction of a wandering body.
        escape_xy: float32[2], where a body that was stuck walks.
        escape_steps: int32, for how many more steps it walks there.
        arrivals: int32, goals reached by the target object, over all episodes of this environment.
        episode_steps: int32, steps in this episode.
        checked_body, checked_object: float32[2], positions at the last stuck check.
    """

    pipeline: PipelineState
    observation: jax.Array
    memory: jax.Array
    has_ball: jax.Array
    goal_xy: jax.Array
    origin_xy: jax.Array
    returning: jax.Array
    attempt_steps: jax.Array
    heading: jax.Array
    escape_xy: jax.Array
    escape_steps: jax.Array
    arrivals: jax.Array
    episode_steps: jax.Array
    checked_body: jax.Array
    checked_object: jax.Array
