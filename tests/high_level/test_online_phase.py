"""The online phase on the plane: it finds the goal, learns from what it should, and repeats."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.data.device import Normaliser, to_device
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.learning import Sources
from qdos_brax.high_level.online_phase import OnlinePhase
from qdos_brax.high_level.sac import SAC
from qdos_brax.high_level.warm_up import RandomWarmUp
from qdos_brax.labels.bonus import NoBonus, RNDBonus
from qdos_brax.labels.label_phase import LabelPhase
from qdos_brax.labels.offline_reward import DataReward, MinimumReward, PredictedReward
from qdos_brax.labels.reward_model import RewardModel
from qdos_brax.labels.rnd import RND
from qdos_brax.nn.optim import running_mean
from qdos_brax.skills.low_level import TrajectorySkills
from qdos_brax.skills.segment_weights import UniformWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import SkillModel
from tests.point import PointEnv, bound, first_member, point_config, point_dataset, run_phase

SIZES = configs.SkillsConfig(
    latent_dim=2, encoder_hidden=16, encoder_layers=1, decoder_hidden=(32, 32), prior_hidden=(32, 32)
)
SKILLS = {"skills.updates": 600, "skills.learning_rate": 3e-3, "skills.kl_weight": 0.01}


@pytest.fixture(scope="module")
def plane():
    """(data, normaliser, low-level policy, artifacts of one member with trained skills and labels)."""
    config = point_config(**SKILLS)
    data, normaliser = to_device(point_dataset(), config.skills.horizon)
    model = SkillModel(2, 2, SIZES)
    seeds = np.zeros(1, np.uint32)
    skill_phase = bound(SkillPhase(config, model, UniformWeights(), None), config, data)
    low_level = TrajectorySkills(model, config.high_level.latent_map)
    label_phase = bound(LabelPhase(config.skills.horizon, len(data.starts), low_level), config, data)
    _, _, artifacts = run_phase(skill_phase, phase_keys(seeds, 0), {})
    _, _, artifacts = run_phase(label_phase, phase_keys(seeds, 1), artifacts)
    return data, normaliser, low_level, artifacts


def as_it_is(observation):
    return observation


def online_phase(plane, config, labeller=None, bonus=None):
    """(phase, artifacts, keys) for the members of ``config``, on the shared skills."""
    data, normaliser, low_level, artifacts = plane
    seeds = np.array([member["seed"] for member in configs.members(config)], np.uint32)
    bonus = bonus or RNDBonus(RND(2 + low_level.width, config.labels.rnd_hidden, config.labels.rnd_features), as_it_is)
    labeller = labeller or DataReward()
    sac, warm_up = SAC(2, low_level.width, config.high_level), RandomWarmUp(config.high_level.warmup_env_steps)
    phase = OnlinePhase(config, PointEnv(), normaliser, low_level, sac, warm_up, labeller, bonus, steps_per_chunk=100)
    repeated = jax.tree.map(lambda x: jnp.repeat(x, len(seeds), axis=0), artifacts)
    return bound(phase, config, data), repeated, phase_keys(seeds, 2)


def phase_keys(seeds, phase):
    """Typed keys[members], fresh arrays for every phase: a phase donates what it is given."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), phase))(seeds)


@pytest.fixture(scope="module")
def trained(plane):
    config = point_config(
        **SKILLS,
        **{
            "high_level.env_steps": 4000,
            "high_level.utd": 8,
            "high_level.learning_rate": 1e-3,
            "high_level.target_rate": 0.02,
            "high_level.warmup_env_steps": 500,
            "labels.rnd_coefficient": 0.1,
            "eval.episodes": 20,
            "eval.every_env_steps": 1000,
        },
    )
    phase, artifacts, keys = online_phase(plane, config)
    state, history, _ = run_phase(phase, keys, artifacts)
    return phase, state, history, artifacts, config


@pytest.fixture(scope="module")
def pair(plane):
    """Two members: two seeds."""
    return online_phase(plane, configs.replace(point_config(), seed=(0, 1)))


def test_the_high_level_learns_to_reach_the_goal(trained):
    _, _, history, _, _ = trained
    evaluations = [float(m["eval/success"][0]) for m in history if "eval/success" in m]
    assert len(evaluations) >= 3
    assert evaluations[-1] >= 0.9, evaluations


