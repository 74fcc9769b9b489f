"""SAC: losses against numbers derived by hand, and a task whose optimum is known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.config import HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.sac import SAC, SACHyper
from qdos_brax.nn.networks import gaussian_log_prob
from qdos_brax.nn.optim import ADAM, adam_step

HYPER = SACHyper(learning_rate=3e-3, discount=0.9, target_rate=0.05, target_entropy=-1.0)


def make_batch(key, size=16):
    keys = jax.random.split(key, 5)
    return Transition(
        jax.random.normal(keys[0], (size, 3)),
        jnp.tanh(jax.random.normal(keys[1], (size, 2))),
        jax.random.normal(keys[2], (size,)),
        (jax.random.uniform(keys[3], (size,)) < 0.7).astype(jnp.float32),
        jax.random.normal(keys[4], (size, 3)),
    )


@pytest.fixture(scope="module")
def sac():
    return SAC(3, 2, HighLevelConfig(hidden=(8, 8), ensemble=4, target_subset=2))


def test_critic_loss_sums_over_critics_and_means_over_the_batch(sac):
    state = sac.init(jax.random.key(0), 0.1)
    batch = make_batch(jax.random.key(1))
    target = jnp.arange(16.0)
    q = np.asarray(sac.values(state.critic, batch.observation, batch.action))
    by_hand = sum(np.mean((q[i] - np.arange(16.0)) ** 2) for i in range(4))
    np.testing.assert_allclose(sac.critic_loss(state.critic, batch, target), by_hand, rtol=1e-5)


def test_target_is_the_minimum_over_two_of_the_target_heads_and_masks_cut_it(sac):
    state = sac.init(jax.random.key(0), 0.1)
    # Heads that say 10, 20, 30, 40 whatever they see: the subset's minimum is one of 10, 20, 30.
    last = "Dense_2"
    target = jax.tree.map(jnp.zeros_like, state.target_critic)
    inner = target["params"]["VmapMLP_0"]
    inner[last]["bias"] = jnp.array([[10.0], [20.0], [30.0], [40.0]])
    state = state.replace(target_critic=target)
    seen = set()
    for seed in range(40):
        value = np.asarray(sac.target_value(state, jax.random.key(seed), jnp.zeros((2, 3))))
        assert value[0] == value[1]
        seen.add(float(value[0]))
    assert seen == {10.0, 20.0, 30.0}
    batch = make_batch(jax.random.key(1))
    _, info = sac.update_critic(state, batch, jax.random.key(2), HYPER)
    values = np.asarray(sac.target_value(state, jax.random.key(2), batch.next_observation))
    expected = np.mean(np.asarray(batch.reward) + 0.9 * np.asarray(batch.mask) * values)
    np.testing.assert_allclose(info["q"], expected, rtol=1e-5)


def test_polyak_step_by_hand(sac):
    state = sac.init(jax.random.key(0), 0.1)
    state = state.replace(target_critic=jax.tree.map(jnp.zeros_like, state.target_critic))
    new, _ = sac.update_critic(state, make_batch(jax.random.key(1)), jax.random.key(2), HYPER)
    for target, critic in zip(jax.tree.leaves(new.target_critic), jax.tree.leaves(new.critic), strict=True):
        np.testing.assert_allclose(target, 0.05 * critic, rtol=1e-5, atol=1e-9)


def test_actor_loss_is_temperature_times_log_density_minus_mean_q(sac):
    state = sac.init(jax.random.key(0), 0.1)
    observation = jax.random.normal(jax.random.key(1), (16, 3))
    key = jax.random.key(5)
    loss, entropy = sac.actor_loss(state.actor, state.critic, 0.3, observation, key)
    action = sac.act(state.actor, key, observation)
    mean, log_std = sac.actor.apply(state.actor, observation)
    log_prob = gaussian_log_prob(jnp.arctanh(action), mean, log_std) - jnp.sum(jnp.log(1 - action**2), axis=-1)
    q = sac.values(state.critic, observation, action).mean(axis=0)
    np.testing.assert_allclose(loss, jnp.mean(0.3 * log_prob - q), rtol=1e-4)
    np.testing.assert_allclose(entropy, -jnp.mean(log_prob), rtol=1e-4)


def test_temperature_rises_when_entropy_is_below_its_target(sac):
    state = sac.init(jax.random.key(0), 0.1)
    zeros = jnp.zeros(4)
    batch = Transition(jnp.zeros((4, 3)), zeros, zeros, zeros, zeros)  # the actor reads the observations alone
    for target, sign in ((100.0, 1), (-100.0, -1)):
        new, _ = sac.update_actor(state, batch, jax.random.key(0), HYPER.replace(target_entropy=target))
        assert np.sign(float(new.log_temperature - state.log_temperature)) == sign


def test_adam_step_is_the_published_first_step():
    # The first step of Adam is -learning_rate * sign(grad), up to epsilon.
    params, grads = jnp.array([1.0, 2.0]), jnp.array([0.5, -3.0])
    new, _ = adam_step(params, ADAM.init(params), grads, 0.1)
    np.testing.assert_allclose(new, [0.9, 2.1], rtol=1e-5)


def test_a_value_scale_is_the_same_learner_in_other_units(sac):
    """Rewards times 20 at scale 20: the networks' targets, and so Adam's steps, are those of rewards at scale 1."""
    scaled = SAC(3, 2, HighLevelConfig(hidden=(8, 8), ensemble=4, target_subset=2, value_scale=20.0))
    state, batch, key = sac.init(jax.random.key(0), 0.1), make_batch(jax.random.key(1)), jax.random.key(2)
    plain_values = sac.values(state.critic, batch.observation, batch.action)
    scaled_values = scaled.values(state.critic, batch.observation, batch.action)
    np.testing.assert_allclose(scaled_values, 20.0 * plain_values, rtol=1e-6)
    plain, plain_info = sac.update_critic(state, batch, key, HYPER)
    other, scaled_info = scaled.update_critic(state, batch._replace(reward=20.0 * batch.reward), key, HYPER)
    np.testing.assert_allclose(scaled_info["q"], 20.0 * plain_info["q"], rtol=1e-5)
    for expected, found in zip(jax.tree.leaves(plain.critic), jax.tree.leaves(other.critic), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


def test_with_a_value_scale_critics_reach_large_values_sooner():
    """Every episode ends at once with -300, so Q is -300 everywhere."""

    def values_after(scale, steps=150):
        sac = SAC(3, 2, HighLevelConfig(hidden=(32, 32), ensemble=2, target_subset=1, value_scale=scale))
        batch = make_batch(jax.random.key(1))
        batch = batch._replace(reward=jnp.full(16, -300.0), mask=jnp.zeros(16))

        def step(state, key):
            return sac.update_critic(state, batch, key, HYPER)[0], None

        keys = jax.random.split(jax.random.key(2), steps)
        state = jax.jit(lambda state: jax.lax.scan(step, state, keys)[0])(sac.init(jax.random.key(0), 0.1))
        return np.asarray(sac.values(state.critic, batch.observation, batch.action))

    np.testing.assert_allclose(values_after(20.0), -300.0, rtol=0.1)
    assert (values_after(1.0) > -200.0).all()


def test_sac_reaches_the_known_optimum_of_a_point_task():
    """x' = x + 0.5 u, reward -x'^2 on x in [-1, 1]: the optimum is u = -2 x clipped, the return near 0."""
    sac = SAC(1, 1, HighLevelConfig(hidden=(32, 32), ensemble=2, target_subset=1))
    hyper = HYPER.replace(discount=0.5, target_entropy=-2.0)
    keys = jax.random.split(jax.random.key(0), 4)
    x = jax.random.uniform(keys[0], (2048, 1), minval=-1.0)
    u = jax.random.uniform(keys[1], (2048, 1), minval=-1.0)
    after = jnp.clip(x + 0.5 * u, -1, 1)
    rows = Transition(x, u, -10 * after[:, 0] ** 2, jnp.ones(2048), after)

    @jax.jit
    def train(state, key):
        def step(state, key):
            index_key, critic_key, actor_key = jax.random.split(key, 3)
            index = jax.random.randint(index_key, (64,), 0, 2048)
            batch = jax.tree.map(lambda a: a[index], rows)
            state, _ = sac.update_critic(state, batch, critic_key, hyper)
            state, _ = sac.update_actor(state, batch, actor_key, hyper)
            return state, None

        return jax.lax.scan(step, state, jax.random.split(key, 1500))[0]

    state = train(sac.init(keys[2], 0.1), keys[3])
    probe = jnp.linspace(-0.4, 0.4, 9)[:, None]
    reached = probe + 0.5 * sac.mode(state.actor, probe)
    assert float(jnp.max(jnp.abs(reached))) < 0.1, np.asarray(reached).ravel()
    assert float(jnp.max(jnp.abs(probe))) == pytest.approx(0.4)


def test_seeds_differ_and_repeat(sac):
    run = jax.jit(partial(sac.init, init_temperature=0.1))
    first, again, other = run(jax.random.key(0)), run(jax.random.key(0)), run(jax.random.key(1))
    pairs = list(zip(jax.tree.leaves(first.actor), jax.tree.leaves(other.actor), strict=True))
    assert any(not np.array_equal(a, b) for a, b in pairs)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
