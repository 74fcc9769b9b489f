"""How far every logged state is from success: shortest paths on a graph of logged states.

Nodes are states at regular intervals along the episodes. An episode's own steps lead from node to node at what they
cost; between neighbours one may jump, at the cost of the time in which the data changes as far: to those of other
episodes, so that ways are put together from pieces of many, and to the nearest of all, mostly of the same episode, so
that a walk in circles is not taken for the only way. Distances are not discounted: far from the goal a step forward
counts as much as near it.

Related: planning on a graph of replayed states (Eysenbach et al. 2019, SoRB), values on a graph of clustered states
(Cho et al. 2023, Value Memory Graph), and jumps between neighbours at a price (Shrestha et al. 2021, DAC-MDP).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from qdos_brax.data.dataset import episode_bounds

_BLOCK = 20_000  # nodes whose neighbours are sought at once
_INTERVAL = 10  # rows between two nodes, where there are enough for ``_ENOUGH`` nodes
_ENOUGH = 20_000
_LEAST_COST = 1e-6  # scipy takes an edge of weight 0 for none


def step_costs(rewards: np.ndarray) -> np.ndarray:
    """Return float64[N], the highest reward of the data minus the row's; all 1 where rewards are the same everywhere.

    For rewards of -1 until success this is 1 per step and 0 in success.
    """
    rewards = np.asarray(rewards, np.float64)
    costs = rewards.max() - rewards
    return costs if costs.any() else np.ones_like(costs)


def costs_to_go(
    features: np.ndarray,
    costs: np.ndarray,
    ends: np.ndarray,
    *,
    max_nodes: int,
    neighbours: int,
    jump_cost: float,
) -> np.ndarray:
    """Return the least summed cost with which a row of cost 0 can be reached, from every row.

    Args:
        features: float32[N, F]; distances in them, times ``jump_cost``, count in steps.
        costs: float[N], >= 0, of the step that leaves the row; 0 where there is nothing left to reach.
        ends: bool[N], the last row of each episode.
        max_nodes: of about a tenth of the rows, or of 20,000 if that is more, at most so many become nodes; the rows
            between two nodes are interpolated.
        neighbours: jumps from every node to the nearest nodes of all, and as many to the nearest of other episodes.
        jump_cost: steps per unit of distance.

    Returns:
        float32[N]. Where no way leads, the largest cost that occurs; all 0 if no row has cost 0.
    """
    costs = np.asarray(costs, np.float64)
    if costs.min() > 0:
        return np.zeros(len(costs), np.float32)
    episode = _episode_numbers(ends)
    nodes = _nodes(costs, ends, episode, max_nodes)
    spent = np.concatenate([[0.0], np.cumsum(costs)])[nodes]
    along = np.flatnonzero(episode[nodes[:-1]] == episode[nodes[1:]])
    edges = [(along, along + 1, spent[along + 1] - spent[along])]
    count = min(neighbours, len(nodes) - np.bincount(episode[nodes]).max())  # every node has so many others at least
    if count > 0:
        near, distance = _neighbours(features[nodes], episode[nodes], count)
        here = np.repeat(np.arange(len(nodes)), near.shape[1])
        there, steps, rate = near.ravel(), jump_cost * distance.ravel(), costs[nodes]
        edges += [(here, there, rate[here] * steps), (there, here, rate[there] * steps)]
    return _interpolated(_to_goal(edges, costs[nodes] == 0), nodes, episode, costs)


def _episode_numbers(ends: np.ndarray) -> np.ndarray:
    bounds = episode_bounds(ends)
    return np.repeat(np.arange(len(bounds)), bounds[:, 1] - bounds[:, 0])


def _nodes(costs: np.ndarray, ends: np.ndarray, episode: np.ndarray, max_nodes: int) -> np.ndarray:
    """Rows at regular intervals from each episode's first; its last one, and those where a goal is entered, as well."""
    interval = -(-len(costs) // min(max_nodes, max(_ENOUGH, len(costs) // _INTERVAL)))
    bounds = episode_bounds(ends)
    chosen = (np.arange(len(costs)) - bounds[episode, 0]) % interval == 0
    chosen[bounds[:, 1] - 1] = True
    at_goal = costs == 0
    entered = at_goal & ~np.concatenate([[False], at_goal[:-1]])
    return np.flatnonzero(chosen | entered)


def _neighbours(points: np.ndarray, episode: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices[M, 2 count] of the nearest points of all, then of other episodes, and their distances[M, 2 count]."""
    tree, near = KDTree(points), np.empty((len(points), 2 * count), np.int64)
    for first in range(0, len(points), _BLOCK):
        rows, asked = np.arange(first, min(first + _BLOCK, len(points))), 4 * count
        while len(rows):  # until all have enough among those that were asked for
            asked = min(asked, len(points))
            found = tree.query(points[rows], np.arange(1, asked + 1), workers=-1)[1]
            others = episode[found] != episode[rows, None]
            enough = others.sum(axis=1) >= count
            wanted = (found != rows[:, None], others)
            parts = [found[enough][_first_true(mask[enough], count)].reshape(-1, count) for mask in wanted]
            near[rows[enough]] = np.concatenate(parts, axis=1)
            rows, asked = rows[~enough], 4 * asked
    return near, np.linalg.norm(points[near] - points[:, None], axis=-1).astype(np.float64)


def _first_true(mask: np.ndarray, count: int) -> np.ndarray:
    """Return ``mask`` with only the first ``count`` of each row's true entries, of which there are enough."""
    return mask & (np.cumsum(mask, axis=1) <= count)


def _to_goal(edges: list[tuple[np.ndarray, np.ndarray, np.ndarray]], goal: np.ndarray) -> np.ndarray:
    """Dijkstra from all goals at once, against the direction of the edges (from, to, cost)."""
    start, stop, cost = (np.concatenate(part) for part in zip(*edges, strict=True))
    order = np.lexsort((cost, stop, start))  # of several edges between two nodes the cheapest counts
    start, stop, cost = start[order], stop[order], np.maximum(cost[order], _LEAST_COST)
    first = np.concatenate([[True], (start[1:] != start[:-1]) | (stop[1:] != stop[:-1])])
    graph = csr_array((cost[first], (stop[first], start[first])), shape=(len(goal), len(goal)))
    return dijkstra(graph, indices=np.flatnonzero(goal), min_only=True)


def _interpolated(at_nodes: np.ndarray, nodes: np.ndarray, episode: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """Values of all rows, linear in time between the nodes before and after; 0 at goals."""
    reached = np.isfinite(at_nodes)
    at_nodes = np.where(reached, at_nodes, at_nodes[reached].max())
    rows = np.interp(np.arange(len(episode)), nodes, at_nodes)  # an episode's first and last row are nodes
    return np.where(costs == 0, 0.0, rows).astype(np.float32)
