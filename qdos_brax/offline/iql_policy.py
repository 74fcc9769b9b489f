"""Implicit Q-learning with its policy (Kostrikov, Nair, Levine 2022): regression on the data's actions by advantage.

Values are those of ``qdos_brax.skills.values``, bootstrapped over one step as published. Published for D4RL's mazes:
expectile 0.9, beta 10; for its kitchen 0.7 and 0.5; for OGBench (Park et al. 2025, FQL) beta 10 on humanoidmaze.
"""

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
from qdos_brax.offline.rows import random_rows, transitions
from qdos_brax.skills.values import IQL, ValueBatch, ValueHyper, ValueState

WEIGHT_CLIP = 100.0  # the largest weight of a transition (paper, section 5 and code)


class IQLPolicyHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary: the values' own, the policy's learning rate, and beta of its weights exp(beta
    A).
    """

    values: ValueHyper
    learning_rate: jax.Array | float
    inverse_temperature: jax.Array | float


class IQLPolicyState(struct.PyTreeNode):
    """Hold values, the policy's parameters, and Adam's states."""

    values: ValueState
    actor: Params
    opt_state: optax.OptState


def regression_weight(advantage: jax.Array, inverse_temperature: jax.Array | float) -> jax.Array:
    """Return min(exp(beta A), 100), [B], no gradient (paper, eq. 7)."""
    return jax.lax.stop_gradient(jnp.minimum(jnp.exp(inverse_temperature * advantage), WEIGHT_CLIP))


class IQLPolicy:
    """Learn IQL's values and policy (``qdos_brax.offline.learner.Learner``).

    Args:
        observation_dim: width of observations.
        action_dim: width of actions.
        config: widths of the policy, and batch size.
        values: the learner of V and Q.
    """

    def __init__(self, observation_dim: int, action_dim: int, config: PolicyConfig, values: IQL) -> None:
        self.observation_dim, self.batch_size = observation_dim, config.batch_size
        self.values = values
        self.policy = GaussianPolicy(config.hidden, action_dim)

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> IQLPolicyState:
        """Return fresh parameters."""
        values_key, actor_key = jax.random.split(key)
        actor = self.policy.init(actor_key, jnp.zeros((1, self.observation_dim)))
        return IQLPolicyState(self.values.init(values_key), actor, ADAM.init(actor))

    def act(self, params: dict[str, Any], observation: jax.Array) -> jax.Array:
        """Return the mode of the policy, [..., act] in [-1, 1]; ``observation`` is normalised."""
        return self.policy.apply(params["actor"], observation)[0]

    def advantage(self, values: ValueState, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Return min Q(s, a) - V(s), [B], with the target critic's heads."""
        q = self.values.q(values.target_critic, observation, action).min(axis=0)
        return q - self.values.value(values.value, observation)

    def step(
        self, state: IQLPolicyState, batch: ValueBatch, hyper: IQLPolicyHyper
    ) -> tuple[IQLPolicyState, dict[str, jax.Array]]:
        """Make one step of V, Q, their target and the policy."""
        values, info = self.values.update(state.values, batch, hyper.values)
        advantage = self.advantage(values, batch.observation, batch.action)
        weight = regression_weight(advantage, hyper.inverse_temperature)

        def loss(actor: Params) -> jax.Array:
            return weighted_imitation_loss(self.policy, actor, batch.observation, batch.action, weight)

        actor_loss, grads = jax.value_and_grad(loss)(state.actor)
        actor, opt_state = adam_step(state.actor, state.opt_state, grads, hyper.learning_rate)
        info |= {"actor_loss": actor_loss, "policy_weight": jnp.mean(weight)}
        return IQLPolicyState(values, actor, opt_state), info

    def update(
        self, state: IQLPolicyState, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[IQLPolicyState, dict[str, jax.Array]]:
        """Make one step on a batch of the data.

        Reads ``values.learning_rate``, ``.expectile``, ``.target_rate``, ``.discount``, ``policy.learning_rate`` and
        ``policy.inverse_temperature``.
        """
        batch = transitions(data, random_rows(data, key, self.batch_size), hyper["values.discount"])
        values = ValueHyper(hyper["values.learning_rate"], hyper["values.expectile"], hyper["values.target_rate"])
        own = IQLPolicyHyper(values, hyper["policy.learning_rate"], hyper["policy.inverse_temperature"])
        return self.step(state, batch, own)

    def params(self, state: IQLPolicyState) -> dict[str, Any]:
        """Return {"actor"}."""
        return {"actor": state.actor}
