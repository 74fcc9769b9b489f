"""Say what skills did, as training never sees it: a part of ``benchmarks/skills.py``."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from scipy.spatial import KDTree

from envs.brax_base import State
from envs.manipulation.kitchen_rig import JOINTS
from envs.manipulation.manipspace_rig import ROBOT_JOINTS
from envs.mazes.maze import UNIT
from envs.render import steps_per_second
from qdos_brax.analysis.finished import TrainedRun
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import to_device
from qdos_brax.skills.graph_phase import graph_costs
from qdos_brax.skills.slow_features import fit_slow_features

WALL = 1.3  # m between the body and the nearest wall's face, at most, of a state at a wall
AWAY = 1.5  # m
WAY_SECONDS = 2.0  # short skills have as long as a long one
MOVED = 0.02  # m or rad
BEHIND = 1.0  # m, from the ball
_COMPASS = 16  # ways for the ball that are compared
NEAREST = 5  # logged states that tell the cost to go


class Truth(Protocol):
    """Define what is measured of a task's macro steps. States are batches on the host.

    Attributes:
        reach_name: of what there is to get at.
        reach_steps: control steps in which it counts; one skill at least.
    """

    reach_name: str
    reach_steps: int

    def left(self, states: State) -> np.ndarray:
        """Return float64[...], how far the states are from success."""
        ...

    def outcome(self, before: State, after: State) -> np.ndarray:
        """Return float[N, S, k], what happened between states[S] and states[N, S]."""
        ...

    def reach(self, before: State, after: State) -> np.ndarray:
        """Return bool[N, S'], whether a way gets at what there is to get at, of the states[S'] where it counts."""
        ...


class MazeTruth:
    """Measure ways on the floor.

    Args:
        env: a maze.
    """

    reach_name = "freed_from_walls"

    def __init__(self, env: Any) -> None:
        self._env = env
        self.reach_steps = round(WAY_SECONDS * steps_per_second(env))

    def left(self, states: State) -> np.ndarray:
        """Return the shortest path to the goal."""
        qpos = np.asarray(states.pipeline_state.qpos)
        left = self._env.distance_left(qpos.reshape(-1, qpos.shape[-1])).reshape(qpos.shape[:-1])
        return np.nan_to_num(left, posinf=1e3)

    def outcome(self, before: State, after: State) -> np.ndarray:
        """Return where the body got, as seen from its start."""
        start, end = (np.asarray(states.pipeline_state.qpos) for states in (before, after))
        pose = np.asarray(self._env.body_frame.pose(before.obs))
        turn = pose[:, 2] - 1j * pose[:, 3]
        moved = ((end[..., 0] - start[:, 0]) + 1j * (end[..., 1] - start[:, 1])) * turn
        return np.stack([moved.real, moved.imag], axis=-1)

    def reach(self, before: State, after: State) -> np.ndarray:
        """Return whether the body gets away from the wall at which it stands."""
        far = np.linalg.norm(self.outcome(before, after), axis=-1) > AWAY
        return far[:, at_walls(self._env, np.asarray(before.pipeline_state.qpos))]


class BallTruth(MazeTruth):
    """Measure ways on the floor of a body that pushes a ball: to where it has to stand, then the ball's.

    Args:
        env: a maze with a ball.
    """

    def left(self, states: State) -> np.ndarray:
        """Return the way of the body to the place ``BEHIND`` the ball, and twice the ball's to the goal.

        Behind is where the ball's own way does not lead. The way to the ball itself would call it a step back to walk
        around it.
        """
        qpos = np.asarray(states.pipeline_state.qpos)
        body, ball = self._env.position(qpos.reshape(-1, qpos.shape[-1])).values()
        distance, goal = self._env.layout.distance, self._env.goal_xy
        angles = np.arange(_COMPASS) * 2 * np.pi / _COMPASS
        around = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        ahead = np.stack([distance(ball + BEHIND * way, goal) for way in around])
        place = ball - BEHIND * around[ahead.argmin(axis=0)]
        walk = distance(body, place)
        walk = np.where(np.isfinite(walk), walk, distance(body, ball) + BEHIND)  # the place is in a wall
        return np.nan_to_num(walk + 2 * distance(ball, goal), posinf=1e3).reshape(qpos.shape[:-1])


class GraphValues:
    """Tell the cost to go on the graph of logged states, which weighs the segments in training.

    Args:
        trained: the run, which says how the graph is made.
        dataset: its data.
    """

    def __init__(self, trained: TrainedRun, dataset: Dataset) -> None:
        values, horizon = trained.config.values, trained.config.skills.horizon
        data, self._normalise = to_device(dataset, horizon)
        seen = np.asarray(data.observations), np.asarray(data.next_observations)
        self._features = fit_slow_features(*seen, np.asarray(data.starts), horizon, values.slowness)
        self._tree = KDTree(self._features(seen[0]))
        self._costs, self._jump = graph_costs(values, horizon, data, dataset.ends), horizon * values.jump_cost

    def left(self, states: State) -> np.ndarray:
        """Return the cost to go of the nearest logged states, the way to them included."""
        features = self.features(states)
        distance, rows = self._tree.query(features.reshape(-1, features.shape[-1]), NEAREST, workers=-1)
        return (self._costs[rows] + self._jump * distance).min(axis=1).reshape(features.shape[:-1]).astype(np.float64)

    def features(self, states: State) -> np.ndarray:
        """Return the graph's features of the states, [..., F]."""
        seen = np.asarray(self._normalise(states.obs))
        return self._features(seen.reshape(-1, seen.shape[-1])).reshape(*seen.shape[:-1], -1)


class ArmTruth:
    """Measure what an arm does to things, and the cost to go on the graph of logged states.

    Args:
        trained: the run.
        values: of its data.
    """

    reach_name, reach_steps = "moves_things", 0

    def __init__(self, trained: TrainedRun, values: GraphValues) -> None:
        self._values = values
        self._things = ROBOT_JOINTS if hasattr(trained.env, "rig") else JOINTS

    def left(self, states: State) -> np.ndarray:
        """Return the values' cost to go."""
        return self._values.left(states)

    def outcome(self, before: State, after: State) -> np.ndarray:
        """Return the change of the graph's features."""
        return self._values.features(after) - self._values.features(before)

    def reach(self, before: State, after: State) -> np.ndarray:
        """Return whether anything but the arm moves."""
        start, end = (np.asarray(states.pipeline_state.qpos)[..., self._things :] for states in (before, after))
        return (np.abs(end - start) > MOVED).any(axis=-1)


def truth_of(trained: TrainedRun, values: GraphValues) -> Truth:
    """Return what can be measured of a run's task, of whose data ``values`` are."""
    if trained.env.floor_map() is None:
        return ArmTruth(trained, values)
    return (BallTruth if trained.env.body_frame.points else MazeTruth)(trained.env)


def at_walls(env: Any, qpos: np.ndarray) -> np.ndarray:
    """Return bool[S], whether the body is at most ``WALL`` from a wall's face."""
    gap = np.abs(qpos[:, None, :2] - env.floor_map().walls) - UNIT / 2
    return (np.linalg.norm(np.maximum(gap, 0), axis=-1).min(axis=1) < WALL).astype(bool)
