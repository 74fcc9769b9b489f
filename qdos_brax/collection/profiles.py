"""How data is collected with each body: its expert, what gets it up, and its action noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from envs.mazes.maze_task import MazeTask
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.rising import NoRecovery, Recovery, humanoid_rising
from qdos_brax.errors import UserError

MAZE_TURN = 1.5
"""Largest angle between a humanoid's facing direction and its command, rad.

It gets up facing anywhere and has to turn within a corridor: with 1.0 it falls twice as often, at walls.
"""


@dataclass(frozen=True)
class CollectionProfile:
    """Describe how data is collected with a body.

    Attributes:
        expert: returns the shipped expert; a dribbler for a body with a ball.
        recovery: returns what gets the body up after a fall.
        heavy_noise: standard deviation of the action noise of noisy episodes and of ``explore``.
        stitch_steps: control steps of an episode of ``stitch``.
    """

    expert: Callable[[], policies.Expert]
    recovery: Callable[[], Recovery]
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


ANT = CollectionProfile(policies.ant_walker, NoRecovery, heavy_noise=1.0, stitch_steps=200)

HUMANOID = CollectionProfile(
    partial(policies.humanoid_walker, max_turn=MAZE_TURN),
    humanoid_rising,
    heavy_noise=0.4,
    stitch_steps=400,
)

PROFILES = {"antmaze": ANT, "antsoccer": replace(ANT, expert=policies.ant_dribbler), "humanoidmaze": HUMANOID}
