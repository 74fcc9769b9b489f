"""The mutual-information term on outcomes, against closed forms and a task in which half of an action does nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.config import Config
from qdos_brax.data.device import to_device
from qdos_brax.errors import UserError
from qdos_brax.skills.forward_model import ForwardModel, step_scale
from qdos_brax.skills.information import PhysicsRollout
from qdos_brax.skills.information_terms import InformationTerm, Rollout, SegmentTerm
from qdos_brax.skills.outcome_term import OutcomeTerm
from qdos_brax.skills.outcomes import fit_outcomes, seen_paths
from qdos_brax.skills.segment_weights import UniformWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import SkillModel
from tests.point import PointEnv, bound, first_member, point_config, point_dataset

STEPS = 4
DRIFT = np.array([[0.9, 0.2], [0.0, 0.8]])  # s' = DRIFT s + PUSH a
PUSH = np.array([[0.5], [1.0]])
FEEDBACK = np.array([[0.3, -0.1]])


def linear_model() -> tuple[ForwardModel, Any]:
    """Return a model without hidden layers, made to be the linear system."""
    scale = np.array([2.0, 0.5])
    model = ForwardModel(jnp.asarray(scale, jnp.float32), 1, ())
    kernel = np.concatenate([DRIFT - np.eye(2), PUSH], axis=1) / scale[:, None]
    params = model.init(jax.random.key(0))
    return model, jax.tree.map(lambda leaf: jnp.asarray(kernel.T, jnp.float32) if leaf.ndim == 2 else 0 * leaf, params)


def test_the_gradient_of_an_outcome_is_that_of_the_linear_system_along_the_real_states() -> None:
    """Actions FEEDBACK s + theta: d s_H / d theta is sum_k (DRIFT + PUSH FEEDBACK)^k PUSH, wherever the rollout led."""
    model, params = linear_model()
    seen = jax.random.normal(jax.random.key(1), (3, STEPS + 1, 2))  # of another, unknown system
    actions = seen[:, :-1] @ FEEDBACK.T

    def end(theta: jax.Array) -> jax.Array:
        return model.follow(params, seen, actions, lambda x: x @ FEEDBACK.T + theta)

    closed = DRIFT + PUSH @ FEEDBACK
    expected = sum(np.linalg.matrix_power(closed, k) @ PUSH for k in range(STEPS))
    np.testing.assert_allclose(end(jnp.zeros(1)), seen[:, -1], atol=1e-5)
    np.testing.assert_allclose(jax.jacobian(end)(jnp.zeros(1)), np.tile(expected, (3, 1, 1)), rtol=1e-4)


def test_slow_features_are_kept_and_count_by_their_change() -> None:
    """A drift of 0.5 +- 0.1 a step beside noise: one feature, whose root mean square change is 1."""
    rng = np.random.default_rng(0)
    drift = np.cumsum(rng.choice([-0.5, 0.5], (500, 1)) + 0.1 * rng.normal(size=(500, 11)), axis=1)
    seen = np.stack([drift, rng.normal(size=drift.shape)], axis=-1)
    outcomes = fit_outcomes(seen)
    assert outcomes.directions.shape == (2, 1)
    change = np.asarray(outcomes.between(seen[:, 0], seen[:, -1]))[:, 0]
    assert np.sqrt(np.mean(change**2)) == pytest.approx(1.0, rel=1e-3)
    truth = drift[:, -1] - drift[:, 0]
    assert abs(np.corrcoef(change, truth)[0, 1]) > 0.99
    np.testing.assert_allclose(step_scale(seen)[1], np.sqrt(2), rtol=0.05)  # of independent draws of variance 1


class HalfEnv(PointEnv):
    """A point that moves along x alone: the second half of an action does nothing."""

    def step(self, state: Any, action: jax.Array) -> Any:
        return super().step(state, action * jnp.array([1.0, 0.0]))


SIZES = {"encoder_hidden": 16, "encoder_layers": 1, "decoder_hidden": (32,), "prior_hidden": (32,)}


def outcome_term(config: Config, model: SkillModel, data: Any, normaliser: Any, hidden: tuple[int, ...]) -> OutcomeTerm:
    horizon = config.skills.horizon
    source, seen = PhysicsRollout(HalfEnv(), model, normaliser, horizon), seen_paths(model, {}, data, horizon)
    forward = ForwardModel(step_scale(seen), model.action_dim, hidden)
    return OutcomeTerm(model, source, fit_outcomes(seen), forward, (32,), config.skills.mi_batch, horizon)


def test_what_changes_nothing_cannot_tell_skills_apart_as_it_can_in_the_papers_term() -> None:
    config = point_config(**{"skills.latent_dim": 1})
    model = SkillModel(2, 2, replace(config.skills, **SIZES))
    data, normaliser = to_device(point_dataset(), config.skills.horizon)
    term = outcome_term(config, model, data, normaliser, ())
    params, state = model.init(jax.random.key(0)), term.init(jax.random.key(1))
    # What a model of this task comes to: the second half of an action does nothing.
    blind = jnp.array([1.0, 1.0, 1.0, 0.0])[:, None]
    forward = jax.tree.map(lambda leaf: leaf * blind if leaf.ndim == 2 else leaf, state.params["model"])
    state = state.replace(params=state.params | {"model": forward})
    batch, horizon = config.skills.mi_batch, config.skills.horizon
    latent = jax.random.normal(jax.random.key(2), (batch, 1))
    observations = jax.random.normal(jax.random.key(3), (batch, horizon + 1, 2))
    rollout = Rollout(observations, latent, latent, jnp.ones(batch))

    def gradient(term: InformationTerm, state: Any) -> np.ndarray:
        """Return the loss's gradient by the bias of the two mean actions."""
        state, played = term.receive(state, params, rollout)
        grads = jax.grad(term.loss)(params, state, played, jax.random.key(4))
        return next(np.asarray(leaf)[:2] for leaf in jax.tree.leaves(grads["decoder"]) if leaf.shape == (4,))

    by_outcome = gradient(term, state)
    by_segment = gradient(SegmentTerm(model, term.source), {})
    assert abs(by_outcome[0]) > 1e-4 and by_outcome[1] == 0
    assert (abs(by_segment) > 1e-4).all()


