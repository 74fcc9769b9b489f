"""A warm start for SAC: its losses by hand, its values on a grid against swept tables, and what it hands on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.serialization import from_state_dict

from qdos_brax.config import FlowConfig, HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.sac import SAC, SACHyper
from qdos_brax.offline.warm_start import WarmStart, WarmStartHyper
from tests.offline.gridworld import MOVES, Gridworld
from tests.offline.training import train

DISCOUNT, EXPECTILE = 0.9, 0.9
GRID = ["....", ".##.", "..#.", "..#G"]


def constant(params, value):
    """Parameters of an MLP, or of an ensemble of them, that gives ``value`` whatever it sees."""
    blank = jax.tree.map(jnp.zeros_like, params)
    paths, tree = jax.tree_util.tree_flatten_with_path(blank)
    last = max(jax.tree_util.keystr(path) for path, _ in paths if "Dense" in jax.tree_util.keystr(path))
    last = last.replace("kernel", "bias")
    filled = [jnp.full_like(x, value) if jax.tree_util.keystr(path) == last else x for path, x in paths]
    return jax.tree.unflatten(tree, filled)


def test_one_step_by_hand():
    """V = 4 (a network's 2 in units of 2), Q = 7 (3.5): A = 3, and the target of a row is r + 0.5 mask 4."""
    sac = SAC(1, 1, HighLevelConfig(hidden=(4,), ensemble=3, target_subset=2, value_scale=2.0))
    learner = WarmStart(sac, (4,), 1, FlowConfig(batch_size=2))
    state = learner.init(jax.random.key(0), {"high_level.init_temperature": 0.1})
    heads = constant(state.sac.critic, 3.5)
    own = state.sac.replace(critic=heads, target_critic=heads, actor=jax.tree.map(jnp.zeros_like, state.sac.actor))
    state = state.replace(sac=own, value=constant(state.value, 2.0))
    column = jnp.zeros((2, 1))
    batch = Transition(column, column + 0.5, jnp.array([-1.0, 0.0]), jnp.array([1.0, 0.0]), column)
    hyper = WarmStartHyper(SACHyper(0.0, 0.5, 0.1, -1.0), 0.8, jnp.log(2.0))
    after, info = jax.jit(learner.step)(state, batch, jax.random.key(1), hyper)
    # Rates of 0 leave everything but the targets where it was, and they equal the critics.
    jax.tree.map(np.testing.assert_array_equal, after.sac.critic, heads)
    np.testing.assert_allclose(info["value_loss"], 0.8 * 3**2, rtol=1e-6)
    np.testing.assert_allclose(info["q"], (1.0 + 0.0) / 2, rtol=1e-6)
    np.testing.assert_allclose(info["critic_loss"], ((7 - 1) ** 2 + 7**2) / 2, rtol=1e-6)
    np.testing.assert_allclose(info["policy_weight"], 8.0, rtol=1e-6)  # 2^3
    # The actor of zeros is tanh of N(0, 1): log density at u is -artanh(u)^2 / 2 - log(2 pi) / 2 - log(1 - u^2).
    density = -(np.arctanh(0.5) ** 2) / 2 - np.log(2 * np.pi) / 2 - np.log(0.75)
    np.testing.assert_allclose(info["actor_loss"], -8 * density, rtol=1e-5)


@pytest.fixture(scope="module")
def trained():
    grid = Gridworld(GRID)
    data = grid.data()
    data = data.replace(labels=0.99 * data.actions)
    sac = SAC(grid.size, 2, HighLevelConfig(hidden=(64,), ensemble=3, target_subset=2))
    learner = WarmStart(sac, (64,), 1, FlowConfig(batch_size=128))
    hyper = {
        "high_level.learning_rate": 2e-3,
        "high_level.target_rate": 0.05,
        "high_level.discount": DISCOUNT,
        "high_level.init_temperature": 0.1,
        "high_level.target_entropy_scale": 1.0,
        "high_level.target_divergence": 1.0,
        "values.expectile": EXPECTILE,
        "policy.inverse_temperature": 10.0,
    }
    state, _ = train(learner, data, hyper, 4000)
    return grid, sac, learner, state


def test_values_are_the_fixed_point_of_tables(trained):
    grid, sac, learner, state = trained
    expected = grid.values(DISCOUNT, EXPECTILE)
    states = jnp.eye(grid.size)
    np.testing.assert_allclose(learner.value(state.value, states), expected, atol=0.25)
    everywhere = jnp.repeat(states, 4, axis=0), 0.99 * jnp.tile(jnp.asarray(MOVES, jnp.float32), (grid.size, 1))
    q = sac.values(state.sac.critic, *everywhere).mean(axis=0).reshape(-1, 4)
    expected_q = np.where((np.arange(grid.size) == grid.goal)[:, None], 0, -1 + DISCOUNT * expected[grid.after])
    np.testing.assert_allclose(q, expected_q, atol=0.3)


def test_what_is_handed_on_is_a_state_of_sac_whose_actor_takes_shortest_ways(trained):
    grid, sac, learner, state = trained
    blank = sac.init(jax.random.key(7), 0.5)
    begun = from_state_dict(blank, learner.params(state))
    jax.tree.map(np.testing.assert_array_equal, begun, state.sac)
    assert int(begun.critic_opt_state.count) == int(begun.actor_opt_state.count) == 4000
    np.testing.assert_allclose(begun.log_temperature, np.log(0.1), rtol=1e-6)  # not learned offline
    chosen = (np.asarray(sac.mode(begun.actor, jnp.eye(grid.size))) @ MOVES.T).argmax(axis=1)
    distance = grid.distances()[:, grid.goal]
    for s in range(grid.size):
        if s != grid.goal:
            assert distance[grid.after[s, chosen[s]]] == distance[s] - 1, grid.cells[s]
