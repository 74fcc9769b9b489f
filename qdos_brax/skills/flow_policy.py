"""A flow policy: noise carried to the data's actions, or to chunks of them, by a velocity field that clones behaviour.

Rectified flow matching with straight paths and Euler steps, as in FQL (Park, Li, Levine 2025, arXiv 2502.02538,
eq. 4 and Algorithm 1) and Q-chunking (Li, Zhou, Levine 2025, arXiv 2507.07969): 4 layers of 512 units with GELU, 10
steps, one clip into the action box at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from qdos_brax.nn.flow import VelocityField, recover, transport

Params = Any


class FlowPolicy:
    """Turn noise into actions.

    Args:
        observation_dim: width of observations.
        action_dim: width of what is played: an action, or a chunk of H of them.
        hidden: hidden widths of the velocity field.
        steps: of Euler's method.
    """

    def __init__(self, observation_dim: int, action_dim: int, hidden: Sequence[int], steps: int) -> None:
        self.observation_dim, self.action_dim, self.steps = observation_dim, action_dim, steps
        self._field = VelocityField(hidden, action_dim)

    def init(self, key: jax.Array) -> Params:
        """Return fresh parameters."""
        observation, action = jnp.zeros((1, self.observation_dim)), jnp.zeros((1, self.action_dim))
        return self._field.init(key, observation, action, jnp.zeros(1))

    def loss(self, params: Params, observation: jax.Array, action: jax.Array, key: jax.Array) -> jax.Array:
        """Return mean ||v(s, x_t, t) - (a - x_0)||^2 / dim with x_t = (1 - t) x_0 + t a, one x_0 and t per row[B]."""
        noise_key, time_key = jax.random.split(key)
        noise = jax.random.normal(noise_key, action.shape)
        time = jax.random.uniform(time_key, action.shape[:-1])
        return self.loss_at(params, observation, action, noise, time)

    def loss_at(
        self, params: Params, observation: jax.Array, action: jax.Array, noise: jax.Array, time: jax.Array
    ) -> jax.Array:
        """Return the loss at noise[B, dim] and time[B]."""
        between = (1 - time[..., None]) * noise + time[..., None] * action
        velocity = self._field.apply(params, observation, between, time)
        return jnp.mean((velocity - (action - noise)) ** 2)

    def play(self, params: Params, observation: jax.Array, noise: jax.Array) -> jax.Array:
        """Return the action[..., dim] in [-1, 1] that noise[..., dim] becomes at observation[..., obs]."""
        return jnp.clip(transport(partial(self._velocity, params, observation), noise, self.steps), -1.0, 1.0)

    def recover(self, params: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Return noise[..., dim] that becomes action[..., dim]."""
        return recover(partial(self._velocity, params, observation), action, self.steps)

    def _velocity(self, params: Params, observation: jax.Array, x: jax.Array, time: jax.Array) -> jax.Array:
        return self._field.apply(params, observation, x, time)


def noise_at(observation: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Return Gaussian noise[*shape] that is a fixed function of one observation[obs].

    A stochastic policy that is evaluated with it draws anew in every state, needs no key, and repeats bit for bit.
    """
    bits = jax.lax.bitcast_convert_type(observation.astype(jnp.float32), jnp.uint32)
    places = 2 * jnp.arange(observation.shape[-1], dtype=jnp.uint32) + 1
    return jax.random.normal(jax.random.fold_in(jax.random.key(0), jnp.sum(bits * places)), shape)
