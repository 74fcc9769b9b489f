"""How each body is collected with: who moves it, how it starts, when it is down for good, what noise spoils it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp

from envs.mazes.maze_task import RESET_NOISE, MazeTask
from envs.task import Task
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.poses import humanoid_is_up, standing_humanoid
from qdos_brax.errors import UserError

YAW_NOISE = 0.3
"""Standard deviation of the angle between where a humanoid faces at first and where it has to go, rad."""

SHARPEST = 1.0
"""How far from where a humanoid faces it is commanded at most, rad: in a maze it has to turn within a corridor."""


@dataclass(frozen=True)
class Conduct:
    """What a collection has to know of a body.

    Attributes:
        expert: gives the shipped policy; of a body with a ball a dribbler.
        start: (task, direction[2] of the way ahead, key) to (qpos[nq], qvel[nv]), from which an episode begins
            elsewhere.
        is_down: bool of qpos[nq], it lies and no expert gets it up, which ends the episode; None: it never stays down.
        heavy_noise: standard deviation of the action noise of noisy episodes, and of ``explore``: spoils what the
            expert does.
        stitch_steps: control steps of an episode of ``stitch``.
    """

    expert: Callable[[], policies.Policy]
    start: Callable[[MazeTask, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
    is_down: Callable[[jax.Array], jax.Array] | None
    heavy_noise: float
    stitch_steps: int


def conduct_of(env: Task) -> Conduct:
    """That of the task's body.

    Raises:
        UserError: no expert is shipped for it.
    """
    if env.spec.family not in CONDUCTS:
        raise UserError(
            f"no expert is shipped for {env.spec.family}, so no data can be collected; "
            f"train with --dataset FILE, such as OGBench's {env.spec.name}-navigate-v0.npz"
        )
    return CONDUCTS[env.spec.family]


def _as_the_task(env: MazeTask, ahead: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    start = env.reset(key).pipeline_state
    return start.qpos, start.qvel


def _on_its_feet(env: MazeTask, ahead: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Facing its way, about. The task drops it, and its walker cannot get up."""
    pose_key, yaw_key, qvel_key = jax.random.split(key, 3)
    yaw = jnp.arctan2(ahead[1], ahead[0]) + YAW_NOISE * jax.random.normal(yaw_key)
    qpos, qvel = standing_humanoid(pose_key, yaw)
    return qpos, qvel + RESET_NOISE * jax.random.normal(qvel_key, qvel.shape)


ANT = Conduct(policies.ant_walker, _as_the_task, is_down=None, heavy_noise=1.0, stitch_steps=200)

HUMANOID = Conduct(
    partial(policies.humanoid_walker, sharpest=SHARPEST),
    _on_its_feet,
    is_down=lambda qpos: ~humanoid_is_up(qpos),
    heavy_noise=0.4,
    stitch_steps=400,
)

CONDUCTS = {"antmaze": ANT, "antsoccer": replace(ANT, expert=policies.ant_dribbler), "humanoidmaze": HUMANOID}
