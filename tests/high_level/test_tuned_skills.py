"""Skills that are fine-tuned online: losses and guard by hand, and what becomes of slow skills on the plane."""

from __future__ import annotations

from pathlib import Path
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
from qdos_brax.high_level.guard import Guard, GuardState
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


# --- The guard -------------------------------------------------------------------------------------------------


def guard_after(guard: Guard, episodes: list[tuple[bool, float]]) -> GuardState:
    """The comparison after single episodes, (of the tuned decoder?, return), one macro step each."""
    state = guard.start(1)
    for tuned, earned in episodes:
        state = state.replace(tuned=jnp.array([tuned]))
        state = guard.observe(
            state, jax.random.key(0), jnp.array([earned]), jnp.array([True]), jnp.array([True]), jnp.array(True)
        )
    return state


def test_the_guard_by_hand() -> None:
    guard = Guard(window=2, trial_share=0.25)  # an episode counts half after the next one
    state = guard_after(guard, [(False, -10.0), (True, -4.0), (False, -20.0)])
    np.testing.assert_allclose(state.episodes, [1.25, 0.5])
    np.testing.assert_allclose(guard.means(state), [(-20 - 10 / 4) / 1.25, -4.0])
    assert not guard.prefers_tuned(state)  # too few episodes yet
    assert np.isnan(guard.means(guard.start(1))).all() and not guard.prefers_tuned(guard.start(1))


@pytest.mark.parametrize(("advantage", "preferred"), [(0.1, True), (-0.1, False)])
def test_the_tuned_decoder_is_preferred_while_it_earns_no_less(advantage: float, preferred: bool) -> None:
    """Returns rise from episode to episode, as a high level's do: that favours neither."""
    guard = Guard(window=40, trial_share=0.25)
    state = guard_after(guard, [(tuned, n + advantage * tuned) for n in range(100) for tuned in (False, True)])
    np.testing.assert_allclose(np.diff(guard.means(state)), advantage, atol=1e-3)
    assert bool(guard.prefers_tuned(state)) == preferred


def test_episodes_take_turns_as_the_guard_says_and_broken_ones_do_not_count() -> None:
    guard, many = Guard(window=40, trial_share=0.25), 20_000
    yes = jnp.ones(many, bool)
    for total, share in (([-30.0, -20.0], 0.75), ([-20.0, -30.0], 0.25)):
        state = guard.start(many).replace(episodes=jnp.array([5.0, 5.0]), total=jnp.array(total))
        after = guard.observe(state, jax.random.key(1), jnp.zeros(many), yes, ~yes, jnp.array(True))
        np.testing.assert_array_equal(after.episodes, state.episodes)
        assert abs(float(after.tuned.mean()) - share) < 0.02
        none = guard.observe(state, jax.random.key(1), jnp.zeros(many), yes, ~yes, jnp.array(False))
        assert not none.tuned.any()
    going = guard.observe(guard.start(many), jax.random.key(1), -jnp.ones(many), ~yes, yes, jnp.array(True))
    assert not going.tuned.any() and float(going.earned[0]) == -1.0


# --- Skills on the plane ---------------------------------------------------------------------------------------

