"""HILP on a folded corridor: norms in the representation against shortest paths, skills that go where they point."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.config import HilbertConfig
from qdos_brax.offline.hilbert import GoalBatch, Hilbert, HilbertHyper, goal_rows
from tests.offline.gridworld import MOVES, Gridworld, device_data
from tests.offline.training import train

DISCOUNT = 0.99
HYPER = {
    "hilbert.learning_rate": 1e-3,
    "hilbert.expectile": 0.95,
    "hilbert.skill_expectile": 0.9,
    "hilbert.discount": DISCOUNT,
    "hilbert.target_rate": 0.02,
    "hilbert.inverse_temperature": 10.0,
}


def walks(after, observations, actions, episodes, length, seed=0):
    """Random walks over ``after``[S, A] as data: ``observations``[S, obs] before and after, ``actions``[A, act]."""
    rng = np.random.default_rng(seed)
    at, states, chosen = rng.integers(0, len(after), episodes), [], []
    for _ in range(length):
        states.append(at)
        chosen.append(rng.integers(0, len(actions), episodes))
        at = after[at, chosen[-1]]
    states, chosen = np.stack([*states, at], axis=1), np.stack(chosen, axis=1)
    last = np.repeat(np.arange(episodes) * length + length - 1, length)
    flat = lambda index: observations[index].reshape(-1, observations.shape[1])  # noqa: E731
    return device_data(
        flat(states[:, :-1]), actions[chosen].reshape(-1, 1 if actions.ndim == 1 else 2), flat(states[:, 1:]), last=last
    )


def looks(learner, params, observations):
    """Steps from state to state by the norms [S, S], and each state's action for the skill towards each other."""

    @jax.jit
    def look(params):
        phi = learner.represent(params, observations)
        norm = jnp.linalg.norm(phi[:, None] - phi[None], axis=-1)
        to = (*norm.shape, observations.shape[1])
        start, end = jnp.broadcast_to(observations[:, None], to), jnp.broadcast_to(observations[None], to)
        return norm, learner.act(params, start, learner.direction(params, start, end))

    norm, action = look(params)
    # (1 - g^d) / (1 - g) is what d steps of reward -1 cost.
    return np.log(np.clip(1 - (1 - DISCOUNT) * np.asarray(norm), 1e-3, None)) / np.log(DISCOUNT), np.asarray(action)


@pytest.mark.slow
def test_norms_are_shortest_paths_and_skills_follow_them():
    # A corridor in the shape of a U: its ends are 2 apart through the wall, 10 on foot.
    cells = [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 4), (2, 4), (2, 3), (2, 2), (2, 1), (2, 0)]
    places = np.array(cells, float)
    steps = np.abs(np.subtract.outer(np.arange(11), np.arange(11)))
    after = np.clip(np.arange(11)[:, None] + np.array([-1, 1]), 0, 10)
    observations = (places - places.mean(axis=0)) / places.std(axis=0)
    data = walks(after, observations, np.array([-1.0, 1.0]), episodes=100, length=20)
    learner = Hilbert(2, 1, 2, HilbertConfig(hidden=(32, 32), batch_size=128))
    state, _ = train(learner, data, HYPER, 2000)
    distance, action = looks(learner, learner.params(state), jnp.asarray(observations))

    apart = steps > 0
    correlation = np.corrcoef(distance[apart], steps[apart])[0, 1]
    error = np.abs(distance - steps)[apart]
    through_walls = np.linalg.norm(places[:, None] - places[None], axis=-1)
    straight = np.corrcoef(through_walls[apart], steps[apart])[0, 1]
    ahead = (np.sign(action[..., 0]) == np.sign(np.subtract.outer(np.arange(11), np.arange(11)).T))[apart].mean()
    print(f"correlation {correlation:.4f} (straight lines {straight:.2f}), error {error.mean():.2f}, {error.max():.2f}")
    print(f"skills that step towards where they point: {ahead:.3f}")
    assert correlation > 0.99 and straight < 0.6
    # The expectile 0.95 of half good steps overestimates a way by 1 / 0.9 at most.
    assert error.mean() < 0.6 and error.max() < 1.5
    assert ahead > 0.95