@pytest.mark.slow
def test_skills_come_to_differ_in_what_happens_though_the_data_does_not() -> None:
    """All walks of the data go 0.45 along x, with a deviation of 0.011; skills come to deviate by 0.14."""
    values = {"skills.updates": 400, "skills.learning_rate": 2e-3, "skills.alpha": 3.0, "skills.mi_encoder": "outcome"}
    config = point_config(**values, **{"skills.latent_dim": 1, "skills.mi_every": 10, "skills.mi_batch": 32})
    model = SkillModel(2, 2, replace(config.skills, **SIZES))
    data, normaliser = to_device(point_dataset(spread=0.0), config.skills.horizon)
    term = outcome_term(config, model, data, normaliser, (32,))
    phase = bound(SkillPhase(config, model, UniformWeights(), term), config, data)
    state, constants = phase.init(jax.random.split(jax.random.key(0), 1), {})
    for _ in range(phase.num_chunks):
        state, metrics = phase.chunk(state, constants)
    assert metrics["status_ok"].all()
    latent, starts = jnp.linspace(-2, 2, 21)[:, None], jnp.full(21, data.starts[0])
    observations = term.source(first_member(state.params), data, starts, latent)
    assert np.std(np.asarray(normaliser.restored(observations))[:, -1, 0]) > 0.08


def test_outcomes_need_a_simulator_and_a_view_of_the_way() -> None:
    for other, what in (
        ({"mi_rollout": "logged"}, "needs skills.mi_rollout=physics"),
        ({"view": "body"}, "needs skills.view=start"),
    ):
        with pytest.raises(UserError, match=what):
            point_config(**{"skills.mi_encoder": "outcome"}, **{f"skills.{key}": value for key, value in other.items()})
