"""Soft actor-critic with a critic ensemble (Haarnoja et al. 2018; REDQ, Chen et al. 2021; RLPD, Ball et al. 2023).

Losses are functions of parameters and a batch; ``SAC`` holds the networks and static sizes; everything that learns or
may be scanned is an argument, so that members of a population differ along a ``vmap`` axis.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.config import HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.actor_critic import Reference
from qdos_brax.nn.networks import DiagonalGaussian, Ensemble, tanh_gaussian_sample
from qdos_brax.nn.optim import ADAM, adam_step, polyak

Params = Any


class SACHyper(struct.PyTreeNode):
    """Hold numbers a scan may vary: learning rate, discount per transition, Polyak rate, target entropy (nats).

    Held against a reference, the "entropy" is minus the divergence KL(actor || reference).
    """

    learning_rate: jax.Array | float
    discount: jax.Array | float
    target_rate: jax.Array | float
    target_entropy: jax.Array | float


class SACState(struct.PyTreeNode):
    """Hold everything that learns: parameters, the target ensemble, the temperature, and Adam's states."""

    actor: Params
    critic: Params
    target_critic: Params
    log_temperature: jax.Array
    actor_opt_state: optax.OptState
    critic_opt_state: optax.OptState
    temperature_opt_state: optax.OptState


