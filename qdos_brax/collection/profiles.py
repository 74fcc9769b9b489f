"""How data is collected with each body: its expert, its start, when it has fallen for good, and its action noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp

from envs.mazes.maze_task import RESET_NOISE, MazeTask
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.poses import humanoid_is_up, standing_humanoid
from qdos_brax.errors import UserError

YAW_NOISE = 0.3
"""Standard deviation of the angle between a humanoid's first facing direction and its way, rad."""

MAZE_TURN = 1.0
"""Largest angle between a humanoid's facing direction and its command, rad: it has to turn within a corridor."""


@dataclass(frozen=True)
class CollectionProfile:
    """Describe how data is collected with a body.

    Attributes:
        expert: returns the shipped expert; a dribbler for a body with a ball.
        start: maps (task, direction[2] of the way ahead, key) to (qpos[nq], qvel[nv]), an episode's first state before
            the body is placed.
        has_fallen: maps qpos[nq] to a bool: the body lies and no expert gets it up, which ends the episode. None: the
            body never stays down.
        heavy_noise: standard deviation of the action noise of noisy episodes and of ``explore``.
        stitch_steps: control steps of an episode of ``stitch``.
    """

    expert: Callable[[], policies.Expert]
    start: Callable[[MazeTask, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
    has_fallen: Callable[[jax.Array], jax.Array] | None
    heavy_noise: float
    stitch_steps: int


def profile_of(env: MazeTask) -> CollectionProfile:
    """Return the profile of the task's body.

    Raises:
        UserError: no expert is shipped for it.
    """
    if env.spec.family not in PROFILES:
        raise UserError(
            f"no expert is shipped for {env.spec.family}, so no data can be collected; "
            f"train with --dataset FILE, such as OGBench's {env.spec.name}-navigate-v0.npz"
        )
    return PROFILES[env.spec.family]


def _task_start(env: MazeTask, ahead: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    start = env.reset(key).pipeline_state
    return start.qpos, start.qvel


def _standing_start(env: MazeTask, ahead: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return a standing state that faces its way, roughly: the task's own reset drops the body, which cannot get up."""
    pose_key, yaw_key, qvel_key = jax.random.split(key, 3)
    yaw = jnp.arctan2(ahead[1], ahead[0]) + YAW_NOISE * jax.random.normal(yaw_key)
    qpos, qvel = standing_humanoid(pose_key, yaw)
    return qpos, qvel + RESET_NOISE * jax.random.normal(qvel_key, qvel.shape)


ANT = CollectionProfile(policies.ant_walker, _task_start, has_fallen=None, heavy_noise=1.0, stitch_steps=200)

HUMANOID = CollectionProfile(
    partial(policies.humanoid_walker, max_turn=MAZE_TURN),
    _standing_start,
    has_fallen=lambda qpos: ~humanoid_is_up(qpos),
    heavy_noise=0.4,
    stitch_steps=400,
)

PROFILES = {"antmaze": ANT, "antsoccer": replace(ANT, expert=policies.ant_dribbler), "humanoidmaze": HUMANOID}