def test_first_goal_and_counts_are_kept(trained):
    _, state, history, _, config = trained
    first = float(history[-1]["first_goal_step"][0])
    assert 0 < first <= float(history[-1]["env_steps"][0])
    assert int(state.acting.replay.size[0]) <= config.high_level.replay_capacity
    assert bool(state.healthy[0]) and int(state.acting.broken[0]) == 0


def test_success_in_training_is_the_share_of_the_episodes_that_ended(trained):
    _, _, history, _, _ = trained
    shares = np.array([float(m["train/success"][0]) for m in history])
    ended = shares[~np.isnan(shares)]
    assert len(ended) and (ended >= 0).all() and (ended <= 1).all()
    # The trained actor is sampled here and its mode evaluated, so nearly as good; per macro step the share would be
    # a small fraction.
    assert np.mean(ended[-5:]) >= 0.7, ended


def test_a_phase_is_traced_once(trained):
    phase, _, _, _, _ = trained
    assert phase._chunk.compiled._cache_size() == 1


def test_the_batch_is_half_offline_and_half_online(trained):
    phase, state, _, artifacts, _ = trained
    member = first_member(state)
    replay = member.acting.replay
    sources = Sources(replay, phase.data, None, artifacts["labels"][0], first_member(phase.hyper))
    batch = phase.learning.sample(member.learners, jax.random.key(0), sources)
    online = np.asarray(replay.data.observation[: int(replay.size)])
    offline = np.asarray(phase.data.observations)
    half = len(batch.observation) // 2
    first, second = np.asarray(batch.observation[:half]), np.asarray(batch.observation[half:])
    assert all((row == offline).all(axis=1).any() for row in first)
    assert all((row == online).all(axis=1).any() for row in second)


def test_seeds_differ_and_repeat(pair):
    phase, artifacts, keys = pair
    results = []
    for _ in range(2):
        state, _ = phase.chunk(*phase.init(keys, artifacts))
        results.append([np.asarray(leaf) for leaf in jax.tree.leaves(state.learners.high_level.actor)])
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)
    assert any(not np.array_equal(a[0], a[1]) for a in results[0])


def test_a_member_that_diverges_is_frozen_and_the_other_is_as_without_it(pair):
    phase, artifacts, keys = pair
    alone, _ = phase.chunk(*phase.init(keys, artifacts))
    state, constants = phase.init(keys, artifacts)
    broken = jax.tree.map(lambda x: x.at[1].set(jnp.nan), state.learners.high_level.critic)
    learners = state.learners.replace(high_level=state.learners.high_level.replace(critic=broken))
    after, metrics = phase.chunk(state.replace(learners=learners), constants)
    np.testing.assert_array_equal(metrics["status_ok"], [True, False])
    leaves = zip(jax.tree.leaves(alone.learners.high_level), jax.tree.leaves(after.learners.high_level), strict=True)
    for expected, found in leaves:
        np.testing.assert_array_equal(found[0], expected[0])


def test_labels_are_samples_of_the_posterior():
    config = point_config()
    data, _ = to_device(point_dataset(), config.skills.horizon)
    model = SkillModel(2, 2, SIZES)
    params = model.init(jax.random.key(0))
    encoder = jax.tree.map(jnp.zeros_like, params["encoder"])
    encoder["params"]["Dense_0"]["bias"] = jnp.array([1.0, -2.0, -5.0, -5.0])  # mean (1, -2), deviation exp(-5)
    artifacts = {"skills": jax.tree.map(lambda x: x[None], params | {"encoder": encoder})}
    config = configs.replace(config, **{"skills.latent_box": 10.0})
    phase = LabelPhase(config.skills.horizon, len(data.starts), TrajectorySkills(model, "box"), chunk_size=1000)
    assert phase.num_chunks > 1
    keys = phase_keys(np.zeros(1, np.uint32), 0)
    labels = run_phase(bound(phase, config, data), keys, artifacts)[2]["labels"]
    assert labels.shape == (1, data.starts.shape[0], 2)
    np.testing.assert_allclose(labels[0], np.broadcast_to([0.1, -0.2], labels.shape[1:]), atol=0.005)
    assert float(labels[0].std(axis=0).min()) > 0
    phase = LabelPhase(config.skills.horizon, len(data.starts), TrajectorySkills(model, "box"), "mean")
    labels = run_phase(bound(phase, config, data), phase_keys(np.zeros(1, np.uint32), 0), artifacts)[2]["labels"]
    np.testing.assert_allclose(labels[0], np.broadcast_to([0.1, -0.2], labels.shape[1:]), atol=1e-6)


