"""Random network distillation (Burda et al. 2018): how new a (state, skill) pair is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.nn.networks import MLP
from qdos_brax.nn.optim import ADAM, adam_step


class RNDState(struct.PyTreeNode):
    """Hold the fixed random network, the predictor that learns to imitate it, and Adam's state."""

    target: Any
    predictor: Any
    opt_state: optax.OptState


class RND:
    """Measure novelty by random network distillation.

    Args:
        input_dim: width of observation and action together.
        hidden: hidden widths of both networks.
        features: width of their output.
    """

    def __init__(self, input_dim: int, hidden: Sequence[int], features: int) -> None:
        self._input_dim = input_dim
        self._network = MLP((*hidden, features))

    def init(self, key: jax.Array) -> RNDState:
        """Return two independent networks."""
        target_key, predictor_key = jax.random.split(key)
        example = jnp.zeros((1, self._input_dim))
        predictor = self._network.init(predictor_key, example)
        return RNDState(self._network.init(target_key, example), predictor, ADAM.init(predictor))

    def error(self, predictor: Any, target: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Return the mean squared error over the features, [...]; the bonus is a coefficient times this."""
        x = jnp.concatenate([observation, action], axis=-1)
        fixed = jax.lax.stop_gradient(self._network.apply(target, x))
        return jnp.mean((self._network.apply(predictor, x) - fixed) ** 2, axis=-1)

    def update(self, state: RNDState, observation: jax.Array, action: jax.Array, learning_rate: Any) -> RNDState:
        """Make one step of the predictor on rows[B]."""
        grads = jax.grad(lambda p: jnp.mean(self.error(p, state.target, observation, action)))(state.predictor)
        predictor, opt_state = adam_step(state.predictor, state.opt_state, grads, learning_rate)
        return state.replace(predictor=predictor, opt_state=opt_state)
