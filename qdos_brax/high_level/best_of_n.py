"""Best of N: a flow policy clones the data and experience, and the critic chooses among N of its proposals.

Q-chunking (Li, Zhou, Levine 2025, arXiv 2507.07969, Algorithm 1 and 2; code ColinQiyangLi/qc, actor_type best-of-n):
decisions are chunks of 5 actions, N = 32, and the same choice, by the online critics (their mean, or what
``flow.target`` says), acts, is evaluated, and gives the target's next chunk, whose value is that of the target critics.
"""

from __future__ import annotations

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


class BestOfNState(struct.PyTreeNode):
    """Hold the critics, the flow's parameters, and Adam's state."""

    q: QState
    flow: Params
    opt_state: optax.OptState


class BestOfN:
    """Learn critics and a flow policy, and act by the best of N (``qdos_brax.high_level.actor_critic.ActorCritic``).

    Args:
        observation_dim: width of observations.
        action_dim: width of decisions.
        config: of the critics.
        flow: of the flow policy; ``candidates`` is N.
        horizon: environment steps per decision.
    """

    def __init__(
        self, observation_dim: int, action_dim: int, config: HighLevelConfig, flow: FlowConfig, horizon: int
    ) -> None:
        self.observation_dim, self.action_dim, self.candidates = observation_dim, action_dim, flow.candidates
        self.q = QFunction(observation_dim, action_dim, config, flow.target)
        self.flow = FlowPolicy(observation_dim, action_dim, flow.hidden, flow.steps)
        self._horizon = horizon

    def start(self, key: jax.Array, hyper: dict[str, jax.Array]) -> BestOfNState:
        """Return fresh parameters."""
        q_key, flow_key = jax.random.split(key)
        flow = self.flow.init(flow_key)
        return BestOfNState(self.q.init(q_key), flow, ADAM.init(flow))

    def hyper(self, values: dict[str, jax.Array]) -> QHyper:
        """Return learning rate, discount per decision and Polyak rate."""
        return q_hyper(values, self._horizon)

    def actor_params(self, state: BestOfNState) -> dict[str, Params]:
        """Return {"flow", "critic"}."""
        return {"flow": state.flow, "critic": state.q.critic}

    def act(self, actor: dict[str, Params], key: jax.Array, observation: jax.Array) -> jax.Array:
        """Return the best[..., action_dim] of N proposals, each from noise of its own."""
        return self.choose(actor, jax.random.normal(key, self._noise_shape(observation)), observation)

    def mode(self, actor: dict[str, Params], observation: jax.Array) -> jax.Array:
        """Return the same from noise that is a fixed function of the observation."""
        shape = (self.candidates, self.action_dim)
        flat = observation.reshape(-1, observation.shape[-1])
        noise = jax.vmap(lambda one: noise_at(one, shape), out_axes=1)(flat)
        return self.choose(actor, noise.reshape(self._noise_shape(observation)), observation)

    def choose(self, actor: dict[str, Params], noise: jax.Array, observation: jax.Array) -> jax.Array:
        """Return the proposal[..., action_dim] of highest Q among those of noise[N, ..., action_dim]."""
        repeated = jnp.broadcast_to(observation, (*noise.shape[:-1], observation.shape[-1]))
        proposals = self.flow.play(actor["flow"], repeated, noise)
        best = jnp.argmax(self.q.value(actor["critic"], repeated, proposals), axis=0)
        return jnp.take_along_axis(proposals, best[None, ..., None], axis=0)[0]

    def update_critic(
        self,
        state: BestOfNState,
        batch: Transition,
        key: jax.Array,
        hyper: QHyper,
        reference: Reference | None = None,
    ) -> tuple[BestOfNState, dict[str, jax.Array]]:
        """Make one step of the critics, towards the value of the best of N in the next state."""
        next_action = self.act(self.actor_params(state), key, batch.next_observation)
        q, info = self.q.update(state.q, batch, next_action, hyper)
        return state.replace(q=q), info

    def update_actor(
        self,
        state: BestOfNState,
        batch: Transition,
        key: jax.Array,
        hyper: QHyper,
        reference: Reference | None = None,
    ) -> tuple[BestOfNState, dict[str, jax.Array]]:
        """Make one step of flow matching to the batch's decisions."""
        loss, grads = jax.value_and_grad(self.flow.loss)(state.flow, batch.observation, batch.action, key)
        flow, opt_state = adam_step(state.flow, state.opt_state, grads, hyper.learning_rate)
        return state.replace(flow=flow, opt_state=opt_state), {"flow_loss": loss}

    def _noise_shape(self, observation: jax.Array) -> tuple[int, ...]:
        return (self.candidates, *observation.shape[:-1], self.action_dim)
