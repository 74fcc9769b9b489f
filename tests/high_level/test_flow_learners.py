"""Q-chunking's and FQL's learners: losses and choices by hand, and tasks whose answer is known."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.config import FlowConfig, HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.best_of_n import BestOfN
from qdos_brax.high_level.distilled_flow import DistilledFlow
from qdos_brax.high_level.q_function import QFunction, QHyper, q_hyper
from qdos_brax.high_level.warm_up import OfflineWarmUp, RandomWarmUp
from qdos_brax.offline.actor_critic import OfflineActorCritic
from tests.offline.gridworld import MOVES, Gridworld, device_data
from tests.offline.training import train

SMALL = HighLevelConfig(hidden=(8,), ensemble=2, target_subset=1)
FLOW = FlowConfig(hidden=(8,), steps=4, candidates=5)
HYPER = {
    "high_level.learning_rate": 1e-3,
    "high_level.discount": 0.9,
    "high_level.target_rate": 0.01,
    "flow.distillation": 1.0,
}


def constant(params: Any, *values: float) -> Any:
    """Critics that give ``values``, whatever they see."""
    params = jax.tree.map(jnp.zeros_like, params)
    last = max(name for name in params["params"]["VmapMLP_0"] if name.startswith("Dense"))
    params["params"]["VmapMLP_0"][last]["bias"] += jnp.array(values)[:, None]
    return params


@pytest.mark.parametrize(("target", "bootstrap"), [("mean", 2.0), ("min", 1.0)])
def test_the_critics_target_by_hand(target: str, bootstrap: float) -> None:
    q = QFunction(3, 2, SMALL, target)
    state = q.init(jax.random.key(0))
    state = state.replace(critic=constant(state.critic, 0.0, 4.0), target_critic=constant(state.critic, 1.0, 3.0))
    blank = jnp.zeros((2, 3))
    batch = Transition(blank, jnp.zeros((2, 2)), jnp.array([-1.0, -2.0]), jnp.array([1.0, 0.0]), blank)
    after, info = q.update(state, batch, jnp.zeros((2, 2)), QHyper(1e-3, 0.5, 0.1))
    wanted = np.array([-1 + 0.5 * bootstrap, -2.0])  # the second transition ends
    np.testing.assert_allclose(info["critic_loss"], np.mean([(0 - wanted) ** 2, (4 - wanted) ** 2]), rtol=1e-5)
    np.testing.assert_allclose(q.value(state.critic, blank, jnp.zeros((2, 2))), [{"mean": 2, "min": 0}[target]] * 2)
    # Adam's first step moves every bias by the learning rate; the targets follow a tenth of the way.
    moved = np.asarray(q.values(after.critic, blank[:1], jnp.zeros((1, 2)))[:, 0])
    np.testing.assert_allclose(moved, [0.0 - 1e-3, 4.0 - 1e-3], atol=1e-5)
    targets = np.asarray(q.values(after.target_critic, blank[:1], jnp.zeros((1, 2)))[:, 0])
    np.testing.assert_allclose(targets, [1 - 0.1 * 1.001, 3 + 0.1 * 0.999], atol=1e-4)


def test_the_discount_is_that_of_all_steps_of_a_chunk() -> None:
    assert q_hyper({**HYPER, "high_level.discount": 0.9}, 5).discount == pytest.approx(0.59049)


class Parabola:
    """Stands for critics whose values are -(a - 0.5)^2, summed over the action."""

    def value(self, critic: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        return -jnp.sum((action - 0.5) ** 2, axis=-1)


def test_the_best_of_n_is_the_proposal_of_highest_value() -> None:
    learner = BestOfN(3, 2, SMALL, FLOW, 1)
    learner.q = Parabola()  # type: ignore[assignment]
    state = BestOfN(3, 2, SMALL, FLOW, 1).start(jax.random.key(0), HYPER)
    actor = {"flow": jax.tree.map(jnp.zeros_like, state.flow), "critic": {}}  # proposals are the noise, clipped
    noise = jax.random.normal(jax.random.key(1), (5, 7, 2))
    chosen = learner.choose(actor, noise, jnp.zeros((7, 3)))
    proposals = np.clip(noise, -1, 1)
    best = ((proposals - 0.5) ** 2).sum(axis=-1).argmin(axis=0)
    np.testing.assert_array_equal(chosen, proposals[best, np.arange(7)])
    observation = jax.random.normal(jax.random.key(2), (7, 3))
    mode = learner.mode(actor, observation)
    np.testing.assert_array_equal(mode[3], learner.mode(actor, observation[3]))  # of the state alone
    assert len(np.unique(np.asarray(mode), axis=0)) == 7


def test_the_actors_loss_is_its_three_parts() -> None:
    learner = DistilledFlow(3, 2, SMALL, FLOW, 1)
    state = learner.start(jax.random.key(0), HYPER)
    zero = jax.tree.map(jnp.zeros_like, state.actor)
    zero["one_step"]["params"]["Dense_1"]["bias"] += jnp.array([0.5, 2.0])
    batch = Transition(jnp.zeros((1, 3)), jnp.full((1, 2), 0.25), jnp.zeros(1), jnp.zeros(1), jnp.zeros((1, 3)))
    # A flow of velocity 0 leaves noise as it is, clipped: distances to (0.5, 2.0), which is not clipped itself.
    noise = jnp.array([[0.3, -3.0]])
    distilled = learner.distillation_loss(zero, batch.observation, noise, zero["flow"])
    np.testing.assert_allclose(distilled, ((0.5 - 0.3) ** 2 + (2.0 + 1.0) ** 2) / 2, rtol=1e-5)
    critic = constant(state.q.critic, 1.0, 4.0)
    key = jax.random.key(3)
    total, parts = learner.actor_loss(zero, critic, batch, key, 10.0)
    np.testing.assert_allclose(total, parts["flow_loss"] + 10 * parts["distillation_loss"] - 2.5, rtol=1e-5)
    np.testing.assert_allclose(learner.play(zero, batch.observation, noise), [[0.5, 1.0]])
    start = jax.random.normal(jax.random.split(jax.random.split(key)[0])[0], (1, 2))
    np.testing.assert_allclose(parts["flow_loss"], jnp.mean((0.25 - start) ** 2), rtol=1e-5)
    # Q reaches the one-step policy alone, and the flow learns from the data alone.
    grads = jax.grad(lambda actor: learner.actor_loss(actor, critic, batch, key, 10.0)[0])(state.actor)
    cloned = jax.grad(lambda flow: learner.flow.loss(flow, batch.observation, batch.action, jax.random.split(key)[0]))
    for ours, theirs in zip(jax.tree.leaves(grads["flow"]), jax.tree.leaves(cloned(state.actor["flow"])), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_warm_ups() -> None:
    first, own = jnp.zeros(2), jnp.ones(2)
    for warm_up, played, learns in (
        (RandomWarmUp(10), [0, 0, 1], [True, True, True]),
        (OfflineWarmUp(10), [1, 1, 1], [False, False, True]),
    ):
        steps = [jnp.asarray(step) for step in (0, 9, 11)]
        assert [int(warm_up.action(step, first, own)[0]) for step in steps] == played
        assert [bool(warm_up.learns(step)) for step in steps] == learns


def learner_of(kind: type, observation_dim: int, **flow: Any) -> Any:
    config = HighLevelConfig(hidden=(64, 64), ensemble=2, target_subset=1)
    sizes = FlowConfig(**{"hidden": (64, 64), "steps": 5, "candidates": 16, **flow})
    return kind(observation_dim, 2, config, sizes, 1)


def trained_on_two_modes(kind: type) -> tuple[Any, Any]:
    """Actions near (0.6, 0), seven of ten, and (-0.6, 0); the reward is -a_1, so that the rarer mode is better."""
    rng = np.random.default_rng(0)
    modes = np.where(rng.random(4000) < 0.7, 0.6, -0.6)
    actions = np.stack([modes, np.zeros(4000)], axis=-1) + 0.05 * rng.normal(size=(4000, 2))
    data = device_data(np.ones((4000, 1)), actions, rewards=-actions[:, 0], masks=np.zeros(4000))
    learner = learner_of(kind, 1)
    hyper = {**HYPER, "high_level.learning_rate": 2e-3, "flow.distillation": 10.0}
    return learner, train(OfflineActorCritic(learner, 1, 256), data, hyper, 2000)[0]


@pytest.mark.slow
def test_the_best_of_n_keeps_to_the_better_of_two_modes() -> None:
    """Though the reward would go on growing where the data has no action."""
    learner, state = trained_on_two_modes(BestOfN)
    keys = jax.random.split(jax.random.key(1), 500)
    act = jax.jit(jax.vmap(lambda key: learner.act(learner.actor_params(state), key, jnp.ones(1))))
    chosen = np.asarray(act(keys))
    print(chosen.mean(axis=0), chosen.std(axis=0))
    assert abs(np.median(chosen[:, 0]) + 0.65) < 0.12 and abs(np.median(chosen[:, 1])) < 0.12


@pytest.mark.slow
def test_the_distilled_policy_is_as_far_from_the_flow_as_its_loss_says() -> None:
    """With Q = -a_1 the minimum of alpha / 2 |a - f|^2 + a_1 over the two dimensions is a = f - (1 / alpha, 0)."""
    learner, state = trained_on_two_modes(DistilledFlow)
    noise, seen = jax.random.normal(jax.random.key(1), (500, 2)), jnp.ones((500, 1))
    apart = np.asarray(learner.play(state.actor, seen, noise) - learner.flow.play(state.actor["flow"], seen, noise))
    print(np.median(apart, axis=0), np.std(apart, axis=0))
    np.testing.assert_allclose(np.median(apart, axis=0), [-0.1, 0.0], atol=0.04)


@pytest.mark.slow
def test_the_best_of_n_takes_shortest_ways_through_the_grid() -> None:
    grid = Gridworld(["....", ".##.", "..#.", "..#G"])
    learner = learner_of(BestOfN, grid.size)
    hyper = {**HYPER, "high_level.learning_rate": 2e-3, "high_level.target_rate": 0.05}
    state, _ = train(OfflineActorCritic(learner, 1, 128), grid.data(), hyper, 4000)
    actor = learner.actor_params(state)
    mode = np.asarray(jax.jit(learner.mode)(actor, jnp.eye(grid.size)))
    chosen = (mode @ MOVES.T).argmax(axis=1)
    distance = grid.distances()[:, grid.goal]
    others = [s for s in range(grid.size) if s != grid.goal]
    wrong = [s for s in others if distance[grid.after[s, chosen[s]]] != distance[s] - 1]
    assert not wrong