@pytest.mark.slow
def test_norms_rank_the_ways_around_walls_of_a_grid():
    """Steps in the plane cannot be embedded without distortion (a square of four cells already cannot)."""
    grid = Gridworld([".....", ".###.", "...#.", ".#.#.", ".#..G"])
    observations = grid.cells - grid.cells.mean(axis=0)
    data = walks(grid.after, observations, MOVES.astype(float), episodes=300, length=40)
    learner = Hilbert(2, 2, 8, HilbertConfig(hidden=(64, 64), batch_size=128))
    state, _ = train(learner, data, HYPER, 5000)
    distance, action = looks(learner, learner.params(state), jnp.asarray(observations))
    steps, apart = grid.distances(), ~np.eye(grid.size, dtype=bool)
    ranks = lambda x: np.argsort(np.argsort(x))  # noqa: E731
    correlation = np.corrcoef(ranks(distance[apart]), ranks(steps[apart]))[0, 1]
    chosen = (action @ MOVES.T).argmax(axis=-1)
    nearer = steps[grid.after[np.arange(grid.size)[:, None], chosen], np.arange(grid.size)[None]] < steps
    print(f"rank correlation {correlation:.3f}, steps that come nearer {nearer[apart].mean():.3f}")
    assert correlation > 0.9 and nearer[apart].mean() > 0.75


def test_goals_lie_ahead_in_the_episode_or_anywhere():
    data = device_data(np.zeros((60, 1)), np.zeros((60, 1)), last=np.repeat(np.arange(20, 61, 20) - 1, 20))

    @jax.jit
    def draw(rows, key, random_share):
        return goal_rows(data, rows, key, 0.5, random_share)

    ahead = np.asarray(draw(jnp.full(4000, 25), jax.random.key(0), 0.0))
    assert ahead.min() == 26 and ahead.max() <= 39
    # Geometric with p = 1/2: k steps ahead with probability 2^-k.
    np.testing.assert_allclose([(ahead == 25 + k).mean() for k in (1, 2, 3)], [0.5, 0.25, 0.125], atol=0.03)
    assert (np.asarray(draw(jnp.full(4000, 39), jax.random.key(1), 0.0)) == 39).all()
    anywhere = np.asarray(draw(jnp.full(4000, 25), jax.random.key(2), 1.0))
    np.testing.assert_allclose(np.histogram(anywhere, [0, 20, 40, 60])[0] / 4000, 1 / 3, atol=0.04)


def test_the_losses_by_hand():
    """phi is the identity of the line: a network without hidden layers, so that every number can be worked out."""
    learner = Hilbert(1, 1, 1, HilbertConfig(hidden=(), batch_size=1))
    identity = {"params": {"Dense_0": {"kernel": jnp.ones((2, 1, 1)), "bias": jnp.zeros((2, 1))}}}
    hyper = HilbertHyper(1e-3, 0.9, 0.9, 0.5, 0.005, 10.0)

    @jax.jit
    def look(after, reached):
        batch = GoalBatch(jnp.zeros((1, 1)), jnp.ones((1, 1)), jnp.full((1, 1), after), jnp.full((1, 1), 4.0), reached)
        seen = learner.skill_batch(identity, batch, jnp.array([[-1.0]]), 0.5)
        direction = learner.direction({"phi": identity}, jnp.array([3.0]), jnp.array([after]))
        return learner.distance_loss(identity, identity, batch, hyper), seen, direction

    # From 0 to 1 on the way to 4: target -1 - 0.5 * 3 = -2.5 against V = -4, advantage 1.5, error 1.5 of both heads.
    loss, seen, direction = look(1.0, jnp.zeros(1))
    assert float(loss) == pytest.approx(2 * 0.9 * 1.5**2)
    assert float(seen.reward[0]) == -1 and float(seen.discount[0]) == 0.5 and float(direction[0]) == -1
    np.testing.assert_array_equal(seen.observation, [[0.0, -1.0]])
    np.testing.assert_array_equal(seen.next_observation, [[1.0, -1.0]])
    # From 0 to -4: target -1 - 0.5 * 8 = -5, advantage -1, so that the weight is 0.1.
    assert float(look(-4.0, jnp.zeros(1))[0]) == pytest.approx(2 * 0.1 * 1)
    # There already: target 0.
    assert float(look(1.0, jnp.ones(1))[0]) == pytest.approx(2 * 0.9 * 16)
