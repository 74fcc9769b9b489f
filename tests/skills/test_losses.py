"""Values, weights and the VAE against numbers derived by hand or by an independent formula."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax import config as configs
from qdos_brax.data.dataset import Dataset
from qdos_brax.data.device import Normaliser, to_device
from qdos_brax.nn.networks import gaussian_kl, gaussian_sample
from qdos_brax.skills.vae import Segments, SkillModel
from qdos_brax.skills.value_phase import sample_batch
from qdos_brax.skills.values import IQL, ValueBatch, expectile_loss
from qdos_brax.skills.weights import (
    advantage_weights,
    normal_scores,
    scaled_advantage,
    segment_advantage,
    transition_advantage,
)


def test_expectile_loss_by_hand():
    np.testing.assert_allclose(expectile_loss(jnp.array([2.0, -2.0, 0.0]), 0.9), [3.6, 0.4, 0.0], rtol=1e-6)


def test_the_minimiser_of_the_expectile_loss_is_the_expectile():
    # For half 0, half 1 the expectile m solves tau (1 - m) = (1 - tau) m, so m = tau.
    grid = jnp.linspace(0, 1, 1001)
    loss = jax.vmap(lambda m: expectile_loss(jnp.array([0.0, 1.0]) - m, 0.9).mean())(grid)
    assert float(grid[jnp.argmin(loss)]) == pytest.approx(0.9, abs=2e-3)


def test_critic_target_is_the_n_step_return():
    iql = IQL(2, 1, (4,))
    state = iql.init(jax.random.key(0))
    batch = ValueBatch(
        jnp.ones((2, 2)), jnp.zeros((2, 1)), jnp.array([-3.0, -1.0]), jnp.array([0.9**4, 0.0]), 2 * jnp.ones((2, 2))
    )
    value = float(iql.value(state.value, 2 * jnp.ones(2)))
    q = np.asarray(iql.q(state.critic, batch.observation, batch.action))
    target = np.array([-3 + 0.9**4 * value, -1.0])
    expected = np.mean((q[0] - target) ** 2) + np.mean((q[1] - target) ** 2)
    np.testing.assert_allclose(iql.critic_loss(state.critic, state.value, batch), expected, rtol=1e-5)


def test_values_see_every_row_and_an_episodes_last_ones_too():
    """Episodes of 4 and 3 rows, two-step returns at discount 1/2; the first episode ends in success, at its last row.

    Of a method whose segments are longer than the return (here 3 rows), the last rows count as well.
    """
    rows = np.arange(7, dtype=np.float32)
    dataset = Dataset(
        observations=rows[:, None],
        actions=np.zeros((7, 1), np.float32),
        rewards=np.array([-1, -2, -3, 0, -5, -6, -7], np.float32),
        masks=np.array([1, 1, 1, 0, 1, 1, 1], np.float32),
        ends=np.array([0, 0, 0, 1, 0, 0, 1], bool),
        next_observations=rows[:, None] + 1,
    )
    data, _ = to_device(dataset, 3, Normaliser(jnp.zeros(1), jnp.ones(1)))
    batch = jax.tree.map(np.asarray, sample_batch(data, jax.random.key(0), 7000, 2, 0.5))
    row = batch.observation[:, 0].astype(int)
    assert np.bincount(row, minlength=7).min() > 800
    np.testing.assert_array_equal(batch.reward, np.array([-2, -3.5, -3, 0, -8, -9.5, -7])[row])
    np.testing.assert_array_equal(batch.discount, np.array([0.25, 0.25, 0, 0, 0.25, 0.25, 0.5])[row])
    np.testing.assert_array_equal(batch.next_observation[:, 0], np.array([2, 3, 4, 4, 6, 7, 7])[row])


def test_advantages_by_hand():
    np.testing.assert_allclose(segment_advantage(jnp.array([-2.0]), 0.5, jnp.array([-4.0]), jnp.array([-5.0])), [1.0])
    np.testing.assert_allclose(
        transition_advantage(jnp.array([[1.0, 2.0, 3.0]]), jnp.array([[0.0, 3.0, 3.0]])), [0.0], atol=1e-7
    )


def test_normal_scores_by_hand():
    # Mid-ranks of 4 lie at 1/8, 3/8, 5/8, 7/8; the normal quantiles there are -1.15035, -0.31864 and their mirrors.
    scores = normal_scores(jnp.array([1e6, -3.0, 0.0, 0.1]))
    np.testing.assert_allclose(scores, [1.15035, -1.15035, -0.31864, 0.31864], atol=1e-4)
    np.testing.assert_allclose(normal_scores(jnp.array([5.0, 5.0, 7.0])), [-0.43073, -0.43073, 0.96742], atol=1e-4)
    np.testing.assert_allclose(normal_scores(jnp.full(5, -20.0)), 0.0, atol=1e-6)


def test_rank_scaled_weights_keep_their_effective_share_whatever_the_tails():
    # exp(x / lambda) of a standard normal x: (E w)^2 / E w^2 = exp(-1 / lambda^2).
    heavy = jnp.asarray(np.random.default_rng(0).standard_cauchy(20_000), jnp.float32)
    for temperature in (1.0, 2.0):
        weight = np.asarray(advantage_weights(scaled_advantage(heavy, "rank"), temperature, 1e9))
        share = weight.sum() ** 2 / np.square(weight).sum() / len(weight)
        assert share == pytest.approx(np.exp(-1 / temperature**2), rel=0.02)
    by_spread = np.asarray(advantage_weights(scaled_advantage(heavy, "std"), 1.0, 1e9))
    assert by_spread.sum() ** 2 / np.square(by_spread).sum() / len(by_spread) < 0.01


def test_weights_by_hand():
    # exp(0), exp(log 3) have mean 2, so the weights are 1/2 and 3/2; lambda 2 takes the root of the ratio.
    np.testing.assert_allclose(advantage_weights(jnp.array([0.0, jnp.log(3.0)]), 1.0, 20.0), [0.5, 1.5], rtol=1e-6)
    ratio = advantage_weights(jnp.array([0.0, jnp.log(3.0)]), 2.0, 20.0)
    np.testing.assert_allclose(ratio[1] / ratio[0], np.sqrt(3), rtol=1e-5)


def test_weights_are_clipped_and_never_overflow():
    weight = advantage_weights(jnp.array([1e4] + [0.0] * 99), 0.1, 20.0)
    np.testing.assert_allclose(weight[0], 20.0)
    assert np.all(np.isfinite(weight))


def test_no_gradient_passes_through_the_weights():
    grad = jax.grad(lambda a: jnp.sum(advantage_weights(a, 1.0, 20.0) * jnp.arange(3.0)))(jnp.array([0.0, 1.0, 2.0]))
    np.testing.assert_array_equal(grad, 0.0)


@pytest.fixture(scope="module")
def model():
    return SkillModel(
        3,
        2,
        configs.SkillsConfig(latent_dim=2, encoder_hidden=8, encoder_layers=1, decoder_hidden=(8,), prior_hidden=(8,)),
    )


@pytest.fixture(scope="module")
def segments():
    keys = jax.random.split(jax.random.key(0), 2)
    return Segments(jax.random.normal(keys[0], (4, 5, 3)), jnp.tanh(jax.random.normal(keys[1], (4, 5, 2))))


@pytest.mark.parametrize("kl_weighted", [True, False])
def test_vae_loss_is_the_papers_formula(model, segments, kl_weighted):
    params = model.init(jax.random.key(1))
    weight = jnp.array([0.5, 1.5, 2.0, 0.0])
    key = jax.random.key(2)
    loss, _ = model.vae_loss(params, segments, weight, 0.2, key, kl_weighted)

    posterior = model.encode(params, segments)
    latent = gaussian_sample(key, *posterior)
    kl = gaussian_kl(*posterior, *model.prior(params, segments.observations[:, 0]))
    total = 0.0
    for i in range(4):
        log_likelihood = 0.0
        for t in range(5):
            mean, log_std = model.decode(params, segments.observations[i, t], latent[i])
            error = (segments.actions[i, t] - mean) / jnp.exp(log_std)
            log_likelihood += float(jnp.sum(-0.5 * error**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)))
        total += 0.2 * float(kl[i]) * (float(weight[i]) if kl_weighted else 1.0) - float(weight[i]) * log_likelihood
    np.testing.assert_allclose(loss, total / 4, rtol=1e-4)


def test_information_loss_is_the_weighted_squared_error_of_the_recovered_skill(model, segments):
    params = model.init(jax.random.key(1))
    latent = jax.random.uniform(jax.random.key(3), (4, 2), minval=-2, maxval=2)
    weight = jnp.array([0.5, 1.5, 2.0, 0.0])
    actions = jnp.stack(
        [jnp.stack([model.decode(params, segments.observations[i, t], latent[i])[0] for t in range(5)])
         for i in range(4)]
    )  # fmt: skip
    recovered = model.encode(params, Segments(segments.observations, actions)).mean
    expected = np.mean(np.asarray(weight) * np.sum((np.asarray(recovered) - np.asarray(latent)) ** 2, axis=1))
    np.testing.assert_allclose(
        model.information_loss(params, segments.observations, latent, weight), expected, rtol=1e-5
    )


def test_the_gradient_of_the_information_loss_reaches_the_decoder_and_not_the_states(model, segments):
    params = model.init(jax.random.key(1))
    latent, weight = jnp.ones((4, 2)), jnp.ones(4)
    grads = jax.grad(model.information_loss)(params, segments.observations, latent, weight)
    assert max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(grads["decoder"])) > 0
    assert max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(grads["encoder"])) > 0
    to_states = jax.grad(model.information_loss, argnums=1)(params, segments.observations, latent, weight)
    np.testing.assert_array_equal(to_states, 0.0)
