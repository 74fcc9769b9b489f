"""What a macro step would earn, learned online: a reward head and a termination head (SUPE, ExPLORe)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.nn.networks import MLP
from qdos_brax.nn.optim import ADAM, adam_step


class RewardModelState(struct.PyTreeNode):
    """Hold parameters of both heads and Adam's state."""

    params: Any
    opt_state: optax.OptState


class RewardModel:
    """Predict reward and end of a macro step.

    Args:
        input_dim: width of observation and action together.
        hidden: hidden widths of each head.
    """

    def __init__(self, input_dim: int, hidden: Sequence[int]) -> None:
        self._input_dim = input_dim
        self._head = MLP((*hidden, 1))

    def init(self, key: jax.Array) -> RewardModelState:
        """Return fresh heads."""
        reward_key, end_key = jax.random.split(key)
        example = jnp.zeros((1, self._input_dim))
        params = {"reward": self._head.init(reward_key, example), "end": self._head.init(end_key, example)}
        return RewardModelState(params, ADAM.init(params))

    def predict(self, params: Any, observation: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return (reward[...], logit[...] of the mask, that is of not terminating)."""
        x = jnp.concatenate([observation, action], axis=-1)
        return self._head.apply(params["reward"], x)[..., 0], self._head.apply(params["end"], x)[..., 0]

    def loss(
        self, params: Any, observation: jax.Array, action: jax.Array, reward: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """Return the squared error of the reward plus binary cross-entropy of the mask, mean over the batch."""
        predicted, logit = self.predict(params, observation, action)
        cross_entropy = optax.sigmoid_binary_cross_entropy(logit, mask)
        return jnp.mean((predicted - reward) ** 2 + cross_entropy)

    def update(
        self,
        state: RewardModelState,
        observation: jax.Array,
        action: jax.Array,
        reward: jax.Array,
        mask: jax.Array,
        learning_rate: Any,
    ) -> RewardModelState:
        """Make one gradient step on online rows[B]."""
        grads = jax.grad(self.loss)(state.params, observation, action, reward, mask)
        params, opt_state = adam_step(state.params, state.opt_state, grads, learning_rate)
        return RewardModelState(params, opt_state)
