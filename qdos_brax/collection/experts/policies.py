"""Trained experts: policies from (qpos, qvel, commanded direction) to an action.

``ant_walker`` and ``humanoid_walker`` walk along the direction, ``ant_dribbler`` takes the ball along it.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax.collection.experts.symmetry import HUMANOID_ACTUATED
from qdos_brax.collection.experts.views import (
    ANT_NQ,
    ANT_NV,
    ball_view,
    body_view,
    direction_of,
    forward_axis,
    to_direction_frame,
    to_world_frame,
)
from qdos_brax.collection.experts.weights import Actor, read_actor, shipped
from qdos_brax.nn.vectors import unit_vector

_CORRECTION = 1.0  # share of a joint's range that the dribbler can add to the walker's action

# Where a dribbler heads before it has learned anything: round the ball, then through it; lengths in m.
_CIRCLE = 1.3  # radius of the circle on which it goes round the ball
_PULL = 1.1  # turn towards the circle per m of distance from it
_LANE = 0.5  # half width of the lane behind the ball in which it pushes
_FUNNEL = 0.75  # the lane widens by this much per m behind the ball
_STEER = 2.0  # turn of the push per m of lateral offset
_OVERRIDE = 1.5  # weight of the learned heading, enough to turn to any direction

# The humanoid's angular velocities reach 10 rad/s and more.
_SPIN_SCALE = 0.25  # of the root
_SWING_SCALE = 0.1  # of the joints

MAX_TURN = 1.2
"""Largest angle between where a humanoid faces and its command, rad; sharper turns make it fall more often."""


class Expert(Protocol):
    """Act on a state and a direction.

    Attributes:
        params: the arrays that distinguish one expert from another.
    """

    params: Any

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """Return the deterministic action[..., nu] in [-1, 1].

        Args:
            qpos: [..., nq].
            qvel: [..., nv].
            direction: [..., 2], a unit vector.
        """
        ...


@runtime_checkable
class DribblingExpert(Expert, Protocol):
    """Take a ball along the direction.

    Attributes:
        walker: the expert that moves the body alone.
    """

    walker: Expert


class AntWalker:
    """Walk the ant along the direction; qpos and qvel may hold more numbers after the ant's own.

    Args:
        actor: the trained network.
    """

    def __init__(self, actor: Actor) -> None:
        self.actor, self.params = actor, actor.params

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """Return action[..., 8], see ``Expert.act``."""
        return self.actor.mode(body_view(qpos[..., :ANT_NQ], qvel[..., :ANT_NV], direction))


class HumanoidWalker:
    """Walk the humanoid along the direction.

    Args:
        actor: the trained network.
        max_turn: see ``humanoid_heading``.
    """

    def __init__(self, actor: Actor, max_turn: float = MAX_TURN) -> None:
        self.actor, self.params, self.max_turn = actor, actor.params, max_turn

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """Return action[..., 21], see ``Expert.act``."""
        view = humanoid_view(qpos, qvel, humanoid_heading(qpos, direction, self.max_turn))
        return humanoid_torques(qpos, self.actor.mode(view))


def humanoid_heading(qpos: jax.Array, direction: jax.Array, max_turn: float) -> jax.Array:
    """Return the unit vector[..., 2] closest to ``direction[..., 2]`` within ``max_turn`` rad of where it faces.

    The humanoid thus turns in a curve; it falls when it has to change its course at once. The walker is trained to see
    such directions alone, and rewarded for the whole turn (for the limited one, it would walk at that angle for ever).
    """
    facing = unit_vector(forward_axis(qpos)[..., :2])
    seen = to_direction_frame(direction, facing)
    angle = jnp.clip(jnp.arctan2(seen[..., 1], seen[..., 0]), -max_turn, max_turn)
    return to_world_frame(direction_of(angle), facing)


def humanoid_view(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """Return [..., 55], the body's view with its velocities scaled to about 1."""
    view = body_view(qpos, qvel, direction)
    still, spin, swing = jnp.split(view, [31, 34], axis=-1)
    return jnp.concatenate([still, spin * _SPIN_SCALE, swing * _SWING_SCALE], axis=-1)


