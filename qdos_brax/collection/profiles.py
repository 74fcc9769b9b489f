"""How data is collected with each body: its expert, what gets it up, and its action noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from envs.mazes.maze_task import MazeTask
from qdos_brax.collection.experts import policies
from qdos_brax.collection.experts.rising import NoRecovery, Recovery, humanoid_rising
from qdos_brax.collection.experts.steering import CellSteering, Navigator, Steering
from qdos_brax.collection.experts.turning import CurvedSteering
from qdos_brax.errors import UserError


@dataclass(frozen=True)
class CollectionProfile:
    """Describe how data is collected with a body.

    Attributes:
        expert: returns the shipped expert; a dribbler for a body with a ball.
        recovery: returns what gets the body up after a fall.
        steering: makes what leads it through a maze.
        heavy_noise: standard deviation of the action noise of noisy episodes and of ``explore``.
        stitch_steps: control steps of an episode of ``stitch``.
        version: of the rows, raised when the same arguments give others; part of the default sets' names.
    """

    expert: Callable[[], policies.Expert]
    recovery: Callable[[], Recovery]
    steering: Callable[[Navigator], Steering]
    heavy_noise: float
    stitch_steps: int
    version: int = 5


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


ANT = CollectionProfile(policies.ant_walker, NoRecovery, CellSteering, heavy_noise=1.0, stitch_steps=200)

HUMANOID = CollectionProfile(
    policies.humanoid_walker,
    humanoid_rising,
    CurvedSteering,
    heavy_noise=0.4,
    stitch_steps=400,
    version=6,
)

PROFILES = {"antmaze": ANT, "antsoccer": replace(ANT, expert=policies.ant_dribbler), "humanoidmaze": HUMANOID}
