"""Flows: Euler's method against closed forms, the loss by hand, and chunks of actions in and out of noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qdos_brax.nn.flow import recover, transport
from qdos_brax.offline.flow_bc import FlowBC
from qdos_brax.skills.chunks import ActionChunks, NoiseChunks
from qdos_brax.skills.flow_policy import FlowPolicy, noise_at
from qdos_brax.skills.vae import Segments
from tests.offline.gridworld import device_data
from tests.offline.test_diffusion import mode_shares, two_modes
from tests.offline.training import train


def test_euler_steps_have_their_closed_forms() -> None:
    start = jnp.array([[1.0, -2.0]])
    np.testing.assert_allclose(transport(lambda x, t: -x, start, 4), 0.75**4 * start, rtol=1e-6)
    # v = t: the times are 0, 1/4, 2/4, 3/4, each for a quarter.
    np.testing.assert_allclose(transport(lambda x, t: t[..., None] * jnp.ones(2), start, 4), start + 0.375, rtol=1e-6)
    field = lambda x, t: jnp.sin(x) + t[..., None]  # noqa: E731
    np.testing.assert_allclose(recover(field, transport(field, start, 10), 10), start, atol=2e-4)


def policy(dim: int) -> tuple[FlowPolicy, dict]:
    """A flow of constant velocity 0.25 over ``dim`` numbers, with its parameters."""
    flow = FlowPolicy(3, dim, (4,), 5)
    params = jax.tree.map(jnp.zeros_like, flow.init(jax.random.key(0)))
    params["params"]["Dense_1"]["bias"] += 0.25
    return flow, params


def test_the_loss_is_the_squared_error_of_the_velocity() -> None:
    flow, params = policy(2)
    action, noise = jnp.array([[0.5, -0.5]]), jnp.array([[1.0, 0.0]])
    loss = flow.loss_at(params, jnp.zeros((1, 3)), action, noise, jnp.array([0.3]))
    # velocities wanted: -0.5 and -0.5; given: 0.25 and 0.25
    np.testing.assert_allclose(loss, (0.75**2 + 0.75**2) / 2, rtol=1e-6)
    played = flow.play(params, jnp.zeros((1, 3)), jnp.array([[0.5, 0.9]]))
    np.testing.assert_allclose(played, [[0.75, 1.0]], rtol=1e-6)  # clipped once, at the end


def test_noise_of_an_evaluation_is_gaussian_and_repeats() -> None:
    observations = jax.random.normal(jax.random.key(0), (4000, 3))
    noise = jax.vmap(lambda one: noise_at(one, (2,)))(observations)
    np.testing.assert_array_equal(noise, jax.vmap(lambda one: noise_at(one, (2,)))(observations))
    np.testing.assert_allclose([noise.mean(), noise.std()], [0.0, 1.0], atol=0.05)
    assert abs(np.corrcoef(np.asarray(noise).T)[0, 1]) < 0.06


def test_a_chunk_is_played_action_by_action() -> None:
    source = ActionChunks(2, horizon=3)
    keys = jax.random.split(jax.random.key(0), 2)
    segments = Segments(jnp.zeros((4, 3, 3)), jax.random.uniform(keys[0], (4, 3, 2), minval=-0.9, maxval=0.9))
    label = source.to_action({}, source.posterior({}, segments, jnp.zeros((4, 3))).mean, jnp.zeros((4, 3)), 2.0)
    skill = source.begin({}, source.to_latent({}, label, jnp.zeros((4, 3)), 2.0), jnp.zeros((4, 3)))
    for step in range(3):
        np.testing.assert_array_equal(source.act({}, jnp.zeros((4, 3)), skill, step), segments.actions[:, step])


def test_noise_that_is_read_off_a_chunk_plays_it_again() -> None:
    flow = FlowPolicy(3, 4, (16,), 5)
    source, params = NoiseChunks(flow, 2), {"flow": flow.init(jax.random.key(1))}
    observations = jax.random.normal(jax.random.key(2), (6, 2, 3))
    noise = jax.random.uniform(jax.random.key(3), (6, 4), minval=-0.4, maxval=0.4)
    chunk = flow.play(params["flow"], observations[:, 0], noise)
    assert np.abs(chunk).max() < 1
    segments = Segments(observations, chunk.reshape(6, 2, 2))
    found = source.posterior(params, segments, observations[:, 0]).mean
    np.testing.assert_allclose(found, noise, atol=1e-3)
    action = source.to_action(params, found, observations[:, 0], 1.5)
    skill = source.begin(params, source.to_latent(params, action, observations[:, 0], 1.5), observations[:, 0])
    for step in range(2):
        played = source.act(params, observations[:, 1], skill, step)
        np.testing.assert_allclose(played, segments.actions[:, step], atol=1e-3)
    u = jnp.linspace(-1, 1, 20_001)[:, None]
    density = jnp.exp(NoiseChunks(FlowPolicy(3, 1, (4,), 5), 1).log_prior({}, u, jnp.zeros((len(u), 3)), 2.0))
    np.testing.assert_allclose(jnp.trapezoid(density, u[:, 0]), 0.9545, atol=1e-3)  # two standard deviations


@pytest.mark.slow
def test_both_modes_keep_their_shares() -> None:
    """The test of diffusion (tests/offline/test_diffusion.py), at as many steps."""
    observation, action = two_modes()
    learner = FlowBC(FlowPolicy(1, 2, (64, 64), 10), 1, 256)
    state, _ = train(learner, device_data(observation, action), {"flow.learning_rate": 3e-3}, 2500)
    for seen in (1, -1):
        noise = jax.random.normal(jax.random.key(5), (2000, 2))
        samples = np.asarray(learner.flow.play(state.flow, jnp.full((2000, 1), seen, jnp.float32), noise))
        plus, minus = mode_shares(samples)
        data = mode_shares(action[observation[:, 0] == seen])
        print(f"observation {seen}: data {data}, flow {plus, minus}")
        assert plus + minus > 0.85 and abs(plus / (plus + minus) - data[0] / sum(data)) < 0.08
