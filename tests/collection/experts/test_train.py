"""The trainer on a point that shall go along the direction, whose best action is known."""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.physics.base import PipelineState
from qdos_brax.collection.experts import symmetry, weights
from qdos_brax.collection.experts.policies import humanoid_view
from qdos_brax.collection.experts.poses import humanoid_is_up
from qdos_brax.collection.experts.tasks import TASKS, HumanoidRising, HumanoidWalking
from qdos_brax.collection.experts.tasks.base import EnvState, StepResult
from qdos_brax.collection.experts.train import Training, main, read_learner
from qdos_brax.collection.experts.trainer import Sizes, Trainer
from qdos_brax.collection.experts.views import forward_axis, random_direction, to_direction_frame, to_world_frame
from qdos_brax.data.transitions import Transition
from qdos_brax.errors import UserError, guarded
from qdos_brax.nn.vectors import unit_vector

SIZES = Sizes(
    num_envs=8,
    updates_per_step=8,
    batch_size=64,
    hidden=(64, 64),
    capacity=2000,
    random_steps=400,
    steps_per_chunk=25,
    average_rate=0.02,
)


class Point:
    """The physics: a point that goes 0.1 m along its action."""

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PipelineState:
        return PipelineState(qpos, qvel, jnp.zeros(0), jnp.zeros(0, jnp.int32), (), jnp.zeros((), jnp.int32))

    def step(self, state: PipelineState, action: jax.Array) -> PipelineState:
        return state.replace(qpos=state.qpos + 0.1 * action)


class Going:
    """Reward: nearness of the turned action to BEST, which so is the best action everywhere."""

    BEST = (0.5, -0.3)

    name = "point"
    observation_dim, action_dim = 2, 2
    discount, episode_steps, direction_steps, action_noise = 0.5, 20, 10, 0.0
    engine = Point()

    def reset(self, key: jax.Array) -> EnvState:
        return EnvState(self.engine.init(jnp.zeros(2), jnp.zeros(2)), random_direction(key), jnp.zeros((), jnp.int32))

    def observe(self, state: EnvState) -> jax.Array:
        return to_direction_frame(state.pipeline.qpos, state.direction)

    def mirror(self, batch: Transition) -> Transition:
        return batch

    def torques(self, state: EnvState, action: jax.Array) -> jax.Array:
        return to_world_frame(action, state.direction)

    def evaluate_step(self, before: EnvState, torques: jax.Array, after: PipelineState) -> StepResult:
        way = to_direction_frame(after.qpos - before.pipeline.qpos, before.direction)
        reward = 1.0 - 4.0 * jnp.sum((10.0 * way - jnp.array(self.BEST)) ** 2)
        return StepResult(reward, jnp.abs(after.qpos).max() < 1.5, jnp.zeros((), bool), {"speed": way[0]})


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    """One for all tests: its programs are compiled once."""
    return Trainer(Going(), SIZES)


def training(trainer: Trainer, folder: Path, seed: int = 0, learner: Path | None = None) -> Training:
    return Training(trainer, folder, seed, learner, chunks_per_save=2)


def leaves(run: Training) -> list[np.ndarray]:
    typed_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return [np.asarray(jax.random.key_data(x) if typed_key(x) else x) for x in jax.tree.leaves(run.state)]


def test_it_learns_the_best_action_and_keeps_the_weights(trainer: Trainer, tmp_path: Path) -> None:
    run = training(trainer, tmp_path)
    run.run(4000, "a command")
    actor = weights.read_actor(tmp_path / "point.npz")
    starts = jax.vmap(Going().reset)(jax.random.split(jax.random.key(5), 50))
    action = actor.mode(jax.vmap(Going().observe)(starts))
    np.testing.assert_allclose(action, np.tile(Going.BEST, (50, 1)), atol=0.1)
    assert actor.header["command"] == "a command" and actor.header["steps"] == 4000
    np.testing.assert_allclose(actor.header["speed"], 0.05, atol=0.01)
    curve = (tmp_path / "point.csv").read_text().splitlines()
    assert len(curve) == 1 + 10 and curve[-1].startswith("4000,")


def test_a_training_that_was_stopped_goes_on_exactly(trainer: Trainer, tmp_path: Path) -> None:
    whole, first = training(trainer, tmp_path / "whole"), training(trainer, tmp_path / "parts")
    whole.run(1200)
    first.run(800)
    second = training(trainer, tmp_path / "parts")
    assert second.chunks_done == 4
    second.run(1200)
    for a, b in zip(leaves(whole), leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)
    without_seconds = lambda row: {k: v for k, v in row.items() if k != "seconds"}  # noqa: E731
    assert list(map(without_seconds, whole.rows)) == list(map(without_seconds, second.rows))
    fresh, other = leaves(training(trainer, tmp_path / "fresh")), leaves(training(trainer, tmp_path / "other", seed=1))
    assert not np.array_equal(fresh[1], other[1])  # weights of the first layer; its biases begin at zero


