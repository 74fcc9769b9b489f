"""The offline learners reach what is known: a chain's values, and skills that can be told apart."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.data.device import to_device
from qdos_brax.nn.networks import gaussian_sample
from qdos_brax.skills.information import LoggedStates, PhysicsRollout
from qdos_brax.skills.information_terms import SegmentTerm
from qdos_brax.skills.segment_weights import LatentWeights, LoggedWeights, UniformWeights
from qdos_brax.skills.skill_phase import SkillPhase
from qdos_brax.skills.vae import Segments, SkillModel
from qdos_brax.skills.value_phase import ValuePhase
from qdos_brax.skills.values import IQL, ValueBatch, ValueHyper
from tests.point import GOAL, PointEnv, bound, first_member, point_config, point_dataset, run_phase


def test_iql_finds_the_values_of_a_chain():
    """States 0..4, action +1 or -1, reward -1 until state 4 ends it: the best values are -(1 - g^d) / (1 - g).

    The data moves both ways equally often, so the mean behaviour is much worse: a high expectile has to find the best.
    """
    states, length, discount = 5, 2000, 0.8
    rng = np.random.default_rng(0)
    at, direction = rng.integers(0, states, length), rng.choice([-1, 1], length)
    after = np.clip(at + direction, 0, states - 1)
    ends = at == states - 1
    one_hot = np.eye(states, dtype=np.float32)
    rows = ValueBatch(
        one_hot[at],
        direction[:, None].astype(np.float32),
        np.where(ends, 0.0, -1.0).astype(np.float32),
        np.where(ends, 0.0, discount).astype(np.float32),
        one_hot[after],
    )
    iql = IQL(states, 1, (32,))
    hyper = ValueHyper(learning_rate=3e-3, expectile=0.98, target_rate=0.05)

    @jax.jit
    def train(state):
        def step(state, key):
            index = jax.random.randint(key, (128,), 0, length)
            return iql.update(state, jax.tree.map(lambda x: jnp.asarray(x)[index], rows), hyper)[0], None

        return jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 2500))[0]

    state = train(iql.init(jax.random.key(0)))
    distance = states - 1 - np.arange(states)
    expected = -(1 - discount**distance) / (1 - discount)
    np.testing.assert_allclose(iql.value(state.value, jnp.eye(states)), expected, atol=0.25)


def make_model(config, env):
    sizes = {"encoder_hidden": 32, "encoder_layers": 1, "decoder_hidden": (32, 32), "prior_hidden": (32, 32)}
    return SkillModel(env.observation_size, env.action_size, replace(config.skills, **sizes))


def train_skills(config, weights=None, information=True, artifacts=None, chunks=None, spread=np.pi):
    env, dataset = PointEnv(), point_dataset(spread=spread)
    data, normaliser = to_device(dataset, config.skills.horizon)
    model = make_model(config, env)
    source = None
    if information:
        states = PhysicsRollout(env, model, normaliser, config.skills.horizon)
        if config.skills.mi_rollout == "logged":
            states = LoggedStates(config.skills.horizon)
        source = SegmentTerm(model, states)
    phase = bound(SkillPhase(config, model, weights or UniformWeights(), source), config, data)
    state, constants = phase.init(jax.random.split(jax.random.key(0), len(configs.members(config))), artifacts or {})
    metrics = {}
    for _ in range(chunks or phase.num_chunks):
        state, metrics = phase.chunk(state, constants)
    return env, model, normaliser, first_member(state.params), metrics, phase


def decodability(env, model, normaliser, params, config):
    """Share of the variance of a random skill that the posterior recovers from it, along states never trained on."""
    data, _ = to_device(point_dataset(seed=7), config.skills.horizon)
    rollout = LoggedStates(config.skills.horizon)
    if config.skills.mi_rollout == "physics":
        rollout = PhysicsRollout(env, model, normaliser, config.skills.horizon)
    keys = jax.random.split(jax.random.key(5), 2)
    starts = data.starts[jax.random.randint(keys[0], (256,), 0, data.starts.shape[0])]
    latent = jax.random.uniform(keys[1], (256, config.skills.latent_dim), minval=-2, maxval=2)
    observations = rollout(params, data, starts, latent)[:, :-1]
    repeated = jnp.broadcast_to(latent[:, None], (256, config.skills.horizon, latent.shape[-1]))
    actions = model.act(params, observations, repeated)
    recovered = model.encode(params, Segments(observations, actions)).mean
    return 1 - float(jnp.mean((recovered - latent) ** 2) / jnp.var(latent))


@pytest.mark.parametrize("rollout", ["physics", "logged"])
def test_mutual_information_raises_the_decodability_of_skills(rollout):
    # All walks of this data go the same way, so that a plain VAE has no use for its latent.
    values = {"skills.updates": 600, "skills.learning_rate": 2e-3, "skills.mi_rollout": rollout}
    without = point_config(**values)
    env, model, normaliser, params, _, _ = train_skills(without, information=False, spread=0.0)
    low = decodability(env, model, normaliser, params, without)
    with_it = point_config(**values, **{"skills.alpha": 1.0})
    env, model, normaliser, params, _, _ = train_skills(with_it, spread=0.0)
    high = decodability(env, model, normaliser, params, with_it)
    assert high > 0.6 and high > low + 0.2, (low, high)


def test_skills_reconstruct_what_the_data_does():
    config = point_config(**{"skills.updates": 800, "skills.learning_rate": 3e-3, "skills.kl_weight": 0.01})
    _env, model, _normaliser, params, _, _ = train_skills(config, information=False)
    data, _ = to_device(point_dataset(), config.skills.horizon)
    starts = data.starts[:500]
    rows = starts[:, None] + jnp.arange(config.skills.horizon)
    segments = Segments(data.observations[rows], data.actions[rows])
    latent = gaussian_sample(jax.random.key(0), *model.encode(params, segments))
    repeated = jnp.broadcast_to(latent[:, None], (500, config.skills.horizon, latent.shape[-1]))
    error = model.act(params, segments.observations, repeated) - segments.actions
    assert float(jnp.mean(error**2)) < 0.1 * float(jnp.var(segments.actions))


def value_phase(config):
    dataset = point_dataset()
    data, _ = to_device(dataset, config.skills.horizon)
    phase = bound(ValuePhase(config, IQL(2, 2, (64, 64)), updates_per_chunk=500), config, data)
    _, _, artifacts = run_phase(phase, jax.random.split(jax.random.key(0), 1), {})
    return dataset, data, phase, artifacts


@pytest.fixture(scope="module")
def values():
    config = point_config(
        **{
            "values.estimator": "iql",
            "values.updates": 1000,
            "values.learning_rate": 1e-3,
            "values.discount": 0.9,
            "values.target_rate": 0.02,
            "values.batch_size": 256,
            "values.hidden": [64, 64],
        }
    )
    return config, *value_phase(config)


def test_segment_advantages_tell_who_gains_ground(values):
    """Near the goal, where values differ; with the true values in V's place the correlation is 0.79."""
    config, dataset, data, _, artifacts = values
    starts = np.asarray(data.starts)
    distance = np.linalg.norm(dataset.qpos - GOAL, axis=-1)
    after = np.linalg.norm(dataset.next_observations - GOAL, axis=-1)
    gain = distance[starts] - after[starts + config.skills.horizon - 1]
    advantage = np.asarray(artifacts["advantage"][0])
    near = (distance[starts] < 1.2) & (dataset.masks[starts] > 0)
    assert advantage.std() == pytest.approx(1.0, abs=1e-2)
    assert np.corrcoef(gain[near], advantage[near])[0, 1] > 0.5


