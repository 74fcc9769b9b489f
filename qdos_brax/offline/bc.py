"""Behaviour cloning: the policy that makes the logged actions most likely, each transition by itself."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.config import PolicyConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.nn.optim import ADAM, adam_step
from qdos_brax.offline.policy import GaussianPolicy, Params, weighted_imitation_loss
from qdos_brax.offline.rows import random_rows


class BCState(struct.PyTreeNode):
    """Hold parameters of the policy and Adam's state."""

    actor: Params
    opt_state: optax.OptState


class BC:
    """Clone behaviour (``qdos_brax.offline.learner.Learner``).

    Args:
        observation_dim: width of observations.
        action_dim: width of actions.
        config: widths and batch size.
    """

    def __init__(self, observation_dim: int, action_dim: int, config: PolicyConfig) -> None:
        self.observation_dim, self.action_dim, self.batch_size = observation_dim, action_dim, config.batch_size
        self.policy = GaussianPolicy(config.hidden, action_dim)

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> BCState:
        """Return fresh parameters."""
        actor = self.policy.init(key, jnp.zeros((1, self.observation_dim)))
        return BCState(actor, ADAM.init(actor))

    def act(self, params: dict[str, Any], observation: jax.Array) -> jax.Array:
        """Return the mode of the policy, [..., act] in [-1, 1]; ``observation`` is normalised."""
        return self.policy.apply(params["actor"], observation)[0]

    def step(
        self, state: BCState, observation: jax.Array, action: jax.Array, learning_rate: jax.Array | float
    ) -> tuple[BCState, dict[str, jax.Array]]:
        """Make one gradient step on observation[B, obs], action[B, act]."""

        def loss(actor: Params) -> jax.Array:
            return weighted_imitation_loss(self.policy, actor, observation, action, 1.0)

        value, grads = jax.value_and_grad(loss)(state.actor)
        actor, opt_state = adam_step(state.actor, state.opt_state, grads, learning_rate)
        return BCState(actor, opt_state), {"actor_loss": value}

    def update(
        self, state: BCState, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[BCState, dict[str, jax.Array]]:
        """Make one gradient step on a batch of the data; reads ``policy.learning_rate``."""
        rows = random_rows(data, key, self.batch_size)
        return self.step(state, data.observations[rows], data.actions[rows], hyper["policy.learning_rate"])

    def params(self, state: BCState) -> dict[str, Any]:
        """Return {"actor"}."""
        return {"actor": state.actor}
