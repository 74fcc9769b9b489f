"""The term on outcomes within the skill phase: it goes on exactly, and learns nothing from simulations that broke."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qdos_brax import config as configs
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import DeviceData, to_device
from qdos_brax.runs.checkpoint import CheckpointStore, Position
from qdos_brax.skills.forward_model import ForwardModel, step_scale
from qdos_brax.skills.information import PhysicsRollout
from qdos_brax.skills.information_terms import Rollout
from qdos_brax.skills.outcome_term import OutcomeTerm
from qdos_brax.skills.outcomes import fit_outcomes, seen_paths
from qdos_brax.skills.segment_weights import UniformWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import Segments, SkillModel
from tests.point import STEP, Point, PointEnv, bound, point_config


class LeggedPoint(PointEnv):
    """The point with two legs: actions 2 and 3 move them, seen as numbers 2 and 3, and lead nowhere."""

    observation_size = 4
    action_size = 4

    def step(self, state: Any, action: jax.Array) -> Any:
        position = state.pipeline_state.qpos[:2] + STEP * jnp.clip(action[:2], -1, 1)
        qpos = jnp.concatenate([position, action[2:]])
        return state.replace(pipeline_state=Point(qpos, state.pipeline_state.qvel), obs=qpos)


def legged_data(episodes: int = 100, length: int = 30) -> Dataset:
    """Walks in directions of every kind, which the data holds for a matter of course; legs move as they like."""
    rng = np.random.default_rng(0)
    actions = np.clip(rng.normal(size=(episodes, length, 4)) * [0.15, 0.15, 0.5, 0.5], -1, 1).astype(np.float32)
    actions[..., 0] += 0.3
    start = rng.uniform(-1, 1, (episodes, 1, 2))
    position = np.concatenate([start, start + STEP * np.cumsum(actions[..., :2], axis=1)], axis=1)
    legs = np.concatenate([np.zeros((episodes, 1, 2)), actions[..., 2:]], axis=1)
    seen = np.concatenate([position, legs], axis=-1).astype(np.float32)
    ends = np.zeros((episodes, length), bool)
    ends[:, -1] = True
    before, after = seen[:, :-1].reshape(-1, 4), seen[:, 1:].reshape(-1, 4)
    n = episodes * length
    return Dataset(
        observations=before,
        actions=actions.reshape(-1, 4),
        rewards=np.full(n, -1, np.float32),
        masks=np.ones(n, np.float32),
        ends=ends.reshape(-1),
        next_observations=after,
        qpos=before,
        qvel=np.zeros((n, 2), np.float32),
        source="the legged point",
    )


def make_phase() -> tuple[SkillPhase, SkillModel, DeviceData, OutcomeTerm]:
    """The skill phase on the legged point, and what it consists of."""
    settings = {"skills.horizon": 5, "skills.mi_batch": 16, "skills.learning_rate": 2e-3, "skills.mi_latent": "played"}
    settings |= {"skills.mi_encoder": "outcome"}
    config = configs.replace(point_config(**settings), **{"seed": (0, 1)})
    env = LeggedPoint()
    data, normaliser = to_device(legged_data(), config.skills.horizon)
    model = SkillModel(4, 4, replace(config.skills, latent_dim=2))
    source = PhysicsRollout(env, model, normaliser, config.skills.horizon)
    seen = seen_paths(model, {}, data, config.skills.horizon)
    forward = ForwardModel(step_scale(seen), 4, (32, 32))
    term = OutcomeTerm(model, source, fit_outcomes(seen), forward, (32, 32), 16, config.skills.horizon)
    phase = SkillPhase(config, model, UniformWeights(), term, blocks_per_chunk=2)
    return bound(phase, config, data), model, data, term


def begin(phase: SkillPhase) -> tuple[Any, Any]:
    return phase.init(jax.vmap(jax.random.key)(np.array([0, 1], np.uint32)), {})


def test_a_run_with_outcomes_goes_on_exactly_and_its_members_differ(tmp_path: Path) -> None:
    phase, *_ = make_phase()
    state, constants = begin(phase)
    state, _ = phase.chunk(state, constants)
    store = CheckpointStore(tmp_path, "0" * 16)
    position = Position(phase=0, chunk=1, rows=0, columns=(), wall_seconds={})
    store.save(position, state)
    restored = store.restore(store.newest_first()[0], state)
    whole, metrics = phase.chunk(state, constants)
    again, _ = phase.chunk(restored, constants)
    for a, b in zip(jax.tree.leaves(whole.replace(key=0)), jax.tree.leaves(again.replace(key=0)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(*whole.information.memory.place)
    assert np.all(np.isfinite([metrics["outcome_loss"], metrics["forward_model_loss"]]))


def test_nothing_is_learned_from_simulations_that_broke_and_the_oldest_batch_is_forgotten() -> None:
    _, model, data, term = make_phase()
    params = model.init(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 20)
    rows = data.starts[:32, None] + jnp.arange(5)
    segments = Segments(data.observations[rows], data.actions[rows])

    def rollout(number: int, broken: float) -> Rollout:
        latent = jax.random.normal(keys[number], (16, 2))
        observations = jax.random.normal(keys[number], (16, 6, 4))
        weight = jnp.ones(16).at[3:].set(0.0)
        return Rollout(observations.at[3:].mul(broken), latent, latent.at[3:].mul(broken), weight)

    receive, learn = jax.jit(term.receive), jax.jit(term.learn)
    learned, losses = [], []
    for broken in (0.0, 100.0):
        state, played = receive(term.init(jax.random.key(2)), params, rollout(0, broken))
        losses.append(term.loss(params, state, played, keys[0]))
        learned.append(learn(state, params, segments, keys[1])[0].params)
    assert losses[0] == losses[1] > 0
    jax.tree.map(np.testing.assert_array_equal, *learned)
    state = term.init(jax.random.key(2))
    for number in range(17):
        state, _ = receive(state, params, rollout(number, 1.0))
    remembered = np.asarray(state.memory.latent).reshape(16, 16, 2)
    expected = [rollout(number, 1.0).latent for number in (16, *range(1, 16))]
    np.testing.assert_array_equal(remembered, expected)
