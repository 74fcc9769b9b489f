"""Calibrated conservative Q-learning: returns and losses by hand, and its values and ways on a grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.serialization import from_state_dict
from scipy.special import logsumexp

from qdos_brax.config import FlowConfig, HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.sac import SAC
from qdos_brax.offline.cal_ql import CalQL, Proposals, decision_returns
from tests.offline.gridworld import MOVES, Gridworld, device_data
from tests.offline.training import train

DISCOUNT = 0.9
GRID = ["....", ".##.", "..#.", "..#G"]


def episodes():
    """One of four steps that is cut off, one that succeeds in its second step of three, one of a single step."""
    return device_data(
        np.zeros((8, 1)),
        np.zeros((8, 1)),
        rewards=[-1, -1, -2, -3, -1, 0, -1, -5],
        masks=[1, 1, 1, 1, 1, 0, 1, 1],
        last=[3, 3, 3, 3, 6, 6, 6, 7],
    )


def test_returns_of_single_steps_by_hand() -> None:
    """What is cut off goes on as in its last row for ever; what succeeded earns nothing after."""
    found = decision_returns(episodes(), jnp.arange(8), 1, 4, 0.5)
    third = -2 + 0.5 * (-3 / 0.5)
    np.testing.assert_allclose(
        found, [-1 + 0.5 * (-1 + 0.5 * third), -1 + 0.5 * third, third, -6, -1, 0, -2, -10], rtol=1e-6
    )


def test_returns_of_windows_count_steps_within_and_decisions_between() -> None:
    found = decision_returns(episodes(), jnp.array([0, 1, 4]), 2, 2, 0.5)
    beyond = (-3 - 0.5 * 3) / 0.5  # two steps at 3 per decision, for ever
    first = (-1 - 0.5 * 1) + 0.5 * (-2 - 0.5 * 3) + 0.25 * beyond
    second = (-1 - 0.5 * 2) + 0.5 * beyond  # rows 3, 3, and on
    np.testing.assert_allclose(found, [first, second, -1], rtol=1e-6)


def test_without_a_discount_there_is_no_bound_where_costs_go_on() -> None:
    found = np.asarray(decision_returns(episodes(), jnp.array([0, 4]), 1, 4, 1.0))
    assert found[0] == -np.inf and found[1] == -1


@pytest.fixture(scope="module")
def learner() -> CalQL:
    sac = SAC(3, 2, HighLevelConfig(hidden=(8,), ensemble=3, target_subset=2, value_scale=2.0))
    return CalQL(sac, 1, 1, FlowConfig(conservative_actions=4))


def drawn(key: jax.Array, bound: float) -> Proposals:
    action_key, density_key = jax.random.split(key)
    action = jax.random.uniform(action_key, (4, 5, 2), minval=-1.0, maxval=1.0)
    return Proposals(action, bound * jax.random.normal(density_key, (4, 5)))


@pytest.mark.parametrize("returns", [-100.0, 0.3, 100.0])
def test_the_gap_is_the_soft_maximum_less_q_of_the_data_and_only_the_actors_q_is_bounded(learner, returns) -> None:
    sac = learner._sac
    critic = sac.init(jax.random.key(0), 0.1).critic
    keys = jax.random.split(jax.random.key(1), 5)
    states, actions = jax.random.normal(keys[0], (5, 3)), jax.random.uniform(keys[1], (5, 2))
    batch = Transition(states, actions, jnp.zeros(5), jnp.ones(5), states)
    anywhere, here, ahead = (drawn(key, 1.0) for key in keys[2:])
    found = learner.gap(critic, batch, anywhere, (here, ahead), jnp.full(5, returns))
    expected = np.zeros(3)
    for row in range(5):
        terms = []
        for some, least in ((anywhere, -np.inf), (here, returns), (ahead, returns)):
            q = np.asarray(sac.values(critic, jnp.tile(states[row], (4, 1)), some.action[:, row]))
            terms.append(np.maximum(q, least) - np.asarray(some.log_density[:, row]))
        data = np.asarray(sac.values(critic, states[row], actions[row]))
        expected += (logsumexp(np.concatenate(terms, axis=1), axis=1) - data) / 5
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_proposals_come_with_their_density(learner) -> None:
    states = jax.random.normal(jax.random.key(0), (5, 3))
    anywhere = learner.uniform(jax.random.key(1), states)
    assert anywhere.action.shape == (4, 5, 2) and float(jnp.abs(anywhere.action).max()) < 1
    np.testing.assert_allclose(anywhere.log_density, np.log(0.25), rtol=1e-6)
    actor = learner._sac.init(jax.random.key(2), 0.1).actor
    mean, log_std = learner._sac.actor.apply(actor, states)
    own = learner.own(actor, jax.random.key(3), states)
    before = np.arctanh(np.asarray(own.action, np.float64))
    gaussian = -0.5 * ((before - mean) * np.exp(-log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)
    jacobian = np.log1p(-(np.asarray(own.action, np.float64) ** 2))
    np.testing.assert_allclose(own.log_density, (gaussian - jacobian).sum(axis=-1), rtol=1e-3, atol=1e-4)


def hyper(weight: float) -> dict[str, float]:
    return {
        "high_level.learning_rate": 2e-3,
        "high_level.target_rate": 0.05,
        "high_level.discount": DISCOUNT,
        "high_level.init_temperature": 0.01,
        "high_level.target_entropy_scale": 1.0,
        "high_level.target_divergence": 1.0,
        "flow.conservative_weight": weight,
    }


@pytest.fixture(scope="module")
def trained():
    """Of every state the data has the best way alone, as one episode to the goal; and learned from the same rows, each
    an episode that is cut off, so that nothing bounds how far Q is held down."""
    grid = Gridworld(GRID)
    distance = grid.distances()[:, grid.goal]
    best = distance[grid.after].argmin(axis=1)
    paths = [[state] for state in range(grid.size)]
    for path in paths:
        while path[-1] != grid.goal:
            path.append(grid.after[path[-1], best[path[-1]]])
    lengths = [len(path) for path in paths]
    states, moves = np.concatenate(paths), best[np.concatenate(paths)]
    data = device_data(
        np.eye(grid.size)[states],
        MOVES[moves],
        np.eye(grid.size)[grid.after[states, moves]],
        rewards=np.where(states == grid.goal, 0.0, -1.0),
        masks=np.where(states == grid.goal, 0.0, 1.0),
        last=np.repeat(np.cumsum(lengths) - 1, lengths),
    )
    data = data.replace(labels=0.9 * data.actions)
    sac = SAC(grid.size, 2, HighLevelConfig(hidden=(64,), ensemble=3, target_subset=2))
    learner = CalQL(sac, 1, max(lengths), FlowConfig(batch_size=128, conservative_actions=4))
    cut = data.replace(last=jnp.arange(len(states)))
    bounded, unbounded = (train(learner, rows, hyper(1.0), 1500)[0] for rows in (data, cut))
    return grid, sac, learner, bounded, unbounded, distance


def test_the_actor_takes_the_ways_of_the_data_and_returns_bound_how_far_q_is_held_down(trained) -> None:
    grid, sac, _, bounded, unbounded, distance = trained
    states, ways = jnp.eye(grid.size), np.arange(grid.size) != grid.goal
    earned = -(1 - DISCOUNT**distance) / (1 - DISCOUNT)
    missed = {}
    for name, state in (("bounded", bounded), ("unbounded", unbounded)):
        mode = sac.mode(state.actor, states)
        chosen = (np.asarray(mode) @ MOVES.T).argmax(axis=1)
        np.testing.assert_array_equal(distance[grid.after[np.arange(grid.size), chosen]][ways], distance[ways] - 1)
        q = np.asarray(sac.values(state.critic, states, mode)).mean(axis=0)
        missed[name] = np.maximum(earned - q, 0)[ways].mean()
    assert missed["bounded"] < 0.7 * missed["unbounded"]


def test_decisions_that_the_data_lacks_are_held_down(trained) -> None:
    grid, sac, _, state, _, distance = trained
    states = jnp.eye(grid.size)
    best = distance[grid.after].argmin(axis=1)
    q = lambda moves: np.asarray(sac.values(state.critic, states, 0.9 * jnp.asarray(MOVES[moves], jnp.float32)))  # noqa: E731
    lower = (q(best) - q((best + 2) % 4)).mean(axis=0)[np.arange(grid.size) != grid.goal]
    assert lower.min() > 0.5


def test_what_is_handed_on_is_a_state_of_sac(trained) -> None:
    _, sac, learner, state, *_ = trained
    begun = from_state_dict(sac.init(jax.random.key(7), 0.5), learner.params(state))
    jax.tree.map(np.testing.assert_array_equal, begun, state)
    assert int(begun.critic_opt_state.count) == int(begun.actor_opt_state.count) == 1500
