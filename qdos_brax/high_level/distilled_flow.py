"""Flow Q-learning: a one-step policy that maximises Q and is held near a flow policy which clones the data.

FQL (Park, Li, Levine 2025, arXiv 2502.02538, eq. 7 to 9 and Algorithm 1; code seohongpark/fql), and over chunks of
actions QC-FQL (Li, Zhou, Levine 2025, arXiv 2507.07969, Algorithm 2).
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct

from qdos_brax.config import FlowConfig, HighLevelConfig
from qdos_brax.data.transitions import Transition
from qdos_brax.high_level.actor_critic import Reference
from qdos_brax.high_level.q_function import QFunction, QHyper, QState, q_hyper
from qdos_brax.nn.optim import ADAM, Params, adam_step
from qdos_brax.skills.flow_policy import FlowPolicy, noise_at


class OneStepPolicy(nn.Module):
    """Compute mu(s, noise), the proposal of one pass: dense layers with GELU, clipped into the action box where it is
    played.

    Attributes:
        hidden: hidden widths.
        action_dim: width of decisions.
    """

    hidden: tuple[int, ...]
    action_dim: int

    @nn.compact
    def __call__(self, observation: jax.Array, noise: jax.Array) -> jax.Array:
        """Maps observation[..., obs] and noise[..., action_dim] to a decision[..., action_dim], not clipped."""
        x = jnp.concatenate([observation, noise], axis=-1)
        for width in self.hidden:
            x = nn.gelu(nn.Dense(width)(x))
        return nn.Dense(self.action_dim)(x)


class DistilledFlowHyper(NamedTuple):
    """Hold numbers a scan may vary: the critics' own, and alpha, the weight of the distillation."""

    q: QHyper
    distillation: jax.Array | float


class DistilledFlowState(struct.PyTreeNode):
    """Hold the critics, parameters of both policies, {"flow", "one_step"}, and Adam's state."""

    q: QState
    actor: dict[str, Params]
    opt_state: optax.OptState


class DistilledFlow:
    """Learn by flow Q-learning (``qdos_brax.high_level.actor_critic.ActorCritic``).

    Args:
        observation_dim: width of observations.
        action_dim: width of decisions.
        config: of the critics.
        flow: of both policies.
        horizon: environment steps per decision.
    """

    def __init__(
        self, observation_dim: int, action_dim: int, config: HighLevelConfig, flow: FlowConfig, horizon: int
    ) -> None:
        self.observation_dim, self.action_dim, self._horizon = observation_dim, action_dim, horizon
        self.q = QFunction(observation_dim, action_dim, config, flow.target)
        self.flow = FlowPolicy(observation_dim, action_dim, flow.hidden, flow.steps)
        self.one_step = OneStepPolicy(tuple(flow.hidden), action_dim)

    def start(self, key: jax.Array, hyper: dict[str, jax.Array]) -> DistilledFlowState:
        """Return fresh parameters."""
        q_key, flow_key, one_step_key = jax.random.split(key, 3)
        observation, noise = jnp.zeros((1, self.observation_dim)), jnp.zeros((1, self.action_dim))
        actor = {"flow": self.flow.init(flow_key), "one_step": self.one_step.init(one_step_key, observation, noise)}
        return DistilledFlowState(self.q.init(q_key), actor, ADAM.init(actor))

    def hyper(self, values: dict[str, jax.Array]) -> DistilledFlowHyper:
        """Return the critics' numbers, and ``flow.distillation``."""
        return DistilledFlowHyper(q_hyper(values, self._horizon), values["flow.distillation"])

    def actor_params(self, state: DistilledFlowState) -> dict[str, Params]:
        """Return {"one_step"}."""
        return {"one_step": state.actor["one_step"]}

    def act(self, actor: dict[str, Params], key: jax.Array, observation: jax.Array) -> jax.Array:
        """Return mu(s, noise)[..., action_dim], clipped into the box, for fresh noise."""
        noise = jax.random.normal(key, (*observation.shape[:-1], self.action_dim))
        return self.play(actor, observation, noise)

    def mode(self, actor: dict[str, Params], observation: jax.Array) -> jax.Array:
        """Return the same for noise that is a fixed function of the observation."""
        flat = observation.reshape(-1, observation.shape[-1])
        noise = jax.vmap(lambda one: noise_at(one, (self.action_dim,)))(flat)
        return self.play(actor, observation, noise.reshape(*observation.shape[:-1], self.action_dim))

    def play(self, actor: dict[str, Params], observation: jax.Array, noise: jax.Array) -> jax.Array:
        """Return mu(s, noise)[..., action_dim], clipped into the box."""
        return jnp.clip(self.one_step.apply(actor["one_step"], observation, noise), -1.0, 1.0)

    def update_critic(
        self,
        state: DistilledFlowState,
        batch: Transition,
        key: jax.Array,
        hyper: DistilledFlowHyper,
        reference: Reference | None = None,
    ) -> tuple[DistilledFlowState, dict[str, jax.Array]]:
        """Make one step of the critics, towards the value of the one-step policy in the next state."""
        q, info = self.q.update(state.q, batch, self.act(state.actor, key, batch.next_observation), hyper.q)
        return state.replace(q=q), info

    def distillation_loss(
        self, actor: dict[str, Params], observation: jax.Array, noise: jax.Array, flow: Params
    ) -> jax.Array:
        """Return the mean squared difference between mu(s, noise) and what the flow, held fixed, makes of noise."""
        target = jax.lax.stop_gradient(self.flow.play(flow, observation, noise))
        return jnp.mean((self.one_step.apply(actor["one_step"], observation, noise) - target) ** 2)

    def actor_loss(
        self,
        actor: dict[str, Params],
        critic: Params,
        batch: Transition,
        key: jax.Array,
        distillation: jax.Array | float,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Return flow matching + alpha distillation - mean Q(s, mu(s, noise)), and the three parts.

        Q is the mean of the heads here, whatever the targets take (FQL's code).
        """
        flow_key, noise_key = jax.random.split(key)
        noise = jax.random.normal(noise_key, batch.action.shape)
        flow_loss = self.flow.loss(actor["flow"], batch.observation, batch.action, flow_key)
        distilled = self.distillation_loss(actor, batch.observation, noise, actor["flow"])
        value = jnp.mean(self.q.values(critic, batch.observation, self.play(actor, batch.observation, noise)))
        parts = {"flow_loss": flow_loss, "distillation_loss": distilled, "actor_q": value}
        return flow_loss + distillation * distilled - value, parts

    def update_actor(
        self,
        state: DistilledFlowState,
        batch: Transition,
        key: jax.Array,
        hyper: DistilledFlowHyper,
        reference: Reference | None = None,
    ) -> tuple[DistilledFlowState, dict[str, jax.Array]]:
        """Make one step of both policies."""
        grads, info = jax.grad(self.actor_loss, has_aux=True)(
            state.actor, state.q.critic, batch, key, hyper.distillation
        )
        actor, opt_state = adam_step(state.actor, state.opt_state, grads, hyper.q.learning_rate)
        return state.replace(actor=actor, opt_state=opt_state), info
