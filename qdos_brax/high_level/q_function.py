"""Critics that regress on r + gamma^H Q'(s', a') with an a' that a policy proposes: no entropy, no minimum over draws.

The critics of FQL (Park, Li, Levine 2025) and Q-chunking (Li, Zhou, Levine 2025, eq. 11): two heads with LayerNorm,
whose mean (or minimum: FQL's ``q_agg``) is the target's value.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.config import HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.nn.networks import Ensemble
from qdos_brax.nn.optim import ADAM, Params, adam_step, polyak


class QState(struct.PyTreeNode):
    """Hold parameters of the heads, of their targets, and Adam's state."""

    critic: Params
    target_critic: Params
    opt_state: optax.OptState


class QHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary: learning rate, discount per transition, Polyak rate."""

    learning_rate: jax.Array | float
    discount: jax.Array | float
    target_rate: jax.Array | float


class QFunction:
    """Regress Q(s, u).

    Args:
        observation_dim: width of observations.
        action_dim: width of decisions u.
        config: widths, number of heads, ``value_scale``.
        target: "mean" or "min" of the heads, what a value is.
    """

    def __init__(self, observation_dim: int, action_dim: int, config: HighLevelConfig, target: str) -> None:
        self._input_dim, self._scale = observation_dim + action_dim, config.value_scale
        self._heads = Ensemble(config.hidden, config.ensemble)
        self._by_mean = target == "mean"

    def init(self, key: jax.Array) -> QState:
        """Return fresh parameters; the targets start as a copy."""
        critic = self._heads.init(key, jnp.zeros((1, self._input_dim)))
        return QState(critic, jax.tree.map(jnp.copy, critic), ADAM.init(critic))

    def values(self, critic: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Return Q of every head, [heads, ...]."""
        return self._scale * self._heads.apply(critic, jnp.concatenate([observation, action], axis=-1))

    def value(self, critic: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Return the mean or the minimum of the heads, [...]."""
        values = self.values(critic, observation, action)
        return values.mean(axis=0) if self._by_mean else values.min(axis=0)

    def update(
        self, state: QState, batch: Transition, next_action: jax.Array, hyper: QHyper
    ) -> tuple[QState, dict[str, jax.Array]]:
        """Make one step towards r + discount mask Q'(s', next_action[B, d]); the targets follow."""
        bootstrap = self.value(state.target_critic, batch.next_observation, next_action)
        target = jax.lax.stop_gradient(batch.reward + hyper.discount * batch.mask * bootstrap)

        def loss(critic: Params) -> jax.Array:
            return jnp.mean((self.values(critic, batch.observation, batch.action) - target) ** 2)

        value, grads = jax.value_and_grad(loss)(state.critic)
        critic, opt_state = adam_step(state.critic, state.opt_state, grads, hyper.learning_rate)
        target_critic = polyak(state.target_critic, critic, hyper.target_rate)
        return QState(critic, target_critic, opt_state), {"critic_loss": value, "q": jnp.mean(target)}


def q_hyper(values: dict[str, jax.Array], horizon: int) -> QHyper:
    """Return the numbers of the group ``high_level``; its discount is per environment step, a decision takes H."""
    return QHyper(
        learning_rate=values["high_level.learning_rate"],
        discount=values["high_level.discount"] ** horizon,
        target_rate=values["high_level.target_rate"],
    )