@pytest.mark.slow
def test_a_learner_goes_on_with_an_empty_replay(trainer: Trainer, tmp_path: Path) -> None:
    run = training(trainer, tmp_path / "first")
    run.run(600)
    kept = tmp_path / "first" / "point-learner.npz"
    onward = training(trainer, tmp_path / "second", learner=kept)
    for a, b in zip(jax.tree.leaves(run.state.sac), jax.tree.leaves(onward.state.sac), strict=True):
        np.testing.assert_array_equal(a, b)
    assert int(onward.state.replay.size) == 0
    onward.run(600)
    assert int(onward.state.replay.size) == 600
    wider = Trainer(Going(), Sizes(hidden=(16,)))
    with pytest.raises(UserError, match="other sizes"):
        read_learner(kept, wider)
    with pytest.raises(UserError, match="cannot read the learner"):
        read_learner(tmp_path / "none.npz", wider)


def test_rewards_of_the_dribble_by_hand() -> None:
    task = TASKS["ant_dribbler"]()
    state = task.reset(jax.random.key(0)).replace(direction=jnp.array([0.0, 1.0]))
    qpos = state.pipeline.qpos.at[:3].set(jnp.array([0.0, 0.0, 0.6])).at[3:7].set(jnp.array([1.0, 0, 0, 0]))
    before = state.replace(pipeline=state.pipeline.replace(qpos=qpos.at[15:17].set(jnp.array([0.0, 0.9]))))
    after = state.pipeline.replace(qpos=qpos.at[15:17].set(jnp.array([0.0, 1.0])))
    result = task.evaluate_step(before, jnp.zeros(8), after)
    np.testing.assert_allclose(result.reward, 0.5 + 40 * 0.1 - 0.3 * 0.3 + 0.2, atol=1e-5)
    assert result.alive and not result.truncated
    far = state.pipeline.replace(qpos=qpos.at[15:17].set(jnp.array([0.0, 5.1])).at[2].set(0.1))
    result = task.evaluate_step(before, jnp.zeros(8), far)
    assert result.truncated and not result.alive


@pytest.fixture(scope="module")
def walking() -> HumanoidWalking:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HumanoidWalking, "RISEN", 8)
        return HumanoidWalking()


def test_rewards_of_the_humanoid_by_hand(walking: HumanoidWalking) -> None:
    state = walking.reset(jax.random.key(0)).replace(direction=jnp.array([0.0, 1.0]))
    yaw = jnp.array([jnp.cos(jnp.pi / 4), 0.0, 0.0, jnp.sin(jnp.pi / 4)])  # faces +y
    qpos = state.pipeline.qpos.at[:2].set(0.0).at[3:7].set(yaw)
    before = state.replace(pipeline=state.pipeline.replace(qpos=qpos))
    after = state.pipeline.replace(qpos=qpos.at[:2].set(jnp.array([0.01, 0.015])))  # 0.025 s: 0.4 m/s aside, 0.6 m/s on
    result = walking.evaluate_step(before, jnp.full(21, 0.5), after)
    np.testing.assert_allclose(result.reward, 1.5 + 0.3 + 0.2 - 0.2 * 0.4 - 0.1 * 0.25, atol=1e-5)
    assert result.alive
    assert not walking.evaluate_step(before, jnp.zeros(21), state.pipeline.replace(qpos=qpos.at[2].set(0.8))).alive


def test_walking_begins_on_its_feet_or_where_it_has_risen(walking: HumanoidWalking) -> None:
    state = jax.jit(jax.vmap(walking.reset))(jax.random.split(jax.random.key(0), 64))
    assert walking._risen.arrived.mean() > 0.8
    rose = np.asarray(jnp.abs(state.pipeline.qpos[:, 7:]).max(axis=1) > 0.05)  # a body set on its feet is straight
    assert 0.25 < rose.mean() < 0.55  # 0.4 of them
    assert humanoid_is_up(state.pipeline.qpos).all()
    aside = jnp.sum(unit_vector(forward_axis(state.pipeline.qpos)[:, :2]) * state.direction, axis=1)
    assert aside[~rose].mean() > 0.7 and aside[rose].min() < -0.5  # it may have risen with its back to its way


