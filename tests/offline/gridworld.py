"""A grid with walls as data, and its values found by sweeping tables: what the flat learners are held against."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from qdos_brax.data.device import DeviceData

MOVES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])  # down, right, up, left


class Gridworld:
    """States are free cells, an action is one of MOVES; moves into walls stay. Reward -1 until the goal, which ends it.

    Args:
        rows: one string per row, "." free, "G" the goal, "#" wall.
    """

    def __init__(self, rows: list[str]) -> None:
        cells = [(i, j) for i, row in enumerate(rows) for j, mark in enumerate(row) if mark != "#"]
        index = {cell: state for state, cell in enumerate(cells)}
        self.cells = np.array(cells)
        self.size = len(cells)
        self.goal = next(state for state, (i, j) in enumerate(cells) if rows[i][j] == "G")
        self.after = np.array([[index.get((i + di, j + dj), s) for di, dj in MOVES] for s, (i, j) in enumerate(cells)])

    def data(self) -> DeviceData:
        """Every action in every state once, states one-hot: the empirical distribution is exact."""
        state, action = np.divmod(np.arange(4 * self.size), 4)
        return device_data(
            np.eye(self.size)[state],
            MOVES[action],
            np.eye(self.size)[self.after[state, action]],
            rewards=np.where(state == self.goal, 0.0, -1.0),
            masks=np.where(state == self.goal, 0.0, 1.0),
        )

    def distances(self) -> np.ndarray:
        """int[S, S], steps of the shortest way from row to column."""
        distance = np.where(np.eye(self.size, dtype=bool), 0, 10**6)
        for _ in range(self.size):
            distance = np.minimum(distance, 1 + distance[self.after].min(axis=1))
        return np.where(np.eye(self.size, dtype=bool), 0, distance)

    def values(self, discount: float, expectile: float) -> np.ndarray:
        """V where V(s) is the expectile of Q(s, a) over the four actions and Q(s, a) = r + discount V(s'): IQL's own
        fixed point for uniform behaviour; expectile 1 gives the optimal values."""
        value = np.zeros(self.size)
        for _ in range(200):
            q = -1 + discount * value[self.after]
            value = q.max(axis=1) if expectile == 1 else expectile_of(q, expectile)
            value[self.goal] = 0
        return value


def expectile_of(x: np.ndarray, expectile: float) -> np.ndarray:
    """The m of each row with expectile E[(x - m)+] = (1 - expectile) E[(m - x)+], by bisection."""
    low, high = x.min(axis=1), x.max(axis=1)
    for _ in range(40):
        middle = (low + high) / 2
        gap = x - middle[:, None]
        short = (np.where(gap > 0, expectile, 1 - expectile) * gap).sum(axis=1) > 0
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return (low + high) / 2


def device_data(observations, actions, next_observations=None, rewards=None, masks=None, last=None) -> DeviceData:
    """Arrays of any kind as the learners' data; by default each row is an episode of its own."""
    rows = len(observations)
    as_float = lambda x, default: jnp.asarray(default if x is None else x, jnp.float32)  # noqa: E731
    return DeviceData(
        observations=as_float(observations, None),
        next_observations=as_float(next_observations, observations),
        actions=as_float(actions, None),
        rewards=as_float(rewards, np.zeros(rows)),
        masks=as_float(masks, np.ones(rows)),
        starts=jnp.arange(rows, dtype=jnp.int32),
        last=jnp.asarray(np.arange(rows) if last is None else last, jnp.int32),
        qpos=None,
        qvel=None,
    )
