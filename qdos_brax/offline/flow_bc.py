"""Behaviour cloning by a flow over chunks of actions: the frozen policy that DSRL steers."""

from __future__ import annotations

from typing import Any

import jax
import optax
from flax import struct

from qdos_brax.data.device import DeviceData
from qdos_brax.data.segments import window
from qdos_brax.nn.optim import ADAM, adam_step
from qdos_brax.skills.flow_policy import FlowPolicy, Params


class FlowBCState(struct.PyTreeNode):
    """Hold parameters of the flow, and Adam's state."""

    flow: Params
    opt_state: optax.OptState


class FlowBC:
    """Clone behaviour by flow matching (``qdos_brax.offline.learner.Learner``).

    Args:
        flow: over chunks of H actions.
        horizon: H.
        batch_size: chunks per gradient step.
    """

    def __init__(self, flow: FlowPolicy, horizon: int, batch_size: int) -> None:
        self.flow, self._horizon, self._batch_size = flow, horizon, batch_size

    def init(self, key: jax.Array, hyper: dict[str, jax.Array]) -> FlowBCState:
        """Return fresh parameters."""
        flow = self.flow.init(key)
        return FlowBCState(flow, ADAM.init(flow))

    def update(
        self, state: FlowBCState, data: DeviceData, key: jax.Array, hyper: dict[str, jax.Array]
    ) -> tuple[FlowBCState, dict[str, jax.Array]]:
        """Make one gradient step on chunks of the data; reads ``flow.learning_rate``."""
        index_key, loss_key = jax.random.split(key)
        starts = data.starts[jax.random.randint(index_key, (self._batch_size,), 0, data.starts.shape[0])]
        chunks = window(data.actions, starts, self._horizon).reshape(self._batch_size, -1)
        loss, grads = jax.value_and_grad(self.flow.loss)(state.flow, data.observations[starts], chunks, loss_key)
        flow, opt_state = adam_step(state.flow, state.opt_state, grads, hyper["flow.learning_rate"])
        return FlowBCState(flow, opt_state), {"flow_loss": loss}

    def params(self, state: FlowBCState) -> dict[str, Any]:
        """Return {"flow"}."""
        return {"flow": state.flow}
