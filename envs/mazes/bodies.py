"""Define the bodies of the mazes: which models they are stepped and drawn with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import mujoco

from envs.mazes import models
from envs.mazes.maze import Maze
from envs.mazes.walls import MazeRig, NearWalls
from envs.physics import Engine, MujocoEngine, Sensors


@dataclass(frozen=True)
class Body:
    """Describe what moves in a maze.

    Attributes:
        whole: makes the model with every wall of a maze, as OGBench has it: for drawing, and to compare with.
        near: makes the model on an open floor with the few walls in reach; True for movable (mocap) walls, which MJX
            wants, False for walls that belong to the world, which MuJoCo C wants.
        places: where in qpos the x of each free body lies, the walking one first.
        most_contacts: by contact dimension, how many MJX keeps; benchmarks/exactness.py counts what that drops.
        sensors: what is observed besides qpos and qvel.
        names: what the free bodies are called, as ``places`` has them.
        rest: height in m of the walking body's lowest point when it stands still; None where margins hardly matter.
    """

    whole: Callable[[Maze], mujoco.MjModel]
    near: Callable[[bool], mujoco.MjModel]
    most_contacts: Mapping[int, int]
    places: tuple[int, ...] = (0,)
    sensors: Sensors | None = None
    names: tuple[str, ...] = ("body",)
    rest: float | None = None

    def engine(self, physics: str, layout: Maze) -> Engine:
        """Return the engine called "mjx", "mjx-warp" or "mujoco" for this body in ``layout``."""
        if physics == "mujoco":
            model = self.near(False)
            return MujocoEngine(model, MazeRig(model, layout, self.places, self.sensors))
        # imported here, for MJX takes seconds to load
        from envs.physics.mjx.engine import MjxEngine
        from envs.physics.mjx.warp_engine import MjxWarpEngine

        engine = {engine.name: engine for engine in (MjxEngine, MjxWarpEngine)}[physics]
        return engine(self.near(True), NearWalls(layout, self.places), self.most_contacts, sensors=self.sensors)


# Measured with MuJoCo 4.0.0 (tests/envs/test_resting.py): the margins add up to 0.02, less what the feet sink in.
_ANT_REST = 0.0168

ANT = Body(models.ant_model, models.near_walls_ant, most_contacts={3: 8}, rest=_ANT_REST)

ANT_AND_BALL = Body(
    partial(models.ant_model, ball=True),
    partial(models.near_walls_ant, ball=True),
    most_contacts={3: 8, 6: 6},
    places=(0, 15),  # the ant's 15 numbers come first
    names=("body", "ball"),
    rest=_ANT_REST,
)

HUMANOID = Body(
    models.humanoid_model,
    models.near_walls_humanoid,
    most_contacts={1: 12, 3: 12},
    sensors=Sensors(
        root="torso",
        heights=("head",),
        limbs=("left_hand", "left_foot", "right_hand", "right_foot"),
        velocity="torso_subtreelinvel",
    ),
)
