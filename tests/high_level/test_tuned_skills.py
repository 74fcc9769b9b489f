"""Skills that are fine-tuned online: losses and guard by hand, and what becomes of slow skills on the plane."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.analysis.finished import trained_run
from qdos_brax.data.device import to_device
from qdos_brax.errors import UserError
from qdos_brax.high_level import tuned_skills
from qdos_brax.high_level.agent import Agent
from qdos_brax.high_level.evaluation import evaluate
from qdos_brax.high_level.macro_step import InnerStep, macro_step
from qdos_brax.high_level.online_phase import OnlinePhase
from qdos_brax.high_level.sac import SAC
from qdos_brax.high_level.skill_critic import SkillCritic, Tracks, live_mean, macro_returns, sure_gain, through_clip
from qdos_brax.high_level.tuned_skills import TunedSkills, scaled
from qdos_brax.high_level.warm_up import RandomWarmUp
from qdos_brax.labels.bonus import NoBonus
from qdos_brax.labels.offline_reward import DataReward
from qdos_brax.methods.low_level_kinds import make_low_level
from qdos_brax.runs.checkpoint import CheckpointStore, Position
from tests.high_level.test_macro_step import Line
from tests.point import STEP, PointEnv, bound, first_member, point_config, point_dataset, run_phase

SLOW, FAST = 0.12, 0.3  # speeds of skills: with the first the goal is rarely reached before the cap
STARTS = jax.random.key(9)


# --- Losses ----------------------------------------------------------------------------------------------------


def tracks_of(rewards: Any, live: Any, mask: Any) -> Tracks:
    batch, horizon = np.shape(rewards)
    zeros = jnp.zeros((batch, horizon, 1))
    rewards, live, mask = (jnp.asarray(x, jnp.float32) for x in (rewards, live, mask))
    return Tracks(zeros, zeros, rewards, live, jnp.zeros((batch, 1)), mask, jnp.zeros((batch, 1)))


def test_returns_within_a_macro_step_by_hand() -> None:
    """A whole macro step, one that ended at the goal, and one that was cut off after two steps; discount 1/2."""
    tracks = tracks_of(
        [[-1, -1, -1], [-1, 0, 9], [-1, -1, 9]], [[1, 1, 1], [1, 1, 0], [1, 1, 0]], [1, 0, 1]
    )  # the 9 is never earned
    end = jnp.array([-8.0, -8.0, -8.0])
    later = jnp.stack([jnp.full((3, 3), -2.0), jnp.full((3, 3), -6.0)])  # two heads
    # lambda 1: -1, -1/2, -1/4 and V / 2 where it goes on; in the account of the macro step, so none is scaled up.
    whole = [[-5.75, -4.75, -4.25], [-1.0, 0.0], [-5.5, -4.5]]
    found = macro_returns(tracks, 0.5, 1.0, end, later)
    for head in found:
        np.testing.assert_allclose(head[0], whole[0])
        np.testing.assert_allclose(head[1, :2], whole[1])
        np.testing.assert_allclose(head[2, :2], whole[2])
    # lambda 0: one step, then the head's own Q; the last live step still has V.
    found = macro_returns(tracks, 0.5, 0.0, end, later)
    np.testing.assert_allclose(found[:, 0], [[-3.0, -2.5, -4.25], [-7.0, -6.5, -4.25]])
    np.testing.assert_allclose(found[:, 1, :2], [[-3.0, 0.0], [-7.0, 0.0]])
    np.testing.assert_allclose(found[:, 2, :2], [[-3.0, -4.5], [-7.0, -4.5]])
    # lambda 1/2, from the back: -4.25, -0.5 + (-2 - 4.25) / 2, -1 + (-2 - 3.625) / 2.
    np.testing.assert_allclose(macro_returns(tracks, 0.5, 0.5, end, later)[0, 0], [-3.8125, -3.625, -4.25])


def test_the_first_of_the_returns_is_the_high_levels_target() -> None:
    """The account of a macro step is that of the high level: its reward, and the discounted value after it."""
    _, result = macro_step(
        Line(goal=3.0), lambda obs, step: jnp.ones(1), Line().reset(jax.random.key(0)), 3, 0.9, lambda step: step
    )
    inner: InnerStep = result.track
    np.testing.assert_array_equal(inner.observation[:, 0], [0.0, 1.0, 2.0])
    tracks = tracks_of(inner.reward[None], inner.live[None], result.mask[None])
    found = macro_returns(tracks, 0.9, 1.0, jnp.array([-7.0]), jnp.zeros((1, 1, 3)))
    np.testing.assert_allclose(found[0, 0, 0], result.reward + 0.9 * result.mask * -7.0, rtol=1e-6)


def test_the_critics_loss_is_over_live_steps_alone() -> None:
    critic = SkillCritic(3, (4,), 2, 5.0)
    state = critic.init(jax.random.key(0))
    zeros = jax.tree.map(jnp.zeros_like, state.critic)
    tracks = tracks_of([[0, 0]], [[1, 0]], [1])
    targets = jnp.array([[[3.0, 100.0]], [[1.0, 100.0]]])
    context = jnp.zeros((1, 2, 1))
    _, loss = critic.update(state.replace(critic=zeros), tracks, context, targets, 0.0, 0.0)
    np.testing.assert_allclose(loss, (9 + 1) / 2)  # Q is 0; the mean over the heads
    biased = jax.tree.map(jnp.zeros_like, state.critic)
    biased["params"]["VmapMLP_0"]["Dense_1"]["bias"] = jnp.array([[1.0], [-2.0]])
    np.testing.assert_allclose(
        critic.values(biased, tracks.observations, context, tracks.actions)[:, 0], [[5, 5], [-10, -10]]
    )


def test_a_gain_is_what_every_head_agrees_on() -> None:
    """Heads with slopes 1 and 3 agree, so the smaller counts; with 1 and -1 nothing can be gained."""
    frozen = jnp.zeros((2, 1, 1))
    for slopes, up, down in (((1.0, 3.0), 1.0, -3.0), ((1.0, -1.0), -1.0, -1.0)):
        slope = jnp.array(slopes)[:, None, None]
        assert float(sure_gain(slope, frozen)[0, 0]) == up
        assert float(sure_gain(-slope, frozen)[0, 0]) == down
        assert float(sure_gain(frozen, frozen)[0, 0]) == 0.0
    assert float(live_mean(jnp.array([[2.0, 50.0]]), jnp.array([[1.0, 0.0]]))) == 2.0


def test_the_gradient_passes_through_the_clip() -> None:
    value, slope = jax.value_and_grad(lambda a: through_clip(a) * 3)(1.5)
    assert (float(value), float(slope)) == (3.0, 3.0)


# --- Skills on the plane ---------------------------------------------------------------------------------------

SETTINGS = {
    "high_level.env_steps": 5000,
    "high_level.utd": 8,
    "high_level.learning_rate": 1e-3,
    "high_level.target_rate": 0.02,
    "high_level.latent_map": "box",
    "high_level.warmup_env_steps": 300,
    "skills.latent_box": 1.0,
    "skills.decoder_hidden": [4],
    "eval.episodes": 20,
    "eval.every_env_steps": 1000,
    "tuning.skills": "guarded",
    "tuning.start_env_steps": 600,
    "tuning.learning_rate": 1e-3,
}


def straight_skills(low_level: Any, speed: float) -> dict[str, Any]:
    """Parameters of skills that walk along z at a known speed, a = speed * z, wherever they are."""
    params = low_level._skills.init(jax.random.key(0))
    first = np.zeros((4, 4), np.float32)  # (x, y, z) -> relu(z), relu(-z)
    first[2:] = np.concatenate([np.eye(2), -np.eye(2)], axis=1)
    last = np.zeros((4, 4), np.float32)  # -> mean, log standard deviation
    last[:, :2] = speed * np.concatenate([np.eye(2), -np.eye(2)])
    decoder = jax.tree.map(jnp.zeros_like, params["decoder"])
    layers = decoder["params"]["MLP_0"]
    layers["Dense_0"]["kernel"], layers["Dense_1"]["kernel"] = jnp.asarray(first), jnp.asarray(last)
    return params | {"decoder": decoder, "prior": jax.tree.map(jnp.zeros_like, params["prior"])}


def plane(speed: float, **values: Any) -> tuple[Any, Any, Any, Any]:
    """(phase, artifacts, keys, config) of an online phase on skills of a speed, and on data as they make it."""
    config = point_config(**SETTINGS | values)
    dataset = point_dataset(speed=speed)
    data, normaliser = to_device(dataset, config.skills.horizon)
    low_level = make_low_level(config, PointEnv())
    windows = np.asarray(data.starts)[:, None] + np.arange(config.skills.horizon)
    labels = np.clip(dataset.actions[windows].mean(axis=1) / speed, -0.99, 0.99)
    members = len(configs.members(config))
    one = {"skills": straight_skills(low_level, speed), "labels": jnp.asarray(labels)}
    artifacts = jax.tree.map(lambda x: jnp.repeat(x[None], members, axis=0), one)
    sac = SAC(2, low_level.width, config.high_level)
    tuned = TunedSkills(config, low_level, sac, 2, 2)
    warm_up = RandomWarmUp(config.high_level.warmup_env_steps)
    phase = OnlinePhase(
        config, PointEnv(), normaliser, low_level, sac, warm_up, DataReward(), NoBonus(), None, tuned, 200
    )
    keys = jax.vmap(jax.random.key)(np.asarray([member["seed"] for member in configs.members(config)], np.uint32))
    return bound(phase, config, data), artifacts, keys, config


@partial(jax.jit, static_argnums=0)
def success_of(phase: Any, skills: Any, actor: Any) -> jax.Array:
    """Success of an agent over 100 episodes."""
    agent = Agent(phase._normalise, phase._low_level, phase._high_level, 1.0, skills, actor)
    return evaluate(PointEnv(), agent.choose, agent.play, STARTS, 100, 5).success.mean()


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """(phase, last state, metrics, artifacts, constants, checkpoints) of two seeds; the checkpoint is 2 chunks old."""
    phase, artifacts, keys, _ = plane(SLOW, seed=(0, 1))
    store = CheckpointStore(tmp_path_factory.mktemp("slow"), "0123456789abcdef")
    (state, constants), history = phase.init(keys, artifacts), []
    for chunk in range(phase.num_chunks):
        if chunk == phase.num_chunks - 2:
            store.save(Position(phase=0, chunk=chunk, rows=0, columns=(), wall_seconds={}), state)
        state, metrics = phase.chunk(state, constants)
        history.append(metrics)
    return phase, state, history, phase.finish(state, artifacts), constants, store


def test_fine_tuning_goes_beyond_what_the_frozen_skills_can_do(slow: Any) -> None:
    """59 moves at 0.12 of a step reach 0.708: the goal's edge is 0.75 away, less what a start is ahead."""
    phase, _, history, final, _, _ = slow
    starts = np.asarray(jax.vmap(lambda key: PointEnv().reset(key).obs)(jax.random.split(STARTS, 100)))
    ceiling = np.mean(starts[:, 0] + 59 * STEP * SLOW >= 0.75)
    assert 0.2 < ceiling < 0.5
    for member in range(2):
        one = jax.tree.map(lambda x, member=member: x[member], final)
        assert success_of(phase, scaled(one["skills"], jnp.zeros(())), one["actor"]) <= ceiling + 0.01
        assert success_of(phase, one["skills"], one["actor"]) >= 0.9
    assert (history[-1]["eval/success"] >= 0.9).all() and (history[-1]["tuning_preferred"] == 1).all()
    assert (history[-1]["tuning_return"] > history[-1]["frozen_return"] + 10).all()


