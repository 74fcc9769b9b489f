"""Slow features, shortest paths on a graph of logged states, and the phase that learns them, where all is known."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import spearmanr

from qdos_brax import config as configs
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import to_device
from qdos_brax.data.quality import auc
from qdos_brax.data.segments import segment_starts
from qdos_brax.errors import UserError
from qdos_brax.skills.graph_phase import GraphPhase
from qdos_brax.skills.slow_features import fit_slow_features
from qdos_brax.skills.state_graph import costs_to_go, step_costs
from tests.point import GOAL, TOLERANCE, bound, point_config, point_dataset


def test_costs_of_steps_by_hand():
    np.testing.assert_array_equal(step_costs(np.array([-1.0, 0.0, -1.0])), [1, 0, 1])
    np.testing.assert_array_equal(step_costs(np.array([0.0, 3.0, 1.0])), [3, 0, 2])
    np.testing.assert_array_equal(step_costs(np.array([-1.0, -1.0])), [1, 1])  # no success anywhere


def test_paths_by_hand():
    """Two walks on a line, A: 0 1 2 3 away from the goal, B: 3.5 .. 6.5 to the goal at 6.5; a jump costs 4 per unit."""
    features = np.array([0, 1, 2, 3, 3.5, 4.5, 5.5, 6.5], np.float32)[:, None]
    costs = np.array([1, 1, 1, 1, 1, 1, 1, 0.0])
    ends = np.array([0, 0, 0, 1, 0, 0, 0, 1], bool)
    settings = {"max_nodes": 8, "neighbours": 1, "jump_cost": 4.0}
    found = costs_to_go(features, costs, ends, **settings)
    # B counts its steps. From 3 one jumps 0.5 for 2 steps; who comes from 0 walks to 3 first, 3 + 2 + 3.
    np.testing.assert_allclose(found, [8, 7, 6, 5, 3, 2, 1, 0], rtol=1e-5)
    # With every other row a node: the rows between are interpolated, and nothing else changes here.
    np.testing.assert_allclose(costs_to_go(features, costs, ends, **settings | {"max_nodes": 4}), found, rtol=1e-5)


def test_steps_cost_what_their_rewards_say():
    costs = np.array([5.0, 2.0, 1.0, 0.0])
    ends = np.array([0, 0, 0, 1], bool)
    found = costs_to_go(np.zeros((4, 1), np.float32), costs, ends, max_nodes=4, neighbours=3, jump_cost=1.0)
    np.testing.assert_allclose(found, [8, 3, 1, 0], rtol=1e-5)


def test_without_a_goal_all_costs_are_zero_and_unreachable_states_cost_the_most():
    features, ends = np.arange(4, dtype=np.float32)[:, None], np.array([0, 1, 0, 1], bool)
    settings = {"max_nodes": 4, "neighbours": 1, "jump_cost": 1.0}
    np.testing.assert_array_equal(costs_to_go(features, np.ones(4), ends, **settings), 0.0)
    lone = costs_to_go(features[:2], np.array([0.0, 1.0]), ends[:2], **settings)  # one episode: no jump, no way back
    np.testing.assert_array_equal(lone, [0.0, 0.0])


def walks_around_a_wall(episodes: int, length: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """xy[E, L, 2] on a 9 x 9 grid with a wall at x = 4 for y < 7, by random steps; and steps left to (8, 0), [9, 9]."""
    wall = np.zeros((9, 9), bool)
    wall[4, :7] = True
    left = np.full((9, 9), np.inf)
    left[8, 0] = 0
    moves = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    for _ in range(81):  # Bellman-Ford on the grid
        for move in moves:
            for x, y in np.argwhere(~wall):
                i, j = x + move[0], y + move[1]
                if 0 <= i < 9 and 0 <= j < 9 and not wall[i, j]:
                    left[x, y] = min(left[x, y], left[i, j] + 1)
    rng = np.random.default_rng(seed)
    free = np.argwhere(~wall)
    at = free[rng.integers(len(free), size=episodes)]
    seen = []
    for _ in range(length):
        seen.append(at)
        after = at + moves[rng.integers(4, size=episodes)]
        inside = ((after >= 0) & (after < 9)).all(axis=1)
        blocked = ~inside | wall[tuple(np.clip(after, 0, 8).T)]
        at = np.where(blocked[:, None], at, after)
    return np.stack(seen, axis=1), left


def test_shortest_paths_go_around_the_wall():
    """No walk knows the way; jumps between equal cells are free, so that every step seen anywhere may be used."""
    xy, left = walks_around_a_wall(episodes=150, length=40, seed=0)
    flat = xy.reshape(-1, 2)
    costs = np.where((flat == [8, 0]).all(axis=1), 0.0, 1.0)
    ends = np.tile(np.arange(40) == 39, 150)
    found = costs_to_go(flat.astype(np.float32), costs, ends, max_nodes=6000, neighbours=40, jump_cost=2.0)
    true = left[tuple(flat.T)]
    # From a row the walk's own next step may be bad; it must reach a row of the same cell whose step is good.
    assert np.mean(np.abs(found - true) < 0.01) > 0.9
    assert found.min() >= 0 and np.all(found >= true - 0.01)  # a jump is dearer than walking, so nothing is below
    behind, before = (flat == [5, 0]).all(axis=1), (flat == [3, 0]).all(axis=1)
    assert found[behind].mean() == pytest.approx(3, abs=0.5) and found[before].mean() == pytest.approx(19, abs=1.5)


def test_slow_features_find_the_slow_direction_and_its_scale():
    """A slow and a fast first-order process, mixed: x_t+1 = a x_t + sqrt(1 - a^2) noise has autocorrelation a^lag."""
    rng = np.random.default_rng(0)
    episodes, length, lag = 200, 100, 10
    hidden = np.zeros((episodes, length + 1, 2))
    decay = np.array([0.995, 0.8])
    hidden[:, 0] = rng.normal(size=(episodes, 2))
    for t in range(length):
        hidden[:, t + 1] = decay * hidden[:, t] + np.sqrt(1 - decay**2) * rng.normal(size=(episodes, 2))
    mixed = hidden @ np.array([[0.6, 0.8, 1.0], [1.6, -1.2, 3.0]])  # three columns of two sources
    observations, next_observations = (mixed[:, s].reshape(-1, 3) for s in (slice(0, -1), slice(1, None)))
    starts = segment_starts(np.tile(np.arange(length) == length - 1, episodes), lag)
    features = fit_slow_features(observations, next_observations, starts, lag, slowness=0.9)(observations)
    assert features.shape == (episodes * length, 1)
    slow = hidden[:, :-1, 0].reshape(-1)
    assert abs(np.corrcoef(features[:, 0], slow)[0, 1]) > 0.99
    # variance of a feature with mean square change 1: 1 / (2 (1 - a^lag))
    assert features.std() == pytest.approx(np.sqrt(1 / (2 * (1 - 0.995**lag))), rel=0.1)
    assert fit_slow_features(observations, next_observations, starts, lag, slowness=1.0).directions.shape[1] == 1
    assert fit_slow_features(observations, next_observations, starts, lag, slowness=0.0).directions.shape[1] == 2


def run(config: configs.Config, dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Values[N] and advantages[S]."""
    data, _ = to_device(dataset, config.skills.horizon)
    phase = bound(GraphPhase(config.values, config.skills, dataset.ends), configs.replace(config, seed=(0, 1)), data)
    state, metrics = phase.chunk(*phase.init(jax.random.split(jax.random.key(0), 2), {}))
    assert phase.num_chunks == 1 and metrics["update"].shape == (2,)
    advantage = np.asarray(phase.finish(state, {})["advantage"])
    np.testing.assert_array_equal(advantage[0], advantage[1])
    return np.asarray(state[0]), advantage[0]