def humanoid_torques(qpos: jax.Array, joint_targets: jax.Array) -> jax.Array:
    """Return torques[..., 21], as shares of the largest ones, that pull each joint to ``joint_targets[..., 21]`` (rad).

    The torque is full at an error of 1 rad. With targets of zero the body stands for a while; with zero torque it
    falls at once.
    """
    angles = qpos[..., 7:][..., HUMANOID_ACTUATED]
    return jnp.clip(joint_targets - angles, -1.0, 1.0)


def dribbler_view(qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
    """Return a dribbler's observation[..., 35]: the ant and the ball."""
    body = body_view(qpos[..., :ANT_NQ], qvel[..., :ANT_NV], direction)
    return jnp.concatenate([body, ball_view(qpos, qvel, direction)], axis=-1)


def dribbler_action(
    walker: Expert, qpos: jax.Array, qvel: jax.Array, direction: jax.Array, command: jax.Array
) -> jax.Array:
    """Return the ant's action[..., 8] for a dribbler's command: the walker's along a heading, plus corrections.

    Args:
        walker: walks the ant.
        qpos: [..., 22].
        qvel: [..., 20].
        direction: [..., 2].
        command: [..., 10]; the first two are added to the heading of ``push_heading``, the others are corrections.
    """
    offset = ball_view(qpos, qvel, direction)[..., :2]
    heading = unit_vector(push_heading(offset) + _OVERRIDE * command[..., :2])
    steps = walker.act(qpos, qvel, to_world_frame(heading, direction))
    return jnp.clip(steps + _CORRECTION * command[..., 2:], -1.0, 1.0)


def push_heading(offset: jax.Array) -> jax.Array:
    """Return the unit vector[..., 2] round a ball at ``offset[..., 2]`` to behind it, then through it along +x."""
    ahead, beside = offset[..., :1], offset[..., 1:]
    push = unit_vector(jnp.concatenate([jnp.ones_like(ahead), _STEER * beside], axis=-1))
    outward = -unit_vector(offset)
    side = jnp.where(beside <= 0, 1.0, -1.0)
    round_it = side * jnp.concatenate([-outward[..., 1:], outward[..., :1]], axis=-1)
    gap = jnp.linalg.norm(offset, axis=-1, keepdims=True)
    around = unit_vector(round_it + _PULL * (_CIRCLE - gap) * outward)
    return jnp.where((ahead > 0) & (jnp.abs(beside) < _LANE + _FUNNEL * ahead), push, around)


class Dribbler:
    """Take the ball along the direction: steer the walker and correct its steps.

    Args:
        actor: the trained network.
        walker: the walker it was trained with.
    """

    def __init__(self, actor: Actor, walker: Expert) -> None:
        self.actor, self.walker = actor, walker
        self.params = (actor.params, walker.params)

    def act(self, qpos: jax.Array, qvel: jax.Array, direction: jax.Array) -> jax.Array:
        """Return action[..., 8], see ``Expert.act``."""
        command = self.actor.mode(dribbler_view(qpos, qvel, direction))
        return dribbler_action(self.walker, qpos, qvel, direction, command)


def walker_of(expert: Expert) -> Expert:
    """Return the expert that moves the body alone: a dribbler's walker, or the expert itself."""
    return expert.walker if isinstance(expert, DribblingExpert) else expert


def ant_walker(path: Path | None = None) -> AntWalker:
    """Load the walking ant, shipped or from ``path``; errors as ``read_actor``."""
    return AntWalker(read_actor(path or shipped("ant_walker")))


def humanoid_walker(path: Path | None = None, max_turn: float = MAX_TURN) -> HumanoidWalker:
    """Load the walking humanoid, shipped or from ``path``; errors as ``read_actor``."""
    return HumanoidWalker(read_actor(path or shipped("humanoid_walker")), max_turn)


def ant_dribbler(path: Path | None = None) -> Dribbler:
    """Load the dribbling ant, shipped or from ``path``; errors as ``read_actor``."""
    return Dribbler(read_actor(path or shipped("ant_dribbler")), ant_walker())


class Trained(Protocol):
    """Define what was trained.

    Attributes:
        params: the arrays that distinguish one from another.
    """

    params: Any


def digest(*trained: Trained) -> str:
    """Return eight hex digits that identify the weights of an expert, and of what goes with it."""
    sha = hashlib.sha256()
    for leaf in jax.tree.leaves([part.params for part in trained]):
        sha.update(np.asarray(leaf).tobytes())
    return sha.hexdigest()[:8]
