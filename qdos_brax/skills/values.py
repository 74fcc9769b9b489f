"""Implicit Q-learning (Kostrikov et al. 2021) on the logged data: how good a state is for the task.

The bootstrap may reach n steps ahead along the logged trajectory, which carries a sparse reward over long ways in few
updates; n = 1 is IQL as published.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.nn.networks import MLP, Ensemble
from qdos_brax.nn.optim import ADAM, Params, adam_step, polyak


class ValueBatch(NamedTuple):
    """Hold n-step transitions, leading axis B: discount is gamma^n, or 0 where the way ended."""

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    discount: jax.Array
    next_observation: jax.Array


class ValueHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary."""

    learning_rate: jax.Array | float
    expectile: jax.Array | float
    target_rate: jax.Array | float


class ValueState(struct.PyTreeNode):
    """Hold parameters of V, of the two heads of Q and of their target, and Adam's state."""

    value: Params
    critic: Params
    target_critic: Params
    value_opt_state: optax.OptState
    critic_opt_state: optax.OptState


def expectile_loss(error: jax.Array, expectile: jax.Array | float) -> jax.Array:
    """Return |expectile - 1(error < 0)| error^2, elementwise (paper, eq. 1; ``error`` = target - prediction)."""
    return jnp.where(error < 0, 1 - expectile, expectile) * error**2


class IQL:
    """Learn V and Q by implicit Q-learning.

    Args:
        observation_dim: width of observations.
        action_dim: width of actions.
        hidden: hidden widths of V and Q.
    """

    def __init__(self, observation_dim: int, action_dim: int, hidden: Sequence[int]) -> None:
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self._value = MLP((*hidden, 1), layer_norm=True)
        self._critic = Ensemble(tuple(hidden), size=2)

    def init(self, key: jax.Array) -> ValueState:
        """Return fresh parameters; the target starts as a copy."""
        value_key, critic_key = jax.random.split(key)
        value = self._value.init(value_key, jnp.zeros((1, self.observation_dim)))
        critic = self._critic.init(critic_key, jnp.zeros((1, self.observation_dim + self.action_dim)))
        return ValueState(value, critic, jax.tree.map(jnp.copy, critic), ADAM.init(value), ADAM.init(critic))

    def value(self, params: Params, observation: jax.Array) -> jax.Array:
        """Return V(s), [...]."""
        return self._value.apply(params, observation)[..., 0]

    def q(self, params: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Return Q(s, a) of both heads, [2, ...]."""
        return self._critic.apply(params, jnp.concatenate([observation, action], axis=-1))

    def value_loss(self, value: Params, target_critic: Params, batch: ValueBatch, expectile: Any) -> jax.Array:
        """Return the loss of the expectile regression of V to the smaller target head."""
        target = self.q(target_critic, batch.observation, batch.action).min(axis=0)
        return jnp.mean(expectile_loss(target - self.value(value, batch.observation), expectile))

    def critic_loss(self, critic: Params, value: Params, batch: ValueBatch) -> jax.Array:
        """Return the squared error of both heads to the n-step target."""
        target = batch.reward + batch.discount * self.value(value, batch.next_observation)
        error = self.q(critic, batch.observation, batch.action) - jax.lax.stop_gradient(target)
        return jnp.mean(jnp.sum(error**2, axis=0))

    def update(
        self, state: ValueState, batch: ValueBatch, hyper: ValueHyper
    ) -> tuple[ValueState, dict[str, jax.Array]]:
        """Make one step of V, of Q and of the target."""
        value_loss, grads = jax.value_and_grad(self.value_loss)(
            state.value, state.target_critic, batch, hyper.expectile
        )
        value, value_opt_state = adam_step(state.value, state.value_opt_state, grads, hyper.learning_rate)
        critic_loss, grads = jax.value_and_grad(self.critic_loss)(state.critic, value, batch)
        critic, critic_opt_state = adam_step(state.critic, state.critic_opt_state, grads, hyper.learning_rate)
        target_critic = polyak(state.target_critic, critic, hyper.target_rate)
        info = {"value_loss": value_loss, "value_q_loss": critic_loss}
        return ValueState(value, critic, target_critic, value_opt_state, critic_opt_state), info
