"""Diffusion over actions: the schedule's closed forms, and a set with two modes that a Gaussian cannot keep apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.config import GuideConfig
from qdos_brax.offline.diffusion import DiffusionBC, add_noise, variance_preserving_schedule
from tests.offline.gridworld import device_data
from tests.offline.training import train

MODE = 0.6


@pytest.mark.parametrize("steps", [5, 20])
def test_alpha_bars_are_the_products_that_the_closed_form_says(steps):
    schedule = variance_preserving_schedule(steps)
    k = np.arange(1, steps + 1)
    np.testing.assert_allclose(np.cumprod(1 - np.asarray(schedule.beta)), schedule.alpha_bar, rtol=1e-4)
    # IDQL's discrete form: log(1 - beta_k) = -0.1 / K - (10 - 0.1) (2k - 1) / (2 K^2).
    np.testing.assert_allclose(
        np.log1p(-np.asarray(schedule.beta)), -0.1 / steps - 4.95 * (2 * k - 1) / steps**2, rtol=1e-4
    )
    assert float(schedule.alpha_bar[-1]) == pytest.approx(np.exp(-5.05), rel=1e-4)
    # Ho et al. 2020, eq. 7; the last step back adds no noise.
    before = np.append(1, schedule.alpha_bar[:-1])
    variance = (1 - before) / (1 - np.asarray(schedule.alpha_bar)) * np.asarray(schedule.beta)
    np.testing.assert_allclose(np.asarray(schedule.posterior_std) ** 2, variance, rtol=1e-3, atol=1e-7)
    assert schedule.posterior_std[0] == 0


def test_noise_in_steps_has_the_moments_of_noise_at_once():
    steps, schedule = 5, variance_preserving_schedule(5)
    rng, action = np.random.default_rng(0), np.full(100_000, 0.7)
    noisy = action.copy()
    for k in range(steps):
        beta = float(schedule.beta[k])
        noisy = np.sqrt(1 - beta) * noisy + np.sqrt(beta) * rng.normal(size=noisy.shape)
        at_once = add_noise(schedule, jnp.full((1, 1), 0.7), jnp.array([k]), jnp.array([[2.0]]))
        left = float(schedule.alpha_bar[k])
        mean = np.sqrt(left) * 0.7
        assert noisy.mean() == pytest.approx(mean, abs=0.01)
        assert noisy.var() == pytest.approx(1 - left, rel=0.02)
        assert float(at_once[0, 0]) == pytest.approx(mean + 2 * np.sqrt(1 - left), rel=1e-5)


def two_modes(rows=4000):
    """Observation +1: actions (0.6, 0) with share 0.7, else (-0.6, 0); observation -1: share 0.2; spread 0.05."""
    rng = np.random.default_rng(0)
    observation = rng.choice([-1.0, 1.0], rows)
    share = np.where(observation > 0, 0.7, 0.2)
    first = np.where(rng.random(rows) < share, MODE, -MODE)
    action = np.stack([first, np.zeros(rows)], axis=-1) + 0.05 * rng.normal(size=(rows, 2))
    return observation[:, None], action


def mode_shares(samples):
    """(share near the mode at +0.6, share near that at -0.6) of samples[..., 2]; near: within 0.2."""
    near = lambda sign: np.linalg.norm(samples - np.array([sign * MODE, 0.0]), axis=-1) < 0.2  # noqa: E731
    return near(1).mean(), near(-1).mean()


def sampled(learner, state):
    """2,000 actions of each observation, +1 first: [2, 2000, act]."""
    seen = jnp.repeat(jnp.array([[1.0], [-1.0]]), 2000, axis=0)
    return np.asarray(jax.jit(learner.sample)(learner.params(state), jax.random.key(1), seen)).reshape(2, 2000, -1)


@pytest.mark.slow
def test_both_modes_keep_their_shares_which_no_gaussian_can():
    observation, action = two_modes()
    learner = DiffusionBC(1, 2, GuideConfig(hidden=32, steps=10, batch_size=256), blocks=2, dropout=0.0)
    hyper = {"guide.learning_rate": 3e-3, "guide.average_rate": 0.01}
    state, _ = train(learner, device_data(observation, action), hyper, 2500)
    rng = np.random.default_rng(1)
    for seen, samples in zip((1, -1), sampled(learner, state), strict=True):
        logged = action[observation[:, 0] == seen]
        plus, minus = mode_shares(samples)
        gaussian = mode_shares(logged.mean(axis=0) + logged.std(axis=0) * rng.normal(size=(2000, 2)))
        print(f"observation {seen}: data {mode_shares(logged)}, diffusion {plus, minus}, likeliest Gaussian {gaussian}")
        share = mode_shares(logged)[0] / sum(mode_shares(logged))
        assert plus + minus > 0.85 > 0.5 > sum(gaussian)
        assert plus / (plus + minus) == pytest.approx(share, abs=0.08)
        assert np.abs(samples).max() <= 1