def rows(size=64):
    keys = jax.random.split(jax.random.key(0), 2)
    observation = jax.random.normal(keys[0], (size, 2))
    mask = (observation[:, 0] < 1).astype(jnp.float32)
    observation = observation.at[:, 0].add(1 - mask)  # a gap, so that the border can be learned
    return Transition(observation, jax.random.normal(keys[1], (size, 1)), -2 * mask, mask, observation)


def test_offline_rewards_by_hand():
    batch = rows()
    reward, mask = DataReward().label({}, batch, 0.9)
    np.testing.assert_array_equal(reward, batch.reward)
    np.testing.assert_array_equal(mask, batch.mask)
    minimum = MinimumReward(RewardModel(3, (8,)), as_it_is, horizon=3, lowest=-1.0)
    reward, _ = minimum.label(minimum.init(jax.random.key(0)), batch, 0.5)
    np.testing.assert_allclose(reward, -1.75)


def test_the_reward_model_learns_rewards_and_ends_and_waits_for_its_start():
    batch = rows()
    labeller = PredictedReward(RewardModel(3, (32,)), as_it_is)
    state = labeller.init(jax.random.key(1))
    waiting = labeller.learn(state, batch, 1e-2, jnp.array(False))
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(waiting), strict=True):
        np.testing.assert_array_equal(a, b)
    learn = jax.jit(lambda s: labeller.learn(s, batch, 3e-3, jnp.array(True)))
    for _ in range(1000):
        state = learn(state)
    reward, mask = labeller.label(state, batch, 0.9)
    assert float(jnp.mean((reward - batch.reward) ** 2)) < 0.05
    assert float(jnp.mean(jnp.abs(mask - batch.mask))) < 0.1


