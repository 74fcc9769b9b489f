"""A warm start for SAC: actor and critics learned from labelled data, by losses other than those they go on with.

The hand-over of WSRL (Zhou, Peng, Li, Levine, Kumar 2025, arXiv 2412.07762; code zhouzypaul/wsrl): online learning
begins with the networks and Adam's states of an offline phase. Here that phase is implicit Q-learning (Kostrikov, Nair,
Levine 2022) with SAC's own networks: the whole ensemble as Q, the tanh-Gaussian actor as policy. V is dropped at the
end, and the temperature begins as SAC's does. The publication's default is Cal-QL.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from flax.serialization import to_state_dict

from qdos_brax.config import FlowConfig
from qdos_brax.data.device import DeviceData
from qdos_brax.data.transitions import Transition, macro_transitions
from qdos_brax.high_level.sac import SAC, SACHyper, SACState
from qdos_brax.nn.networks import MLP, tanh_gaussian_log_prob
from qdos_brax.nn.optim import ADAM, Params, adam_step
from qdos_brax.offline.iql_policy import regression_weight
from qdos_brax.skills.values import expectile_loss


class WarmStartHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary: SAC's own, the expectile of V, and beta of the actor's weights exp(beta A)."""

    sac: SACHyper
    expectile: jax.Array | float
    inverse_temperature: jax.Array | float


class WarmStartState(struct.PyTreeNode):
    """Hold SAC's whole state, parameters of V, and Adam's state of V."""

    sac: SACState
    value: Params
    value_opt_state: optax.OptState


class WarmStart:
    """Learn SAC's networks by implicit Q-learning on labelled windows (``qdos_brax.offline.learner.Learner``).

    Args:
        sac: what the online phase goes on with.
        hidden: hidden widths of V.
        horizon: H, steps of a window, which is one decision.
        config: ``batch_size``, windows per gradient step.
    """

    def __init__(self, sac: SAC, hidden: tuple[int, ...], horizon: int, config: FlowConfig) -> None:
        self._sac, self._horizon, self._batch_size = sac, horizon, config.batch_size
        self._value = MLP((*hidden, 1), layer_norm=True)

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> WarmStartState:
        """Return fresh parameters."""
        sac_key, value_key = jax.random.split(key)
        value = self._value.init(value_key, jnp.zeros((1, self._sac.observation_dim)))
        return WarmStartState(self._sac.start(sac_key, hyper), value, ADAM.init(value))

    def value(self, params: Params, observation: jax.Array) -> jax.Array:
        """Return V(s), [...], in the critics' unit."""
        return self._sac.value_scale * self._value.apply(params, observation)[..., 0]

    def value_loss(self, value: Params, observation: jax.Array, q: jax.Array, expectile: Any) -> jax.Array:
        """Return the loss of the expectile regression of V(observation[B]) to q[B]."""
        return jnp.mean(expectile_loss(q - self.value(value, observation), expectile))

    def target(self, value: Params, batch: Transition, discount: jax.Array | float) -> jax.Array:
        """Return r + discount mask V(s'), [B]."""
        return batch.reward + discount * batch.mask * self.value(value, batch.next_observation)

    def actor_loss(self, actor: Params, batch: Transition, weight: jax.Array) -> jax.Array:
        """Return -mean_i w_i log pi(u_i | s_i), over the decisions u of the data."""
        log_prob = tanh_gaussian_log_prob(batch.action, *self._sac.actor.apply(actor, batch.observation))
        return -jnp.mean(weight * log_prob)

    def step(
        self, state: WarmStartState, batch: Transition, key: jax.Array, hyper: WarmStartHyper
    ) -> tuple[WarmStartState, dict[str, jax.Array]]:
        """Make one step of V, the critics, their targets and the actor.

        Q of the data's decisions, for V and for the advantage, is the minimum over a random subset of the target
        critics, as in SAC's bootstrap.
        """
        sac, rate = state.sac, hyper.sac.learning_rate
        q = self._sac.smallest_of_subset(sac.target_critic, key, batch.observation, batch.action)
        value_loss, grads = jax.value_and_grad(self.value_loss)(state.value, batch.observation, q, hyper.expectile)
        value, value_opt_state = adam_step(state.value, state.value_opt_state, grads, rate)

        target = self.target(value, batch, hyper.sac.discount)
        critic_loss, grads = jax.value_and_grad(self._sac.critic_loss)(sac.critic, batch, target)
        sac = self._sac.move_critic(sac, grads, hyper.sac)

        weight = regression_weight(q - self.value(value, batch.observation), hyper.inverse_temperature)
        actor_loss, grads = jax.value_and_grad(self.actor_loss)(sac.actor, batch, weight)
        actor, actor_opt_state = adam_step(sac.actor, sac.actor_opt_state, grads, rate)

        sac = sac.replace(actor=actor, actor_opt_state=actor_opt_state)
        info = {"value_loss": value_loss, "critic_loss": critic_loss / self._sac.ensemble, "q": jnp.mean(target)}
        info |= {"actor_loss": actor_loss, "policy_weight": jnp.mean(weight)}
        return WarmStartState(sac, value, value_opt_state), info

    def update(
        self, state: WarmStartState, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[WarmStartState, dict[str, jax.Array]]:
        """Make one step on a batch of labelled windows, with the data's own rewards.

        Reads the numbers of the group ``high_level``, ``values.expectile`` and ``policy.inverse_temperature``.
        """
        assert data.labels is not None  # the phase before this one made them
        index_key, step_key = jax.random.split(key)
        index = jax.random.randint(index_key, (self._batch_size,), 0, data.starts.shape[0])
        discount = hyper["high_level.discount"]
        batch = macro_transitions(data, data.starts[index], self._horizon, discount, data.labels[index])
        own = WarmStartHyper(self._sac.hyper(hyper), hyper["values.expectile"], hyper["policy.inverse_temperature"])
        return self.step(state, batch, step_key, own)

    def params(self, state: WarmStartState) -> dict[str, Any]:
        """Return SAC's whole state, Adam's included, as nested dicts: the online phase goes on with it."""
        return dict(to_state_dict(state.sac))
