"""Behaviour cloning against the empirical distribution of the actions in each state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.config import PolicyConfig
from qdos_brax.nn.optim import ADAM, adam_step
from qdos_brax.offline.bc import BC
from qdos_brax.offline.policy import GaussianPolicy, weighted_imitation_loss
from tests.offline.gridworld import device_data
from tests.offline.training import train_members

STATES = 5

SIZES = PolicyConfig(hidden=(32,), batch_size=256)


@pytest.fixture(scope="module")
def logged():
    """In state s the first action dimension is +0.8 with frequency (s + 1) / 7, else -0.8; the second is noise."""
    rng = np.random.default_rng(0)
    state = rng.integers(0, STATES, 2000)
    first = np.where(rng.random(2000) < (state + 1) / 7, 0.8, -0.8)
    action = np.stack([first, np.clip(0.2 * rng.normal(size=2000), -1, 1)], axis=-1)
    return state, action, device_data(np.eye(STATES)[state], action)


def test_a_gaussian_policy_has_the_empirical_means_and_spread(logged):
    state, action, data = logged
    learner = BC(STATES, 2, SIZES)
    # Two members of a population: the second does not learn, and must stay as it was.
    both = train_members(learner, data, {"policy.learning_rate": np.array([3e-3, 0.0])}, 1500)
    mean, log_std = jax.jit(jax.vmap(learner.policy.apply, in_axes=(0, None)))(both.actor, jnp.eye(STATES))
    empirical = np.stack([action[state == s].mean(axis=0) for s in range(STATES)])
    np.testing.assert_allclose(mean[0], empirical, atol=0.08)
    # The likeliest common deviation is the root mean square of the residuals of all states together.
    residual = action - empirical[state]
    np.testing.assert_allclose(np.exp(log_std[0]), np.sqrt((residual**2).mean(axis=0)), rtol=0.05)
    # The frequencies of +0.8, read off the mean: p = (1 + mean / 0.8) / 2.
    frequency = [(action[state == s, 0] > 0).mean() for s in range(STATES)]
    np.testing.assert_allclose((1 + mean[0, :, 0] / 0.8) / 2, frequency, atol=0.05)
    np.testing.assert_array_equal(log_std[1], 0)
    assert not np.allclose(mean[1], empirical, atol=0.3)


@pytest.mark.slow
def test_a_deterministic_policy_is_least_squares(logged):
    state, action, _ = logged
    policy, observation = GaussianPolicy((32,), 2, learned_std=False), jnp.eye(STATES)[state]

    def step(learned, _):
        params, opt_state = learned
        grads = jax.grad(weighted_imitation_loss, argnums=1)(policy, params, observation, action, 1.0)
        return adam_step(params, opt_state, grads, 3e-3), None

    params = policy.init(jax.random.key(0), observation)
    trained, _ = jax.jit(lambda learned: jax.lax.scan(step, learned, length=1500)[0])((params, ADAM.init(params)))
    empirical = np.stack([action[state == s].mean(axis=0) for s in range(STATES)])
    np.testing.assert_allclose(policy.apply(trained, jnp.eye(STATES))[0], empirical, atol=0.08)


def test_without_a_learned_deviation_likelihood_is_least_squares() -> None:
    """-log N(a; mean, 1) is half the squared error plus log(2 pi) for two dimensions."""
    policy, rng = GaussianPolicy((8,), 2, learned_std=False), np.random.default_rng(0)
    observation, action = rng.normal(size=(6, STATES)), rng.uniform(-1, 1, (6, 2))
    weight = np.array([0.0, 1.0, 0.5, 2.0, 1.0, 0.1])
    params = policy.init(jax.random.key(0), observation)
    error = np.sum((np.asarray(policy.apply(params, observation)[0]) - action) ** 2, axis=-1)
    loss = weighted_imitation_loss(policy, params, observation, action, weight)
    np.testing.assert_allclose(loss, np.mean(weight * (error / 2 + np.log(2 * np.pi))), rtol=1e-5)