SETTINGS = {
    "high_level.env_steps": 3000,
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


def success_of(phase: Any, artifacts: Any, share: float, choose: Any = None) -> float:
    """Success of a member's final agent with a share of the correction, over 100 episodes."""
    low_level, one = phase._low_level, first_member(artifacts)
    skills = scaled(one["skills"], jnp.asarray(share)) if "correction" in one["skills"] else one["skills"]
    agent = Agent(phase._normalise, low_level, phase._high_level, 1.0, skills, one["actor"])
    played = evaluate(PointEnv(), choose or agent.choose, agent.play, jax.random.key(9), 100, 5)
    return float(played.success.mean())


@pytest.fixture(scope="module")
def slow() -> Any:
    phase, artifacts, keys, config = plane(SLOW)
    state, history, final = run_phase(phase, keys, artifacts)
    return phase, state, history, final, config


def test_fine_tuning_goes_beyond_what_the_frozen_skills_can_do(slow: Any) -> None:
    """59 moves at 0.12 of a step reach 0.708: the goal's edge is 0.75 away, less what a start is ahead."""
    phase, _, history, final, _ = slow
    starts = np.asarray(jax.vmap(lambda key: PointEnv().reset(key).obs)(jax.random.split(jax.random.key(9), 100)))
    ceiling = np.mean(starts[:, 0] + 59 * STEP * SLOW >= 0.75)
    assert 0.2 < ceiling < 0.5
    full_ahead = lambda observation: jnp.array([1.0, 0.0])  # noqa: E731
    assert success_of(phase, final, 0.0, full_ahead) <= ceiling + 0.01
    assert success_of(phase, final, 0.0) <= ceiling + 0.01
    assert history[-1]["eval/success"][0] >= 0.9 and history[-1]["tuning_preferred"][0] == 1
    assert success_of(phase, final, 1.0) >= 0.9
    assert history[-1]["tuning_return"][0] > history[-1]["frozen_return"][0] + 10


def test_the_correction_stays_within_its_bound(slow: Any) -> None:
    phase, _, history, final, config = slow
    one, bound_ = first_member(final)["skills"], configs.hyper_tree(config)["tuning.bound"]
    assert float(one["correction"]["bound"]) == np.float32(bound_) == np.float32(0.2)
    observation, skill = 3 * jax.random.normal(jax.random.key(0), (500, 2)), jnp.ones((500, 2))
    change = np.abs(phase._low_level.correction(one, observation, skill))
    assert 0.1 < change.max() <= 0.2
    assert 0 < history[-1]["tuning_size"][0] <= 0.2


def test_an_evaluation_of_the_finished_run_plays_the_tuned_decoder(slow: Any) -> None:
    phase, _, _, final, config = slow
    trained = trained_run(config, PointEnv(), final)
    agent = trained.agent(*first_member((trained.artifacts, trained.hyper)))
    played = evaluate(PointEnv(), agent.choose, agent.play, jax.random.key(9), 100, 5)
    assert float(played.success.mean()) == success_of(phase, final, 1.0) >= 0.9


def test_harmful_fine_tuning_is_kept_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the gain negated the correction drives away from the goal, which the guard does not let anyone play."""
    monkeypatch.setattr(tuned_skills, "sure_gain", lambda corrected, frozen: jnp.min(frozen - corrected, axis=0))
    phase, artifacts, keys, _ = plane(FAST)
    _, history, final = run_phase(phase, keys, artifacts)
    assert history[-1]["tuning_preferred"][0] == 0 and history[-1]["tuning_return"][0] < history[-1]["frozen_return"][0]
    assert history[-1]["eval/success"][0] >= 0.9
    assert float(final["skills"]["correction"]["bound"][0]) == 0.0
    correction = jax.tree.map(jnp.asarray, final["skills"]["correction"]) | {"bound": jnp.full(1, 0.2)}
    harmed = final | {"skills": final["skills"] | {"correction": correction}}
    assert success_of(phase, harmed, 1.0) <= 0.5 < 0.9 <= success_of(phase, final, 1.0)


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


# --- As a part of the phase ------------------------------------------------------------------------------------

SHORT = {"high_level.env_steps": 800, "eval.every_env_steps": 400, "tuning.start_env_steps": 100, "eval.episodes": 2}


@pytest.fixture(scope="module")
def pair() -> Any:
    """Two members: two seeds."""
    return plane(SLOW, seed=(0, 1), **SHORT)


def test_a_checkpoint_holds_all_of_it(pair: Any, tmp_path: Path) -> None:
    """A phase that goes on from a checkpoint ends as if nothing had happened, and seeds differ."""
    phase, artifacts, keys, _ = pair
    run = lambda: phase.init(jnp.copy(keys), artifacts)  # noqa: E731
    store = CheckpointStore(tmp_path, "0123456789abcdef")
    state, constants = run()
    for chunk in range(phase.num_chunks):
        if chunk == 2:
            store.save(Position(phase=0, chunk=chunk, rows=0, columns=(), wall_seconds={}), state)
        state, metrics = phase.chunk(state, constants)
    blank, constants = run()
    again = store.restore(store.newest_first()[0], blank)
    for _ in range(2, phase.num_chunks):
        again, found = phase.chunk(again, constants)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(again), strict=True):
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)
    assert {name: value.tolist() for name, value in metrics.items() if "tuning" in name} == {
        name: value.tolist() for name, value in found.items() if "tuning" in name
    }
    networks = state.learners.skills.correction["network"]["params"]["Dense_1"]["kernel"]
    assert not np.array_equal(networks[0], networks[1]) and np.abs(networks).max(axis=(1, 2)).min() > 0


def test_the_high_level_is_not_shown_a_decoder_that_is_not_preferred(pair: Any) -> None:
    phase, artifacts, keys, _ = pair
    state, _ = phase.init(jnp.copy(keys), artifacts)
    tuned, seen = phase._skill_learning, first_member(state.acting.seen)
    for total, shown in (([-50.0, -60.0], [True, False]), ([-60.0, -50.0], [True, True])):
        guard = seen.guard.replace(tuned=jnp.array([False, True]), episodes=jnp.full(2, 5.0), total=jnp.asarray(total))
        np.testing.assert_array_equal(tuned.shown(seen.replace(guard=guard)), shown)


def test_only_trajectory_skills_can_be_fine_tuned() -> None:
    with pytest.raises(UserError, match="dsrl has no trajectory skills to fine-tune"):
        configs.check_method(configs.load_config("antmaze", "smoke", {"method": "dsrl", "tuning.skills": "guarded"}))
    configs.check_method(configs.load_config("antmaze", "smoke", {"method": "supe", "tuning.skills": "guarded"}))