def test_weighted_skills_learn_the_weighted_behaviour(values):
    config, _, _, _, artifacts = values
    _, _, _, _, uniform, _ = train_skills(config, information=False, chunks=1)
    _, _, _, _, weighted, _ = train_skills(config, LoggedWeights(), information=False, artifacts=artifacts, chunks=1)
    assert float(uniform["weight_ess"][0]) == pytest.approx(1.0, abs=1e-5)
    assert 0.1 < float(weighted["weight_ess"][0]) < 0.95


def test_latent_weights_learn_along(values):
    config, _, _, _, artifacts = values
    weights = LatentWeights(2, 2, (64, 64), "rank")
    _, _, _, _, metrics, _ = train_skills(config, weights, artifacts=artifacts)
    assert 0.1 < float(metrics["weight_ess"][0]) < 0.99 and np.isfinite(metrics["vae_loss"]).all()


def test_chunks_are_not_traced_again_and_members_differ_by_seed_and_value():
    config = configs.replace(point_config(), **{"seed": (0, 1), "skills.alpha": (0.1, 0.3)})
    env = PointEnv()
    data, normaliser = to_device(point_dataset(), config.skills.horizon)
    model = make_model(config, env)
    source = SegmentTerm(model, PhysicsRollout(env, model, normaliser, config.skills.horizon))
    phase = bound(SkillPhase(config, model, UniformWeights(), source, blocks_per_chunk=2), config, data)
    seeds = np.array([member["seed"] for member in configs.members(config)], np.uint32)
    state, constants = phase.init(jax.vmap(jax.random.key)(seeds), {})
    leaf = partial(lambda s: np.asarray(jax.tree.leaves(s.params["decoder"])[1]))
    first = leaf(state)
    np.testing.assert_array_equal(first[0], first[1])  # seed 0 with either alpha starts the same
    assert not np.array_equal(first[0], first[2])
    state, _ = phase.chunk(state, constants)
    traced = phase._chunk.compiled._cache_size()
    state, _ = phase.chunk(state, constants)
    assert phase._chunk.compiled._cache_size() == traced == 1
    last = leaf(state)
    assert not np.array_equal(last[0], last[1]) and not np.array_equal(last[0], last[2])