def test_reward_model_loss_by_hand():
    model = RewardModel(2, (4,))
    params = jax.tree.map(jnp.zeros_like, model.init(jax.random.key(0)).params)
    # Everything 0: reward error 4 and 0, and -log(1/2) for either mask.
    loss = model.loss(params, jnp.ones((2, 1)), jnp.ones((2, 1)), jnp.array([2.0, 0.0]), jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(loss, 2 + np.log(2), rtol=1e-6)


class CountingReward(DataReward):
    """Counts its steps and the rows of each."""

    def init(self, key):
        return {"steps": jnp.zeros((), jnp.int32), "rows": jnp.zeros((), jnp.int32)}

    def learn(self, state, rows, learning_rate, active):
        return {"steps": state["steps"] + active, "rows": state["rows"] + active * len(rows.reward)}


class SummingBonus(NoBonus):
    """Sums up what it is taught."""

    def init(self, key):
        return {"steps": jnp.zeros((), jnp.int32), "sum": jnp.zeros(2)}

    def learn(self, state, observation, action, hyper, active):
        return {"steps": state["steps"] + active * len(observation), "sum": state["sum"] + active * observation.sum(0)}


def test_the_bonus_learns_every_macro_step_once_and_the_labeller_as_often_as_the_critics(plane):
    settings = {"labels.start_env_steps": 0, "high_level.utd": 3, "high_level.offline_fraction": 0.25}
    config = point_config(**settings)
    phase, artifacts, keys = online_phase(plane, config, CountingReward(), SummingBonus())
    state, _ = phase.chunk(*phase.init(keys, artifacts))
    learners, replay = state.learners, state.acting.replay
    played = int(replay.size[0])
    assert played > config.high_level.num_envs
    assert int(learners.bonus["steps"][0]) == played
    np.testing.assert_allclose(
        learners.bonus["sum"][0], replay.data.observation[0, :played].sum(0), rtol=1e-4, atol=1e-4
    )
    assert int(learners.labeller["steps"][0]) == 3 * played == int(state.update[0])
    assert int(learners.labeller["rows"][0]) == 3 * played * round(0.75 * config.high_level.batch_size)


def test_actor_steps_lie_evenly_among_the_critics(plane):
    counts = {}
    for actor_updates in (1, 2, 4):
        config = point_config(**{"high_level.utd": 4, "high_level.actor_updates": actor_updates})
        phase, artifacts, keys = online_phase(plane, config)
        state, _ = phase.chunk(*phase.init(keys, artifacts))
        played, sac = int(state.acting.replay.size[0]), state.learners.high_level
        steps = [int(opt_state.count[0]) for opt_state in (sac.critic_opt_state, sac.actor_opt_state)]
        assert steps == [4 * played, actor_updates * played]
        assert int(sac.temperature_opt_state.count[0]) == steps[1] and int(state.update[0]) == steps[0]
        counts[actor_updates] = played
    assert len(set(counts.values())) == 1


def test_rnd_error_falls_where_it_was_trained_and_stays_elsewhere():
    rnd = RND(3, (32, 32), 16)
    state = rnd.init(jax.random.key(0))
    seen, new = jnp.zeros((64, 2)) + 0.1 * jax.random.normal(jax.random.key(1), (64, 2)), 3 * jnp.ones((64, 2))
    action = jnp.zeros((64, 1))
    update = jax.jit(lambda s: rnd.update(s, seen, action, 1e-3))
    for _ in range(300):
        state = update(state)
    known = rnd.error(state.predictor, state.target, seen, action).mean()
    unknown = rnd.error(state.predictor, state.target, new, action).mean()
    assert float(known) < 0.01 * float(unknown)


def test_bonus_and_reward_model_see_observations_as_they_are_told():
    """In metres a step of 1 cm is small, in deviations of a column that hardly moves it is a hundred of them."""
    normaliser = Normaliser(jnp.array([3.0, -1.0]), jnp.array([0.5, 2.0]))
    raw, action = jnp.array([[3.0, 4.0]]), jnp.ones((1, 1))
    normal = normaliser(raw)
    np.testing.assert_allclose(normal, [[0.0, 2.5]])
    np.testing.assert_allclose(normaliser.restored(normal), raw)
    rnd, model = RND(3, (8,), 4), RewardModel(3, (8,))
    row = Transition(normal, action, jnp.zeros(1), jnp.ones(1), normal)
    for see, seen in ((normaliser.restored, raw), (as_it_is, normal)):
        bonus, reward = RNDBonus(rnd, see), PredictedReward(model, see)
        novelty, labels = bonus.init(jax.random.key(0)), reward.init(jax.random.key(1))
        expected = 8.0 * rnd.error(novelty.predictor, novelty.target, seen, action)
        earned = bonus.of(novelty, normal, action, {"labels.rnd_coefficient": 8.0})
        np.testing.assert_allclose(earned, expected, rtol=1e-5)
        np.testing.assert_allclose(
            reward.label(labels, row, 0.9)[0], model.predict(labels.params, seen, action)[0], rtol=1e-5
        )


def short_run(plane, share):
    """(learning actor, played actor) after 1,000 steps, and the learners, of one member."""
    changes = {"high_level.env_steps": 1000, "high_level.warmup_env_steps": 200, "high_level.actor_average": share}
    phase, artifacts, keys = online_phase(plane, point_config(**SKILLS, **changes))
    state, _, artifacts = run_phase(phase, keys, artifacts)
    return state.learners.high_level.actor, artifacts["actor"], state.learners


def test_what_is_played_is_the_actor_or_its_running_mean(plane):
    """The mean changes nothing that is learned; as slow as this it has hardly left where the actor began."""
    actor, played, learners = short_run(plane, 1.0)
    other, mean, same = short_run(plane, 1e-6)
    assert jax.tree.all(jax.tree.map(np.array_equal, learners, same))
    assert jax.tree.all(jax.tree.map(np.array_equal, actor, played))
    moved = [np.abs(np.subtract(a, m)).max() for a, m in zip(*map(jax.tree.leaves, (other, mean)), strict=True)]
    assert max(moved) > 0.01


def test_running_mean_by_hand():
    mean = {"w": jnp.array([1.0, jnp.float32(0.1)])}
    params = {"w": jnp.array([2.0, jnp.float32(0.3)])}
    np.testing.assert_allclose(running_mean(mean, params, 0.25)["w"], [1.25, 0.15], rtol=1e-6)
    np.testing.assert_array_equal(running_mean(mean, params, 1.0)["w"], params["w"])
