"""A scripted demonstrator of the reacher: joint by joint to a pose that presses the switch on its way."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

import envs
from qdos_brax.collection.scripted.demonstrator import SimStates
from qdos_brax.data.quality import QUALITY
from tests.reacher import GOALS, MOVE

TURN = 10  # steps after which a failing episode goes back
GAIN = 0.4


class ReacherDemonstrator:
    """Go to the goal (``navigate``, ``noisy``), at random (``wander``), or to the goal and back (``fail``).

    A failing episode counts as ``navigate`` until it turns.
    """

    version: ClassVar[int] = 3
    heavy_noise: ClassVar[float] = 0.8

    def __init__(self, env: envs.Task, n: int, noise: float) -> None:
        assert env.spec.family == "reacher"
        x, y = GOALS[env.spec.task_id - 1]
        elbow = -np.arccos((x * x + y * y - 0.5) / 0.5)  # which leaves the shoulder beyond the switch
        self.pose = np.array([np.arctan2(y, x) - elbow / 2, elbow])
        self.n, self.noise = n, noise

    def begin(self, kinds: np.ndarray, rng: np.random.Generator) -> SimStates:
        self.steps, self.kinds = 0, kinds
        n = len(kinds)
        assert n == self.n
        starts = rng.uniform(-0.2, 0.2, (n, 2))
        return SimStates(starts, np.zeros((n, 2)), np.zeros((n, 1), np.int32), np.zeros((n, 0), np.float32))

    def act(self, states: SimStates, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        fails = self.kinds == QUALITY["fail"]
        returns = fails & (self.steps >= TURN)
        wanted = np.where(returns[:, None], 0.0, self.pose)
        wanders = self.kinds == QUALITY["wander"]
        action = np.where(wanders[:, None], rng.uniform(-1, 1, (self.n, 2)), GAIN * (wanted - states.qpos) / MOVE)
        sigma = np.where(self.kinds == QUALITY["noisy"], self.heavy_noise, self.noise)
        action = np.clip(action + sigma[:, None] * rng.standard_normal((self.n, 2)), -1, 1)
        self.steps += 1
        return action.astype(np.float32), np.where(fails & ~returns, QUALITY["navigate"], self.kinds).astype(np.int8)
