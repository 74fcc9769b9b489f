"""Define ant soccer: the ant has to bring the ball to the goal."""

from __future__ import annotations

from typing import Any

import jax

from envs.body_frame import BodyFrame
from envs.brax_base import State
from envs.mazes.bodies import ANT_AND_BALL
from envs.mazes.locomotion import BodyTask

BALL_QPOS = ANT_AND_BALL.places[1]


class AntSoccer(BodyTask):
    """Simulate an ant and a ball: qpos 22, qvel 20, action 8, observation 42, 10 control steps per second."""

    body = ANT_AND_BALL
    body_frame = BodyFrame(heading=3, points=(15,), quaternions=(18,), vectors=(22, 36))

    def reset(self, rng: jax.Array, start_ij: Any = None, goal_ij: Any = None, ball_ij: Any = None) -> State:
        """Return a start, as ``MazeTask.reset``; ``ball_ij`` is the cell where the ball starts, None the task's."""
        return self._reset(rng, (start_ij, ball_ij), goal_ij)