@pytest.fixture(scope="module")
def plane():
    config, dataset = point_config(**{"values.slowness": 0.0}), point_dataset()
    return config, dataset, *run(config, dataset)


def test_values_on_the_plane_are_minus_the_steps_to_the_goal(plane):
    """The data walks 0.09 per step, so that the way takes (distance - tolerance) / 0.09 steps, rounded up."""
    _, dataset, value, _ = plane
    gap = np.linalg.norm(dataset.observations - GOAL, axis=-1)
    steps = np.maximum(gap - TOLERANCE, 0) / 0.09
    inside = (np.abs(dataset.observations) < 1).all(axis=-1)
    assert np.corrcoef(-value[inside], steps[inside])[0, 1] > 0.95
    assert np.all(value[gap <= TOLERANCE] == 0)
    longer = -value[inside & (steps > 5)] / steps[inside & (steps > 5)]
    assert 1.0 < np.median(longer) < 1.5  # pieced together from random walks


def test_advantages_tell_who_gains_ground_far_from_the_goal_too(plane):
    config, dataset, value, advantage = plane
    horizon = config.skills.horizon
    starts = segment_starts(dataset.ends, horizon)
    gap = np.linalg.norm(dataset.next_observations - GOAL, axis=-1)
    gain = np.linalg.norm(dataset.observations - GOAL, axis=-1)[starts] - gap[starts + horizon - 1]
    alive = dataset.masks[starts] > 0
    decided = alive & (np.abs(gain) > 0.2)
    assert auc(advantage[decided], gain[decided] > 0) > 0.95
    far = decided & (value[starts] < np.median(value))
    assert auc(advantage[far], gain[far] > 0) > 0.95


def test_the_advantage_is_the_change_of_value_less_the_cost_of_getting_there(plane):
    """Leaving the goal counts as a loss: masks, which say where an episode would have ended, do not matter."""
    config, dataset, value, advantage = plane
    horizon, starts = config.skills.horizon, segment_starts(dataset.ends, config.skills.horizon)
    raw = []
    for start in starts:
        after = start + horizon - (1 if dataset.ends[start + horizon - 1] else 0)
        raw.append(sum(dataset.rewards[start : start + horizon]) + value[after] - value[start])
    assert spearmanr(raw, advantage).statistic > 0.9999
    leaving = (dataset.masks[starts] == 0) & (value[starts + horizon - 1] < -2)
    assert leaving.sum() > 20 and np.asarray(raw)[leaving].max() < -2
    ordered = np.argsort(raw)
    assert np.all(np.diff(advantage[ordered]) >= -1e-3)


def test_a_second_search_finds_the_same_bit_for_bit(plane):
    config, dataset, value, advantage = plane
    again = run(config, dataset)
    np.testing.assert_array_equal(again[0], value)
    np.testing.assert_array_equal(again[1], advantage)


def test_without_success_the_segments_count_the_same_and_a_line_says_so(capsys):
    dataset = point_dataset(episodes=20)
    dataset.rewards[:] = -1.0
    dataset.masks[:] = 1.0
    _, advantage = run(point_config(), dataset)
    assert "no success in the data" in capsys.readouterr().err
    np.testing.assert_allclose(advantage, 0.0, atol=1e-6)


def test_the_transition_advantage_needs_iql():
    with pytest.raises(UserError, match=r"transition needs values.estimator=iql"):
        point_config(**{"skills.advantage": "transition"})
    point_config(**{"skills.advantage": "transition", "values.estimator": "iql"})