def test_a_walker_sees_its_direction_as_it_will_be_led(walking: HumanoidWalking) -> None:
    state = walking.reset(jax.random.key(0))
    qpos = state.pipeline.qpos.at[3:7].set(jnp.array([1.0, 0, 0, 0]))  # faces +x
    for angle, seen in ((1.0, 1.0), (2.5, 1.2), (-3.0, -1.2)):
        led = state.replace(
            pipeline=state.pipeline.replace(qpos=qpos), direction=jnp.array([np.cos(angle), np.sin(angle)])
        )
        heading = jnp.array([np.cos(seen), np.sin(seen)])
        expected = humanoid_view(qpos, state.pipeline.qvel, heading)
        np.testing.assert_allclose(walking.observe(led), expected, atol=1e-5)


def test_rising_begins_in_a_crouch_or_on_its_feet_and_ends_where_it_sits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(HumanoidRising, "CROUCHES", 8)
    task = HumanoidRising()
    state = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.key(0), 64))
    stands = np.asarray(state.pipeline.qpos[:, 2] > 1.2)
    assert 0.02 < stands.mean() < 0.4  # 0.15 of them
    ahead = forward_axis(state.pipeline.qpos)[:, :2]
    np.testing.assert_allclose(state.direction, ahead / jnp.linalg.norm(ahead, axis=1, keepdims=True), atol=1e-5)
    first = jax.tree.map(lambda leaf: leaf[0], state)
    crouching = first.pipeline.replace(qpos=first.pipeline.qpos.at[2].set(0.5).at[3:7].set(jnp.array([1.0, 0, 0, 0])))
    assert task.evaluate_step(first, jnp.zeros(21), crouching).alive
    assert not task.evaluate_step(first, jnp.zeros(21), crouching.replace(qpos=crouching.qpos.at[2].set(0.4))).alive


def test_a_mirrored_humanoid_moves_as_its_image(walking: HumanoidWalking) -> None:
    model, rng = walking.engine.model, np.random.default_rng(0)
    np.testing.assert_array_equal(symmetry.HUMANOID_ACTUATED, model.actuator_trnid[:, 0] - 1)
    state = walking.reset(jax.random.key(1)).replace(direction=jnp.array([1.0, 0.0]))
    qpos = state.pipeline.qpos + jnp.asarray(rng.uniform(-0.2, 0.2, 28))
    qvel = jnp.asarray(rng.normal(size=27))
    action = jnp.asarray(rng.uniform(-1, 1, 21), jnp.float32)

    def image(qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
        joints = symmetry.mirrored_view(jnp.zeros(55).at[7:28].set(qpos[7:]).at[34:].set(qvel[6:]))
        place = qpos[:7] * jnp.array([1.0, -1, 1, 1, -1, 1, -1])
        speed = qvel[:6] * jnp.array([1.0, -1, 1, -1, 1, -1])
        return jnp.concatenate([place, joints[7:28]]), jnp.concatenate([speed, joints[34:]])

    here = state.replace(pipeline=walking.engine.init(qpos, qvel))
    there = state.replace(pipeline=walking.engine.init(*image(qpos, qvel)))
    row = Transition(walking.observe(here), action, jnp.zeros(()), jnp.ones(()), walking.observe(here))
    seen = walking.mirror(row)
    np.testing.assert_allclose(walking.observe(there), seen.observation, atol=1e-5)
    torques = walking.torques(here, action)
    torques_there = walking.torques(there, seen.action)
    np.testing.assert_allclose(torques_there, symmetry.mirrored_action(torques), atol=1e-5)
    assert not np.allclose(torques_there, torques, atol=0.1)
    for _ in range(4):
        here, there = (
            state.replace(pipeline=walking.engine.step(state.pipeline, torque))
            for state, torque in ((here, torques), (there, torques_there))
        )
    expected = image(here.pipeline.qpos, here.pipeline.qvel)
    np.testing.assert_allclose(there.pipeline.qpos, expected[0], atol=1e-4)
    np.testing.assert_allclose(there.pipeline.qvel, expected[1], atol=1e-2)


@pytest.mark.parametrize("flags", ["--updates-per-step 3", "--updates-per-step 0", "--learner {out}/none.npz"])
def test_wrong_flags_are_one_line(
    flags: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fewer updates than the actor's one in two would make none at all, and losses of nothing."""
    command = f"train.py ant_walker --out {tmp_path} --steps 100 {flags.format(out=tmp_path)}"
    monkeypatch.setattr(sys, "argv", command.split())
    assert guarded(main) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