class SAC:
    """Learn by soft actor-critic with a critic ensemble (``qdos_brax.high_level.actor_critic.ActorCritic``).

    Args:
        observation_dim: width of observations.
        action_dim: width of actions, which lie in (-1, 1).
        config: widths, critics (with LayerNorm), and ``value_scale``: Adam moves weights at a speed of its own, so
            that networks whose outputs must reach hundreds take long to get there.
        entropy_backup: whether the entropy term is subtracted from the bootstrap value: SAC does, RLPD's mazes do not,
            SPiRL (Pertsch et al. 2020) does with its divergence. None does where ``config.regulariser`` is "prior".
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        config: HighLevelConfig,
        entropy_backup: bool | None = None,
    ) -> None:
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.ensemble, self.target_subset, self.value_scale = config.ensemble, config.target_subset, config.value_scale
        self.entropy_backup = config.regulariser == "prior" if entropy_backup is None else entropy_backup
        self._by_entropy = config.regulariser == "entropy"
        self.actor = DiagonalGaussian(config.hidden, action_dim)
        self.critic = Ensemble(config.hidden, config.ensemble)
        self._target_heads = Ensemble(config.hidden, config.target_subset)

    def start(self, key: jax.Array, hyper: dict[str, jax.Array]) -> SACState:
        """Return fresh parameters; reads ``high_level.init_temperature``."""
        return self.init(key, hyper["high_level.init_temperature"])

    def hyper(self, values: dict[str, jax.Array]) -> SACHyper:
        """Return learning rate, discount, Polyak rate, and the entropy that the temperature aims at."""
        aim = -values["high_level.target_divergence"]
        if self._by_entropy:
            aim = -values["high_level.target_entropy_scale"] * self.action_dim
        return SACHyper(
            learning_rate=values["high_level.learning_rate"],
            discount=values["high_level.discount"],
            target_rate=values["high_level.target_rate"],
            target_entropy=aim,
        )

    def actor_params(self, state: SACState) -> Params:
        """Return the actor's parameters."""
        return state.actor

    def init(self, key: jax.Array, init_temperature: jax.Array | float) -> SACState:
        """Return fresh parameters; the target ensemble starts as a copy."""
        actor_key, critic_key = jax.random.split(key)
        observation = jnp.zeros((1, self.observation_dim))
        actor = self.actor.init(actor_key, observation)
        critic = self.critic.init(critic_key, jnp.zeros((1, self.observation_dim + self.action_dim)))
        log_temperature = jnp.log(jnp.asarray(init_temperature, jnp.float32))
        return SACState(
            actor=actor,
            critic=critic,
            target_critic=jax.tree.map(jnp.copy, critic),
            log_temperature=log_temperature,
            actor_opt_state=ADAM.init(actor),
            critic_opt_state=ADAM.init(critic),
            temperature_opt_state=ADAM.init(log_temperature),
        )

    def act(self, actor: Params, key: jax.Array, observation: jax.Array) -> jax.Array:
        """Return a sampled action[..., action_dim] in (-1, 1)."""
        return tanh_gaussian_sample(key, *self.actor.apply(actor, observation))[0]

    def mode(self, actor: Params, observation: jax.Array) -> jax.Array:
        """Return the squashed mean action[..., action_dim], for evaluation."""
        return jnp.tanh(self.actor.apply(actor, observation)[0])

    def values(self, critic: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Return Q of every critic, [ensemble, ...]."""
        return self.value_scale * self.critic.apply(critic, jnp.concatenate([observation, action], axis=-1))

    def target_value(
        self, state: SACState, key: jax.Array, next_observation: jax.Array, reference: Reference | None = None
    ) -> jax.Array:
        """Return the bootstrap value[B]: min over a random subset of target critics at the actor's action."""
        action_key, subset_key = jax.random.split(key)
        action, log_prob = self._sample(state.actor, action_key, next_observation, reference)
        value = self.smallest_of_subset(state.target_critic, subset_key, next_observation, action)
        if self.entropy_backup:
            value = value - jnp.exp(state.log_temperature) * log_prob
        return value

    def smallest_of_subset(
        self, critic: Params, key: jax.Array, observation: jax.Array, action: jax.Array
    ) -> jax.Array:
        """Return the minimum[B] of Q(s, u) over a random subset of critics; only the chosen heads are evaluated."""
        heads = jax.random.choice(key, self.ensemble, (self.target_subset,), replace=False)
        chosen = jax.tree.map(lambda p: p[heads], critic)
        values = self._target_heads.apply(chosen, jnp.concatenate([observation, action], axis=-1))
        return self.value_scale * values.min(axis=0)

    def critic_loss(self, critic: Params, batch: Transition, target: jax.Array) -> jax.Array:
        """Return the mean over batch and sum over critics of the squared error to target[B]."""
        error = self.values(critic, batch.observation, batch.action) - target
        return jnp.mean(jnp.sum(error**2, axis=0))

    def _sample(
        self, actor: Params, key: jax.Array, observation: jax.Array, reference: Reference | None
    ) -> tuple[jax.Array, jax.Array]:
        """The actor's u[B, action_dim] and log pi(u | s), less that of the reference, [B]."""
        action, log_prob = tanh_gaussian_sample(key, *self.actor.apply(actor, observation))
        return action, log_prob if reference is None else log_prob - reference(observation, action)

    def actor_loss(
        self,
        actor: Params,
        critic: Params,
        temperature: jax.Array,
        observation: jax.Array,
        key: jax.Array,
        reference: Reference | None = None,
    ) -> tuple[jax.Array, jax.Array]:
        """Return mean[temperature log pi(u | s) - mean_i Q_i(s, u)], and the policy's entropy estimate."""
        action, log_prob = self._sample(actor, key, observation, reference)
        value = self.values(critic, observation, action).mean(axis=0)
        return jnp.mean(temperature * log_prob - value), -jnp.mean(log_prob)

    def update_critic(
        self, state: SACState, batch: Transition, key: jax.Array, hyper: SACHyper, reference: Reference | None = None
    ) -> tuple[SACState, dict[str, jax.Array]]:
        """Make one step of every critic and of the target ensemble."""
        bootstrap = self.target_value(state, key, batch.next_observation, reference)
        target = jax.lax.stop_gradient(batch.reward + hyper.discount * batch.mask * bootstrap)
        loss, grads = jax.value_and_grad(self.critic_loss)(state.critic, batch, target)
        info = {"critic_loss": loss / self.ensemble, "q": jnp.mean(target)}
        return self.move_critic(state, grads, hyper), info

    def move_critic(self, state: SACState, grads: Params, hyper: SACHyper) -> SACState:
        """Return the state after Adam's step of every critic along ``grads``, which the targets follow."""
        critic, opt_state = adam_step(state.critic, state.critic_opt_state, grads, hyper.learning_rate)
        target_critic = polyak(state.target_critic, critic, hyper.target_rate)
        return state.replace(critic=critic, critic_opt_state=opt_state, target_critic=target_critic)

    def update_actor(
        self,
        state: SACState,
        batch: Transition,
        key: jax.Array,
        hyper: SACHyper,
        reference: Reference | None = None,
    ) -> tuple[SACState, dict[str, jax.Array]]:
        """Make one step of the actor on the batch's observations, then one of the temperature towards its aim."""
        temperature = jnp.exp(state.log_temperature)
        (loss, entropy), grads = jax.value_and_grad(self.actor_loss, has_aux=True)(
            state.actor, state.critic, temperature, batch.observation, key, reference
        )
        actor, actor_opt_state = adam_step(state.actor, state.actor_opt_state, grads, hyper.learning_rate)
        temperature_grad = temperature * (entropy - hyper.target_entropy)
        log_temperature, temperature_opt_state = adam_step(
            state.log_temperature, state.temperature_opt_state, temperature_grad, hyper.learning_rate
        )
        info = {"actor_loss": loss, "entropy": entropy, "temperature": temperature}
        state = state.replace(
            actor=actor,
            actor_opt_state=actor_opt_state,
            log_temperature=log_temperature,
            temperature_opt_state=temperature_opt_state,
        )
        return state, info
