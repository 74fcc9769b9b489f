"""Define the mazes in which the body itself has to reach the goal."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.body_frame import BodyFrame
from envs.families import TaskSpec
from envs.mazes.bodies import ANT, HUMANOID, Body
from envs.mazes.families import cells_of
from envs.mazes.maze import UNIT, WALL_HALF_SIZE, get_maze
from envs.mazes.maze_task import RESET_NOISE, MazeTask
from envs.mazes.models import humanoid_model
from envs.mazes.resting import lowest_points
from envs.physics import PipelineState
from envs.scene import Scene, following_view, top_view
from envs.task import Resting

DROP_HEIGHT = 1.5  # m

START_POSES = 4096
"""How many joint configurations the humanoid's resets are drawn from."""


_FIRST_BODY = 1  # the first body after the world: the one that walks


class BodyTask(MazeTask):
    """Simulate a task of one of ``envs.mazes.bodies``; subclasses say which.

    Args:
        spec: which task.
        physics: "mjx", "mjx-warp" or "mujoco".
    """

    body: Body

    def __init__(self, spec: TaskSpec, physics: str) -> None:
        layout = get_maze(spec.variant)
        engine = self.body.engine(physics, layout)
        tracked = dict(zip(self.body.names, self.body.places, strict=True))
        *starts, goal = cells_of(spec)
        super().__init__(spec, layout, engine, engine.model.qpos0, tracked, starts, goal)

    def whole_model(self) -> mujoco.MjModel:
        """Return a fresh model with all walls and the target, as OGBench has it; the engines' have near walls only."""
        return self.body.whole(self.layout)

    def scene(self) -> Scene:
        """Return the whole maze, from above or from near the body."""
        rows, columns = self.layout.grid.shape
        centre = self.layout.ij_to_xy(((rows - 1) / 2, (columns - 1) / 2))
        top = top_view(centre, (columns * UNIT / 2, rows * UNIT / 2), 2 * WALL_HALF_SIZE[2])
        cameras = {"top": top, "follow": following_view(_FIRST_BODY)}
        return Scene(self.whole_model(), cameras, columns / rows, goal_marker="target")

    def resting(self, qpos: np.ndarray) -> Resting | None:
        """Return the heights of the body's lowest point, and at rest; before MuJoCo 3.5 that was one margin less."""
        if self.body.rest is None:
            return None
        model = self.whole_model()
        heights = lowest_points(model, qpos, _FIRST_BODY)
        return Resting(heights, self.body.rest, self.body.rest - float(model.geom("floor").margin[0]))


class AntMaze(BodyTask):
    """Simulate an ant in a maze: qpos 15, qvel 14, action 8, observation 29, 10 control steps per second."""

    body = ANT
    body_frame = BodyFrame(heading=3, vectors=(15,))


class HumanoidMaze(BodyTask):
    """Simulate a humanoid in a maze: qpos 28, qvel 27, action 21, observation 69, 40 control steps per second.

    The observation is xy, joint angles, and what ``envs.mazes.bodies.HUMANOID`` senses (head height, hands and feet
    seen from the torso, the vertical as the torso sees it, velocity of the centre of mass), then qvel.

    A reset drops it 1.5 high, turned at random, with random joint angles that let no two parts touch. OGBench draws
    angles until that is so; here the angles are one of 4,096 such draws, made once and the same for every engine.
    """

    body = HUMANOID
    # Its heading is not observed; while it walks, it faces where its centre of mass and its root move.
    # Whether it is up is told by its head's height.
    body_frame = BodyFrame(course=39, vectors=(39, 42), levels=(23,))

    def __init__(self, spec: TaskSpec, physics: str) -> None:
        super().__init__(spec, physics)
        self._start_poses = dropped_poses()

    def observe(self, pipeline_state: PipelineState) -> jax.Array:
        """Return float32[69], see above."""
        qpos = pipeline_state.qpos
        return jnp.concatenate([qpos[:2], qpos[7:], pipeline_state.sensed, pipeline_state.qvel])

    def _start_pose(self, qpos_key: jax.Array, qvel_key: jax.Array) -> tuple[jax.Array, jax.Array]:
        qpos = jnp.concatenate([jnp.asarray(self._init_qpos[:2]), dropped_humanoid(qpos_key, self._start_poses)])
        return qpos, RESET_NOISE * jax.random.normal(qvel_key, (self.engine.nv,))


def dropped_humanoid(key: jax.Array, poses: np.ndarray) -> jax.Array:
    """Return height, quaternion and joint angles[26] of a humanoid let fall, its angles drawn from ``poses[n, 21]``."""
    turn_key, angles_key = jax.random.split(key)
    quat = jax.random.uniform(turn_key, (4,))  # OGBench's: no component is ever negative
    angles = jax.random.choice(angles_key, jnp.asarray(poses))
    return jnp.concatenate([jnp.array([DROP_HEIGHT]), quat / jnp.linalg.norm(quat), angles])


@cache
def dropped_poses() -> np.ndarray:
    """Return float32[START_POSES, 21]: joint angles, uniform in their ranges, in which no two parts touch.

    At a height of 1.5 it touches nothing else, whichever way it is turned.
    """
    model = humanoid_model()
    data = mujoco.MjData(model)
    low, high = model.jnt_range[1:].T  # without the root
    rng = np.random.default_rng(0)
    poses: list[np.ndarray] = []
    while len(poses) < START_POSES:
        angles = rng.uniform(low, high).astype(np.float32)
        data.qpos[7:] = angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon == 0:
            poses.append(angles)
    return np.stack(poses)