def test_the_correction_stays_within_its_bound(slow: Any) -> None:
    phase, _, history, final, _, _ = slow
    one = first_member(final)["skills"]
    assert float(one["correction"]["bound"]) == np.float32(0.2)
    observation, skill = 3 * jax.random.normal(jax.random.key(0), (500, 2)), jnp.ones((500, 2))
    change = np.abs(phase._low_level.correction(one, observation, skill))
    assert 0.1 < change.max() <= np.float32(0.2)
    assert (history[-1]["tuning_size"] > 0).all() and (history[-1]["tuning_size"] <= 0.2).all()


def test_a_finished_run_plays_the_tuned_decoder(slow: Any) -> None:
    """Evaluation, film and export make their agent of artifacts and configuration alone."""
    phase, _, _, final, _, _ = slow
    trained = trained_run(point_config(**SETTINGS, seed=(0, 1)), PointEnv(), final)
    agent = trained.agent(*first_member((trained.artifacts, trained.hyper)))
    observation, one = jnp.array([0.3, -0.1]), first_member(final)
    skill = agent.choose(observation)
    action = agent.play(observation, skill, 0)
    normal = phase._normalise(observation)
    frozen = {name: part for name, part in one["skills"].items() if name != "correction"}
    expected = phase._low_level.act(frozen, normal, skill, 0) + phase._low_level.correction(
        one["skills"], normal, skill
    )
    np.testing.assert_allclose(action, expected, rtol=1e-5)
    assert np.abs(action - phase._low_level.act(frozen, normal, skill, 0)).max() > 0.05


