"""IQL on a grid: its values against tables swept to their fixed point, its policy against shortest ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.config import PolicyConfig
from qdos_brax.offline.iql_policy import IQLPolicy, regression_weight
from qdos_brax.skills.values import IQL
from tests.offline.gridworld import MOVES, Gridworld
from tests.offline.training import train

DISCOUNT, EXPECTILE = 0.9, 0.9
GRID = ["....", ".##.", "..#.", "..#G"]


@pytest.fixture(scope="module")
def trained():
    grid = Gridworld(GRID)
    learner = IQLPolicy(grid.size, 2, PolicyConfig(hidden=(64,), batch_size=128), IQL(grid.size, 2, (64,)))
    hyper = {
        "values.learning_rate": 2e-3,
        "values.expectile": EXPECTILE,
        "values.target_rate": 0.05,
        "values.discount": DISCOUNT,
        "policy.learning_rate": 2e-3,
        "policy.inverse_temperature": 10.0,
    }
    state, info = train(learner, grid.data(), hyper, 4000)
    return grid, learner, state, info


def learned_values(learner, state, grid):
    """V[S] and the mean of both heads of Q[S, 4]."""

    @jax.jit
    def look(values):
        states = jnp.eye(grid.size)
        q = learner.values.q(values.critic, jnp.repeat(states, 4, axis=0), jnp.tile(jnp.asarray(MOVES), (grid.size, 1)))
        return learner.values.value(values.value, states), q.mean(axis=0).reshape(-1, 4)

    return look(state.values)


def test_values_are_the_fixed_point_of_tables(trained):
    grid, learner, state, _ = trained
    expected = grid.values(DISCOUNT, EXPECTILE)
    value, q = learned_values(learner, state, grid)
    np.testing.assert_allclose(value, expected, atol=0.25)
    expected_q = np.where((np.arange(grid.size) == grid.goal)[:, None], 0, -1 + DISCOUNT * expected[grid.after])
    np.testing.assert_allclose(q, expected_q, atol=0.3)
    # And the fixed point is near the optimum, with which it agrees about every comparison of states.
    best = grid.values(DISCOUNT, 1)
    assert np.corrcoef(expected, best)[0, 1] > 0.99 and np.corrcoef(value, best)[0, 1] > 0.98


def test_the_policy_takes_shortest_ways(trained):
    grid, learner, state, _ = trained
    mean = np.asarray(learner.act(learner.params(state), jnp.eye(grid.size)))
    chosen = (mean @ MOVES.T).argmax(axis=1)
    distance = grid.distances()[:, grid.goal]
    for s in range(grid.size):
        if s != grid.goal:
            assert distance[grid.after[s, chosen[s]]] == distance[s] - 1, (grid.cells[s], mean[s])


def test_regression_weights_by_hand():
    weight = regression_weight(jnp.array([0.0, 0.1, -0.2, 5.0]), 10.0)
    np.testing.assert_allclose(weight, [1.0, np.e, np.exp(-2), 100.0], rtol=1e-5)
