"""The search for a motion, with a goal whose best candidate is known, and what the real goals ask for."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.mazes import models
from envs.physics.base import PipelineState
from envs.physics.mujoco.engine import MujocoEngine
from qdos_brax.collection.experts import rising, train_motions
from qdos_brax.collection.experts.evolution import Evolution
from qdos_brax.collection.experts.motion_goals import Crouch, Score, Turn
from qdos_brax.collection.experts.rising import Motion
from qdos_brax.collection.experts.symmetry import mirrored_action
from qdos_brax.collection.experts.train_motions import MotionSearch, read_search
from qdos_brax.errors import UserError


class Statue:
    """The physics: a body that lies on its back, whatever it does."""

    nv = 27

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PipelineState:
        lying = qpos.at[3:7].set(jnp.array([1.0, 0.0, -1.0, 0.0]) / jnp.sqrt(2.0)).at[2].set(0.1)
        return PipelineState(lying, 0 * qvel, jnp.zeros(0), jnp.zeros(0, jnp.int32), (), jnp.zeros((), jnp.int32))

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        return state


class Nearing:
    """Score: how near the candidate is to BEST, which no body changes."""

    BEST = (0.5, -0.3)

    name, stage, size, engine = "crouch", rising.CROUCHES, 2, Statue()

    def guess(self) -> np.ndarray:
        return np.zeros(2)

    def motion(self, candidate: jax.Array) -> Motion:
        return Motion(jnp.zeros((1, 21)).at[0, :2].set(candidate), jnp.ones(1))

    def score(self, candidates: jax.Array, qpos: jax.Array, qvel: jax.Array, noise: jax.Array, key: jax.Array) -> Score:
        assert qpos.shape == (3, 28) and qvel.shape == (3, 27)
        value = -jnp.sum((candidates - jnp.array(self.BEST)) ** 2, axis=1)
        value = jnp.broadcast_to(value[:, None], (len(candidates), 3))
        return Score(value, value > -0.01)


def search(folder: Path) -> MotionSearch:
    folder.mkdir(exist_ok=True)
    goal, evolution = Nearing(), Evolution(2, population=6, seed=1)
    return MotionSearch(goal, rising.humanoid_motions(), folder, evolution, 3, 0.1, evolution.begin(goal.guess(), 0.3))


def test_a_search_finds_the_best_and_goes_on_exactly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train_motions, "STARTS", 4)
    whole, first = search(tmp_path / "whole"), search(tmp_path / "parts")
    whole.run(40)
    np.testing.assert_allclose(whole.search.mean, Nearing.BEST, atol=1e-3)
    first.run(15)
    second = search(tmp_path / "parts")
    assert second.search.generation == 15 and len(second.rows) == 3
    second.run(40)
    for a, b in zip(whole.search, second.search, strict=True):
        np.testing.assert_array_equal(a, b)
    curve = (tmp_path / "parts" / "crouch.csv").read_text().splitlines()
    assert len(curve) == 1 + 8 and curve[0].startswith("generation,score,best,reached")
    with pytest.raises(UserError, match="a search over 2 numbers, not 5"):
        read_search(tmp_path / "parts" / "crouch-search.npz", 5)
    with pytest.raises(UserError, match="cannot read the search"):
        read_search(tmp_path / "none.npz", 2)


@cache
def engine() -> MujocoEngine:
    return MujocoEngine(models.humanoid_model(), threads=1)


def test_a_crouch_is_its_own_mirror_image() -> None:
    goal = Crouch(engine())
    poses, seconds = goal.motion(jnp.asarray(np.random.default_rng(0).normal(size=goal.size), jnp.float32))
    np.testing.assert_allclose(jax.vmap(mirrored_action)(poses), poses, atol=1e-6)
    assert np.abs(poses).max() <= 2.0 and seconds.min() >= 0.35 * np.exp(-1.5) - 1e-6
    first, times = goal.motion(jnp.asarray(goal.guess(), jnp.float32))
    np.testing.assert_allclose(first[1, jnp.array([0, 5, 6, 11, 12])], [-1.3, -1.9, -2.0, -1.9, -2.0], atol=1e-6)
    np.testing.assert_allclose(times, 0.35)


def test_a_turn_scores_by_how_the_body_lies() -> None:
    half = np.sqrt(0.5)
    goal = Turn(Statue())
    qpos = jnp.zeros((1, 28)).at[:, 3:7].set(jnp.array([half, 0, half, 0]))
    score = goal.score(jnp.zeros((2, goal.size)), qpos, jnp.zeros((1, 27)), jnp.zeros((1, 1)), jax.random.key(0))
    np.testing.assert_allclose(score.value, np.full((2, 1), 0.95 * 1.6), atol=1e-5)  # on its back all the time
    assert score.reached.all()