def test_a_phase_goes_on_from_a_checkpoint_as_if_nothing_had_happened(slow: Any) -> None:
    phase, state, history, _, constants, store = slow
    again = store.restore(store.newest_first()[0], state)
    for _ in range(2):
        again, found = phase.chunk(again, constants)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(again), strict=True):
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)
    for name in ("tuning_gain", "tuning_return", "eval/return"):
        np.testing.assert_array_equal(found[name], history[-1][name])
    network = np.asarray(state.learners.skills.correction["network"]["params"]["Dense_1"]["kernel"])
    assert not np.array_equal(network[0], network[1])


def test_harmful_fine_tuning_is_kept_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the gain negated the correction drives away from the goal, which the guard does not let anyone play."""
    monkeypatch.setattr(tuned_skills, "sure_gain", lambda corrected, frozen: jnp.min(frozen - corrected, axis=0))
    phase, artifacts, keys, _ = plane(FAST)
    _, history, final = run_phase(phase, keys, artifacts)
    assert history[-1]["tuning_preferred"][0] == 0 and history[-1]["tuning_return"][0] < history[-1]["frozen_return"][0]
    assert history[-1]["eval/success"][0] >= 0.9
    one = first_member(final)
    assert float(one["skills"]["correction"]["bound"]) == 0.0
    harmed = {**one["skills"], "correction": {**one["skills"]["correction"], "bound": jnp.asarray(0.2)}}
    assert success_of(phase, harmed, one["actor"]) <= 0.5
    assert success_of(phase, one["skills"], one["actor"]) >= 0.9


def test_a_correction_of_nothing_plays_as_the_frozen_skills_do_to_the_bit() -> None:
    config = point_config(**SETTINGS)
    low_level = make_low_level(config, PointEnv())
    params = low_level._skills.init(jax.random.key(1))
    keys = jax.random.split(jax.random.key(2), 2)
    observation, skill = jax.random.normal(keys[0], (50, 2)), jax.random.normal(keys[1], (50, 2))
    frozen = low_level.act(params, observation, skill, 0)
    fresh = params | {"correction": low_level.init_correction(jax.random.key(3), 0.2)}
    np.testing.assert_array_equal(low_level.act(fresh, observation, skill, 0), frozen)
    moved = jax.tree.map(lambda x: x + 0.1, fresh["correction"])
    assert not np.array_equal(low_level.act(params | {"correction": moved}, observation, skill, 0), frozen)
    off = scaled(params | {"correction": moved}, jnp.zeros(()))
    np.testing.assert_array_equal(low_level.act(off, observation, skill, 0), frozen)


def test_the_high_level_is_not_shown_a_decoder_that_is_not_preferred(slow: Any) -> None:
    phase, state, *_ = slow
    tuned, seen = phase._skill_learning, first_member(state.acting.seen)
    for total, shown in (([-50.0, -60.0], [True, False]), ([-60.0, -50.0], [True, True])):
        guard = seen.guard.replace(tuned=jnp.array([False, True]), episodes=jnp.full(2, 5.0), total=jnp.asarray(total))
        np.testing.assert_array_equal(tuned.shown(seen.replace(guard=guard)), shown)


def test_the_steps_within_macro_steps_are_seen_as_the_high_level_sees_their_first() -> None:
    """Normalised: the decoder and both critics know nothing else."""
    phase, artifacts, keys, _ = plane(FAST, **{"tuning.start_env_steps": 100_000})
    state, constants = phase.init(keys, artifacts)
    state, _ = phase.chunk(state, constants)
    acting = first_member(state.acting)
    count = int(acting.seen.replay.size)
    assert count == int(acting.replay.size) > 20
    rows, tracks = acting.replay.data, acting.seen.replay.data
    np.testing.assert_array_equal(tracks.observations[:count, 0], rows.observation[:count])
    raw = phase._normalise.mean + phase._normalise.scale * rows.observation[:count]
    assert np.abs(raw - rows.observation[:count]).max() > 0.1  # that is not the same


def test_only_trajectory_skills_can_be_fine_tuned() -> None:
    with pytest.raises(UserError, match="dsrl has no trajectory skills to fine-tune"):
        configs.check_method(configs.load_config("antmaze", "smoke", {"method": "dsrl", "tuning.skills": "guarded"}))
    configs.check_method(configs.load_config("antmaze", "smoke", {"method": "supe", "tuning.skills": "guarded"}))
